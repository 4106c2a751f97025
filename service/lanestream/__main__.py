"""Runs the command line: `python -m lanestream` is the command `lanestream`."""

from lanestream.cli import main

if __name__ == "__main__":
    main()
