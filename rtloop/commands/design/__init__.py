"""What `rtloop design` does, from files to files and words: a module a command, or two that share their steps."""
