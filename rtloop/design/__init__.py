"""Design of verified controllers from recordings and specifications."""
