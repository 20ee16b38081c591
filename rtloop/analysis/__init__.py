"""Analysis of loops: margins, steps, the accuracy of C(z), tolerated changes of the plant; `measured` for running
loops.

It may import laws, linear and hysteresis, and the rooms below them. Begin with `closed_loop.py` and `margins.py`.
"""
