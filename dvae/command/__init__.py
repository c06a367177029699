"""The program `dvae`: what its command imports, in which Ctrl-C and a missing piece end it in a sentence, and then it.

Torch takes seconds to import, and dvae itself may be what cannot be imported. So this package is installed under a
second name, `dvae_command`, beside dvae and not within it.
"""

import os
import signal
import sys
from contextlib import suppress
from types import FrameType


def main() -> int:
    """Run the command line and return its exit code."""
    handled = signal.getsignal(signal.SIGINT) == signal.default_int_handler  # else it is ignored, as by nohup
    if handled:
        signal.signal(signal.SIGINT, _interrupted)  # a KeyboardInterrupt amid an import can come out as anything
    try:
        from dvae.cli import command, main

        with suppress(ValueError):  # no command, of which main tells
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
    os._exit(128 + number)  # nothing has begun, so there is nothing to end


if __name__ == "__main__":
    sys.exit(main())
