"""The stages between a drive and a reading, one module each: equation, fields of its records, kernel."""
