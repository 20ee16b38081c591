"""The simulated rig: piezo cantilever, displacement sensor, DAC and ADC as compiled kernels, and the rig as a board.

This room imports only `rtloop.foundation`. Begin reading with `rig`; each module of `stages` has one stage's equation:

    drive [V] ─► DAC ─► latency ─► hysteresis ─► creep ─► (+ disturbance) ─► dynamics ─► sensor ─► ADC ─► reading [V]

The hysteresis is written independently of the controllers' inverse: the same mistake in both would cancel.
"""
