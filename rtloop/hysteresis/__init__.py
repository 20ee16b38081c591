"""Prandtl-Ishlinskii models: plays over whole recordings, loop shapes, residual hysteresis of a compensation.

This room imports only `rtloop.foundation`. Begin reading with `play_model`, then `plays` and `compensation`.
"""
