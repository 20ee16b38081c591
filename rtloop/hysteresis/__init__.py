"""Prandtl-Ishlinskii models over whole recordings: plays, the shape of loops, what a compensation leaves."""
