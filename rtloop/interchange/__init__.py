"""Other programs' files: measurements to import, and exports of recordings.

It may import recording and configuration, and the rooms below them. Begin with `importing.import_data` and
`export.export`. A reader in `formats` returns one table of evidence; `binding.bind` decides what it means, or asks.
"""
