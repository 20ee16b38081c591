"""Array types, modal systems, the base of all options, trusted paths, and (in `native`) the compiler of kernels.

This room imports no other room of rtloop; every room may import this one. Begin reading with `options` and
`native.compiled`.
"""
