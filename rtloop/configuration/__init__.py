"""The configuration: options that a user writes, and the plan that is built from them. All errors occur here.

It may import analysis and recording, and everything below. Begin with `file.load` and `prepare.prepare`.
"""
