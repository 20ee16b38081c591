"""Kind `can`: the loop's driver for a node with DAC and ADC on a CAN bus, and the simulated rig as such a node.

This folder imports `rtloop.drivers`, `rtloop.hil`, `rtloop.foundation`, and python-can and cantools through `extra`.
Begin reading with `driver`, then `frames` and `node`.
"""
