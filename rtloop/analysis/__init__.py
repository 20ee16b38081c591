"""What there is to know of a loop before it runs: margins, steps, how C(z) differs, how far something may move."""
