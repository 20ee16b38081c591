"""What runs in real time: the compiled loop, its clock, its rings and its commands, and the process that they live in.

Nothing here knows the configuration's file; a plan says all that a run needs.
"""
