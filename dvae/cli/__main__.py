"""Run the command line with `python -m dvae.cli`."""

import sys

from .app import exit_code, main

if __name__ == "__main__":
    sys.exit(exit_code(main))
