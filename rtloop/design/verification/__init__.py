"""A controller judged by its specification, and how robust it is: figures, words, page and pictures."""
