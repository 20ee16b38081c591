"""Code of somebody's own laws, run in a process beside this one that is killed where it does not come to an end."""
