"""What every kernel stands on: how it is compiled, ordered access to shared memory, pointers, the clock."""
