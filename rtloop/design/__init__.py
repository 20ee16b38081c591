"""Design of controllers: transfer functions, discretisation, and the analysis of the loop before it runs."""
