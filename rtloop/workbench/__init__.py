"""The functions run, check, replay, identify and design of `rtloop`, for scripts and notebooks, with their results.

One file a function, with the class of its result; the files `*_text.py` print results as text. The command line calls
the same functions and prints the same results. This room reads no arguments of a process and ends none: a mistake of
the user raises RtloopError.
"""
