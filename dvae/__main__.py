"""Run the command line with `python -m dvae`."""

import sys

from .cli.app import exit_code, main

if __name__ == "__main__":
    sys.exit(exit_code(main))
