"""Backends: what stands between the loop and a DAC and ADC.

A driver states facts (channels, ranges, highest rate) and has two verbs, `open` and `close`. To the loop it is a few C
function pointers. Third parties register under the entry-point group `rtloop.drivers`.
"""
