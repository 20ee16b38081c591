"""Power spectral density of a signal, averaged while its samples arrive; numbers only."""
