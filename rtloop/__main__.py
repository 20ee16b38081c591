"""`python -m rtloop`."""

import sys

if __name__ == "__main__":
    if not sys.flags.safe_path:
        del sys.path[0]  # the current folder, which may be somebody else's; imports begin below
    from rtloop.cli import main

    main()
