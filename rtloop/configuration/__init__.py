"""The configuration: options that a user writes, and the plan that is built from them. All errors occur here.

It may import analysis, recording and the rooms below them. Begin with `file.load` and `prepare.prepare`.
"""
