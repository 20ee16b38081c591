"""Measurement of a loop that stays closed: excitation, response with its uncertainty, margins, light mode, gain.

It may import what analysis may. Begin with `measurement.measure_loop`.
"""
