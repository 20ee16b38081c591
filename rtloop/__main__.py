"""`python -m rtloop`."""

from rtloop.cli import main

if __name__ == "__main__":
    main()
