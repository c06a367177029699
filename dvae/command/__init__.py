"""Entry point of the program `dvae`: it imports the command, then runs it.

Importing torch takes seconds, and importing dvae may fail. Ctrl-C and an ImportError during the imports therefore print
one line instead of a traceback. This package is installed under a second name, `dvae_command`, outside dvae, so that it
can be imported without dvae.
"""

import os
import signal
import sys
from contextlib import suppress
from types import FrameType


def main() -> int:
    """Run the command line and return its exit code."""
    handled = signal.getsignal(signal.SIGINT) == signal.default_int_handler  # otherwise ignored, as under nohup
    if handled:
        signal.signal(signal.SIGINT, _interrupted)  # an import may turn a KeyboardInterrupt into another error
    try:
        from dvae.cli import command, main

        with suppress(ValueError):  # an unknown command; `main` reports it
            command(sys.argv[1:])
        from dvae.cli.app import exit_code
    except ImportError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if handled:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return exit_code(main)


def _interrupted(number: int, _: FrameType | None) -> None:
    os.write(2, b"interrupted\n")
    os._exit(128 + number)  # no work has started, so no cleanup is needed


if __name__ == "__main__":
    sys.exit(main())
