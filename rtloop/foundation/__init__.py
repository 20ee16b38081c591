"""Shared by every room and the simulated rig: array types, the base of all options, trusted paths, native code.

It imports nothing from the rest of rtloop. Begin with `arrays` and `options`; `native.compiled` says how kernels are
compiled.
"""
