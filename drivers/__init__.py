"""Drivers: the simulated rig, boards behind comedi, shared memory or CAN, and the contract that every driver keeps.

This room imports `rtloop.hil` (the simulated rig and its board) and `rtloop.foundation`. Begin reading with `base`;
third parties register drivers under the entry-point group `rtloop.drivers`, and test them with `contract`.
"""
