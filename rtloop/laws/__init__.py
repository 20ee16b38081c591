"""Laws as plug-ins: the contract, the shipped ones, and how one becomes what the loop calls."""
