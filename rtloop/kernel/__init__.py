"""The control law: numbers in, numbers out.

Nothing here reads a clock, waits, allocates, logs or raises while the loop runs. Coefficients are built once and may
fail; the kernels may not. No libm, no fused operations and no reordering: the same inputs give the same bits on any
processor.
"""
