"""D(s) of recordings: by prediction error from open loops, by instrumental variables from closed ones."""
