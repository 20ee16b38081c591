"""Compiled step of one tick: references, interlocks, limits and modes around the functions of the laws.

No kernel reads a clock, waits, allocates, logs or raises while the loop runs. Coefficients are built once and may fail;
kernels may not. No libm, no fused operations and no reordering: the same inputs give the same bits on any processor.
Begin with `step.evaluate`. May import foundation, errors, signals and values.
"""
