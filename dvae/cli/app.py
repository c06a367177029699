"""The program: which command is meant, what it leaves, and how it fails.

Exit codes: 0 done, 1 failed, 2 wrong arguments, 130 after Ctrl-C, 141 when nobody reads what is printed, 143 after
SIGTERM. A fit that a signal stopped can be resumed.
"""

from __future__ import annotations

import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import is_dataclass
from importlib import import_module
from itertools import pairwise
from typing import Any, Literal, get_args, get_origin, get_type_hints

import tyro

from .. import __version__
from ..inference.evaluation.result import Plain, reason
from ..options import nearest
from .console import ERROR, OUT, UsageError, note, speaks

UNREAD = 128 + getattr(signal, "SIGPIPE", 13)
"""The exit code that a shell gives to a program whose output nobody reads."""

COMMANDS = {
    "list": ("methods:list_methods", "List the methods: their equations and where they come from."),
    "show": ("methods:show", "Show two equations: the joint distributions, the audit of the guide, and the graph."),
    "fit": ("fitting:fit", "Fit a method, or equations of your own, to motion data."),
    "resume": ("fitting:resume", "Continue a run from its last checkpoint."),
    "sweep": ("fitting:sweep", "Fit methods with several seeds and sizes, several runs at a time."),
    "evaluate": ("judging:evaluate", "Score runs on test windows."),
    "criticise": ("judging:criticise", "Is a run's guide calibrated, and do its motions look like real ones?"),
    "reference": ("judging:reference", "Put what a run's guide says of latents beside their posterior."),
    "tubes": ("judging:tubes", "Widen a run's forecasts to tubes that hold the future as often as they say."),
    "compare": (
        "judging:compare",
        "Compare runs on test windows: bounds, paired differences with their errors, use of latents.",
    ),
    "ablate": ("ablation:ablate", "What every arrow of a model and its guide is worth: on twins, and fitted to data."),
    "bracket": ("judging:bracket", "A run's evidence between two bounds, and where its ELBO falls short of it."),
    "forecast": ("futures:forecast", "Forecast the test windows, or those of one clip, many times each."),
    "complete": ("futures:complete", "Complete motion along paths of some joints, from a clip or from a file."),
    "interpolate": ("segments:interpolate", "Go from one segment of motion to another in a run's latent space."),
    "recover": ("segments:recover", "Recover whole segments of motion from what was seen of them, and how surely."),
    "impute": ("futures:impute", "Fill in the joints that windows or clips lack, several times each."),
    "animate": ("futures:animate", "Play forecasts beside what happened, or a clip, as moving skeletons."),
    "report": ("report:report", "Put what is known of runs on one page, with moving futures."),
    "data": ("data:data", "Look into motion files."),
}
"""Name to "module:function", imported when it is meant, and what `dvae --help` says of it."""


def command(given: Sequence[str]) -> Callable[..., None] | None:
    """The command that the arguments name, imported; None if they name none.

    Raises:
        UsageError: an unknown one.
    """
    if not given or given[0].startswith("-"):
        return None
    if given[0] not in COMMANDS:
        raise UsageError(f"unknown command {given[0]!r}{nearest(given[0], COMMANDS)}; known: {', '.join(COMMANDS)}")
    module, _, name = COMMANDS[given[0]][0].partition(":")
    return getattr(import_module(f"{__package__}.{module}"), name)  # type: ignore[no-any-return]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        arguments: those of the process by default.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    given = [argument for argument in given if argument != "--debug"]
    warnings.showwarning = note
    OUT.quiet = ERROR.quiet = not speaks()
    Plain.unread = False
    return _ended(given, debug) or (UNREAD if _is_unread() else 0)


def exit_code(run: Callable[[], int]) -> int:
    """Run the program and return its exit code, which a further Ctrl-C no longer changes."""
    try:
        code = run()
    except KeyboardInterrupt:  # another one, amid what the first one prints
        code = 128 + signal.SIGINT
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Python ends as a signal does if one comes while it shuts down
    return code


def _is_unread(line: str = "") -> bool:
    """Return whether the reader of the standard output has closed it, after writing a line to it."""
    try:
        sys.stdout.write(line)
        sys.stdout.flush()
    except BrokenPipeError:
        OUT.on_broken_pipe()
    return Plain.unread


def _ended(given: list[str], debug: bool) -> int:
    """Run the command with its arguments, print how it fails, and return its exit code."""
    try:
        _run(given)
        return 0
    except SystemExit as stop:  # tyro, after --help or wrong arguments
        if stop.code:
            for meant in _meant(given):
                ERROR.print(meant, markup=False)
        return stop.code if isinstance(stop.code, int) else 2
    except KeyboardInterrupt as stop:
        ERROR.print(str(stop) or "interrupted")
        return 128 + getattr(stop, "signal", signal.SIGINT)
    except Exception as error:
        if isinstance(error, BrokenPipeError) and _is_unread("\n"):
            return UNREAD
        ERROR.quiet = False  # it may be this process alone that fails
        if debug:
            traceback.print_exc()
        expected = isinstance(error, ValueError | OSError | RuntimeError | FloatingPointError | ImportError)
        hint = "" if expected or debug else " (this looks like a bug: --debug shows the traceback)"
        ERROR.print("error: ", style="bold red", end="")
        ERROR.print((reason(error) or type(error).__name__) + hint)
        return 2 if isinstance(error, UsageError) else 1


def _run(given: list[str]) -> None:
    """Runs the command with its arguments; without one, tyro says which there are."""
    meant = command(given)
    if meant is not None:
        config = (tyro.conf.CascadeSubcommandArgs, tyro.conf.OmitArgPrefixes)
        tyro.cli(meant, prog=f"dvae {given[0]}", args=given[1:], config=config)
        return
    if given == ["--version"]:
        OUT.print(f"dvae {__version__}")
        return
    app = tyro.extras.SubcommandApp()
    for name, (_, about) in COMMANDS.items():
        app.command(name=name, help=about)(lambda: None)
    app.cli(
        prog="dvae",
        description="Dynamical variational autoencoders from their factorizations. "
        "With --debug, a failure shows its traceback; --version alone prints the version.",
        args=given,
    )


def _meant(given: Sequence[str]) -> Iterator[str]:
    """Sentences on names that are none, but near to one: of options, of methods, and the choices of options."""
    if (called := command(given)) is None:
        return
    from ..models.registry import judges, methods

    name, *rest = given
    hints = get_type_hints(called)
    kinds = [*filter(is_dataclass, hints.values()), *(methods().values() if name in ("fit", "sweep") else ())]
    for kind in kinds:
        hints = get_type_hints(kind) | hints
    options = {f"--{option.replace('_', '-')}" for option in [*hints, "from", "to", "help"]}
    for word in (word.partition("=")[0].replace("--no-", "--") for word in rest if word.startswith("--")):
        if word not in options and (meant := nearest(word, options)):
            yield f"{word} is no option of dvae {name}{meant}"
    choices = {option: _choices(hint) for option, hint in hints.items()}
    names = {"fit": [*methods(), *judges()], "sweep": choices.get("method"), "data": choices.get("action")}.get(name)
    for before, word in pairwise(["", *rest]):
        option = before if before.startswith("--") else ""
        known = choices.get(option.removeprefix("--").replace("-", "_")) if option else names
        if known and word not in known and not word.startswith("-") and (meant := nearest(word, known)):
            yield f"{option} {word!r} is unknown{meant}".lstrip()


def _choices(hint: Any) -> list[str]:
    """The names that a type allows, wherever in it they are."""
    if get_origin(hint) is Literal:
        return [name for name in get_args(hint) if isinstance(name, str)]
    return [name for part in get_args(hint) for name in _choices(part)]
