"""Prandtl-Ishlinskii models of recordings: from rest, or from whatever there is; what is held out judges them."""
