"""Kinds `udp` and `serial`: the loop's drivers for a node with DAC and ADC behind Ethernet or USB; a simulated node.

This folder imports `rtloop.drivers`, `rtloop.hil` and `rtloop.foundation`. Begin reading with docs/node-protocol.md,
then `driver` and `exchange`.
"""
