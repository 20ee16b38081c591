"""Measurement of a loop that stays closed: excitation, response with uncertainty, margins, lightly damped mode, gain.

It may import what analysis may. Begin with `measurement.measure_loop`.
"""
