"""What each command does, one module a command; numbers come from below, words from `rtloop.terminal`."""
