"""The stages between drive and reading: each module has the equation, the fields of the rig's records, and a kernel.

They import only `rtloop.foundation` and each other. Begin reading with `hysteresis` and `dynamics`.
"""
