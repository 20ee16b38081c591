"""Real-time part: the compiled loop, its clock, rings and commands, and the process that runs them."""
