"""Compilation of kernels and its cache, ordered access to shared memory, C pointers, and the monotonic clock.

This room imports only `rtloop.foundation.trusted`, numba and llvmlite. Begin reading with `compiled`, then
`c_function` and `cache`.
"""
