"""Prandtl-Ishlinskii models over whole recordings: plays, loop shapes and the residual hysteresis of a compensation."""
