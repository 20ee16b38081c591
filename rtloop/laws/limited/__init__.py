"""A helper process that runs the code of user laws; it is killed if a law does not return."""
