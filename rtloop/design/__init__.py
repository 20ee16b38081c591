"""From recordings and specifications to a verified controller."""
