"""The simulated rig: piezo cantilever, displacement sensor, DAC and ADC, as compiled kernels that know no controller.

    drive [V] ─► DAC ─► latency ─► hysteresis ─► creep ─► (+ disturbance) ─► dynamics ─► sensor ─► ADC ─► reading [V]

Each stage is a module: its equation, its fields in the two records of a rig, its kernel; `rig` puts them together.
The hysteresis is written independently of any controller's inverse, so that no mistake can cancel itself out.
"""
