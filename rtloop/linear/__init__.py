"""Linear systems: transfer functions, state spaces, discretisation, anti-windup, and controllers of several axes.

This room imports only `rtloop.foundation`, numpy and scipy. Begin with `transfer`, `realisation` and `discretise`.
"""
