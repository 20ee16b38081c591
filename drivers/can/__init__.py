"""Kind `can`: a remote DAC and ADC on a CAN bus, and the simulated rig as such a node. Needs the extra `can`."""
