"""Recovery by policy: the return to the former mode after a trip from outside, [service.recover]."""
