"""Files for a beginning: configurations, laws and drivers that run in an empty folder, and the demonstration.

`examples` copies the configurations of the paper, `stage`, `law` and `driver` fill the templates of `templates/`,
`new_files` writes them, `demonstration` runs a loop that needs no file.
"""
