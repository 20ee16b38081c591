"""Events of the loop as text for people: commands with their operator, trips, changed laws, late ticks."""
