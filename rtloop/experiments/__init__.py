"""Experiments: procedures for any driver, and reports from their recordings.

`registry.EXPERIMENTS` lists them. Each has `runs`, the plan of the loop's actions, and `analyse`, which reads the
recordings alone. It may import service and design, and the rooms below them; `rtloop.cli.experiment` runs and
reports.
"""
