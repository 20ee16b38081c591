"""Real-time part: the compiled loop, its clock, rings and commands, and the process that runs them.

Begin with `loop.run_ticks`. May import laws, kernel, drivers and the rooms below; not configuration or recording.
"""
