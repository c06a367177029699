"""The program `dvae`: finds and runs the command, prints its errors, and returns the exit code.

Exit codes: 0 success, 1 failure, 2 wrong arguments, 130 after Ctrl-C, 141 when the reader of the output has closed it,
143 after SIGTERM. A fit stopped by a signal can be resumed.
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
from ..inference.evaluation.result import PlainConsole, error_message
from ..options import nearest
from .console import ERROR, OUT, UsageError, is_first_process, note

UNREAD = 128 + getattr(signal, "SIGPIPE", 13)
"""The exit code of a program whose output pipe is closed, as shells report it."""

GROUPS = {
    "start": {
        "list": ("methods:list_methods", "List the methods with their equations and sources."),
        "show": ("methods:show", "Show two equations: joint distributions, audit of the guide, graph."),
        "data info": ("data:info", "Describe motion files, or tables with a schema to edit."),
        "data convert": ("data:convert", "Convert motion files to another format, rate or skeleton."),
        "data windows": ("assessment:windows", "Write the windows to forecast, for other software."),
        "data get": ("data:get", "Download and verify public recordings."),
    },
    "fit": {
        "fit": ("fitting:fit", "Fit a method, or your own equations, to motion or to a table."),
        "resume": ("fitting:resume", "Continue a run from its last checkpoint."),
        "sweep": ("fitting:sweep", "Fit methods with several seeds and options, several runs in parallel."),
    },
    "use": {
        "forecast": ("futures:forecast", "Draw forecasts, or motion along given paths of some joints."),
        "impute": ("futures:impute", "Draw missing values, or whole segments of motion from parts of them."),
        "generate": ("segments:generate", "Draw whole segments of motion from the prior of a latent space."),
        "animate": ("futures:animate", "Play forecasts or a clip as moving skeletons."),
    },
    "assess": {
        "evaluate": ("assessment:evaluate", "Score runs on test windows."),
        "backtest": ("backtests:backtest", "Fit methods to a table before several cutoffs, and score them after each."),
        "compare": ("assessment:compare", "Compare runs: bounds, paired differences with errors, use of latents."),
        "check calibration": ("checks:calibration", "Calibrate the guide by simulation, and check predictions."),
        "check posterior": ("checks:posterior", "Compare the guide with NUTS samples of the posterior."),
        "check gap": ("checks:gap", "Bound the evidence from both sides and decompose the gap of the ELBO."),
        "check coverage": ("checks:coverage", "Widen forecasts to bands with a given coverage, and test it."),
        "check edges": ("checks:edges", "Measure the cost of each edge of model and guide, left out in turn."),
        "report": ("report:report", "Write all results of some runs to one page."),
    },
}
"""Commands by group: {name: ("module:function", imported when it is called, line in `dvae --help`)}."""
COMMANDS = {name: entry for group in GROUPS.values() for name, entry in group.items()}
FAMILIES = {name.partition(" ")[0] for name in COMMANDS if " " in name}
"""First words of commands of two words."""


def named(arguments: Sequence[str]) -> str | None:
    """Return the name of the command in the arguments; None without a command.

    Raises:
        UsageError: the command is unknown.
    """
    words = arguments[: 2 if arguments and arguments[0] in FAMILIES else 1]
    if not words or words[-1].startswith("-") or (len(words) < 2 and words[0] in FAMILIES):
        return None
    name = " ".join(words)
    if name not in COMMANDS:
        available = [other for other in COMMANDS if len(words) == 1 or other.startswith(f"{words[0]} ")]
        raise UsageError(f"unknown command {name!r}{nearest(name, available)}; known: {', '.join(available)}")
    return name


def command(arguments: Sequence[str]) -> Callable[..., None] | None:
    """Import and return the command in the arguments; None without a command.

    Raises:
        UsageError: the command is unknown.
    """
    if (name := named(arguments)) is None:
        return None
    module, _, function = COMMANDS[name][0].partition(":")
    return getattr(import_module(f"{__package__}.{module}"), function)  # type: ignore[no-any-return]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        arguments: arguments of the command line; by default the arguments of the process.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [argument for argument in words if argument != "--debug"]
    warnings.showwarning = note
    OUT.quiet = ERROR.quiet = not is_first_process()
    PlainConsole.unread = False
    return _run_to_exit_code(words, debug) or (UNREAD if _is_unread() else 0)


def exit_code(run: Callable[[], int]) -> int:
    """Run the program and return its exit code; a Ctrl-C after the end of the command is ignored."""
    try:
        code = run()
    except KeyboardInterrupt:  # a second one, while the message of the first one is printed
        code = 128 + signal.SIGINT
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C during Python's shutdown would change the exit code
    return code


def _is_unread(line: str = "") -> bool:
    """Write a line to the standard output, and return whether its reader has closed it."""
    try:
        sys.stdout.write(line)
        sys.stdout.flush()
    except BrokenPipeError:
        OUT.on_broken_pipe()
    return PlainConsole.unread


def _run_to_exit_code(arguments: list[str], debug: bool) -> int:
    """Run the command with its arguments, print its error if it fails, and return its exit code."""
    try:
        _run(arguments)
        return 0
    except SystemExit as stop:  # tyro, after --help or wrong arguments
        if stop.code:
            for suggestion in _suggestions(arguments):
                ERROR.print(suggestion, markup=False)
        return stop.code if isinstance(stop.code, int) else 2
    except KeyboardInterrupt as stop:
        ERROR.print(str(stop) or "interrupted")
        return 128 + getattr(stop, "signal", signal.SIGINT)
    except Exception as error:
        if isinstance(error, BrokenPipeError) and _is_unread("\n"):
            return UNREAD
        ERROR.quiet = False  # this process may be the only one that fails
        if debug:
            traceback.print_exc()
        expected = isinstance(error, ValueError | OSError | RuntimeError | FloatingPointError | ImportError)
        hint = "" if expected or debug else " (this looks like a bug: --debug shows the traceback)"
        ERROR.print("error: ", style="bold red", end="")
        ERROR.print((error_message(error) or type(error).__name__) + hint)
        return 2 if isinstance(error, UsageError) else 1


def _run(arguments: list[str]) -> None:
    """Run the command with its arguments, or print help."""
    name, function = named(arguments), command(arguments)
    if function is not None and name is not None:
        remaining = arguments[len(name.split()) :]
        config = (tyro.conf.CascadeSubcommandArgs, tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone)
        if HELP & {*remaining}:
            from .help import command_stub

            function, method = command_stub(function, remaining, everything="--help-all" in remaining)
            name, remaining = name + method, ["--help"]
        tyro.cli(function, prog=f"dvae {name}", args=remaining, config=config)
    elif arguments == ["--version"]:
        OUT.print(f"dvae {__version__}")
    elif unknown := [argument for argument in arguments if argument.startswith("-") and argument not in HELP]:
        raise UsageError(f"unknown option {unknown[0]}; dvae takes a command, --help or --version")
    else:
        _overview(arguments[0] if arguments and arguments[0] in FAMILIES else "")
        if not HELP & {*arguments}:
            raise SystemExit(2)


HELP = {"-h", "--help", "--help-all"}


def _overview(family: str) -> None:
    """Print the commands by group, or the commands of a family such as `dvae check`."""
    OUT.print(f"usage: dvae {family or '[--version]'} COMMAND [--help] [--help-all] [options]\n", highlight=False)
    if not family:
        OUT.print("Dynamical variational autoencoders from their factorizations.\n", highlight=False)
    for group, commands in GROUPS.items():
        selected = {name: description for name, (_, description) in commands.items() if name.startswith(family)}
        if selected:
            OUT.print(group, style="bold", highlight=False)
            for name, description in selected.items():
                OUT.print(f"  {name:<18} {description}", highlight=False)
    OUT.print("\n--help lists the common options of a command, --help-all all of them; --debug shows tracebacks.")


def _suggestions(arguments: Sequence[str]) -> Iterator[str]:
    """Yield suggestions for misspelt options, methods and choices of options."""
    if (function := command(arguments)) is None:
        return
    from ..models.registry import methods, metric_models

    name = named(arguments) or ""
    remaining = arguments[len(name.split()) :]
    hints = get_type_hints(function)
    kinds = [
        *filter(is_dataclass, hints.values()),
        *(methods().values() if name in ("fit", "sweep", "backtest") else ()),
    ]
    for kind in kinds:  # nested dataclasses are appended during the loop
        hints = (nested := get_type_hints(kind)) | hints
        kinds += filter(is_dataclass, nested.values())
    options = {f"--{option.replace('_', '-')}" for option in [*hints, "from", "help", "help-all"]}
    for word in (word.partition("=")[0].replace("--no-", "--") for word in remaining if word.startswith("--")):
        if word not in options and (suggestion := nearest(word, options)):
            yield f"{word} is not an option of dvae {name}{suggestion}"
    choices = {option: _choices(hint) for option, hint in hints.items()}
    names = [*methods(), *metric_models()] if name == "fit" else choices.get("method")
    for previous, word in pairwise(["", *remaining]):
        option = previous if previous.startswith("--") else ""
        allowed = choices.get(option.removeprefix("--").replace("-", "_")) if option else names
        if allowed and word not in allowed and not word.startswith("-") and (suggestion := nearest(word, allowed)):
            yield f"{option} {word!r} is unknown{suggestion}".lstrip()


def _choices(hint: Any) -> list[str]:
    """Return the names that a type allows, at any depth."""
    if get_origin(hint) is Literal:
        return [name for name in get_args(hint) if isinstance(name, str)]
    return [name for part in get_args(hint) for name in _choices(part)]
