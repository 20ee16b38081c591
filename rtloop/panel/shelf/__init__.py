"""The recordings of a service, as a page asks for them."""
