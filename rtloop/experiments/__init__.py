"""Experiments as procedures for any driver, and what their recordings say.

`rtloop.experiments.registry.EXPERIMENTS` lists them. Each has `runs`, which says what the loop is to do, and `analyse`,
which sees nothing but the recordings. `rtloop.cli.experiment` runs and reports.
"""
