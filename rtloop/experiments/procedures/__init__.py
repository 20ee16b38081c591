"""The procedures: what each asks of the loop, and what its recordings say. One file each."""
