"""Prandtl-Ishlinskii models from recordings that start at rest or anywhere, judged on held-out data."""
