"""Whether a host can keep a loop's deadlines: its settings one by one, its clock measured, and a verdict."""
