"""What each command does, a module a command; numbers come from below, words from `rtloop.terminal`."""
