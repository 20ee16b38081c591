"""A controller judged by its specification, and its robustness: figures, text, page and pictures."""
