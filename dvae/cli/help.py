"""Help of one command: its common options with the defaults that apply, or all options.

Help is printed from a copy of the command's signature, which is never called. `--help` omits the options marked
`Expert`. An option without a default value shows where its value comes from.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import tyro

from ..inference.training.options import Training
from ..inference.training.recipe import Trainable
from .console import OUT

T = TypeVar("T")
EXPERT = "expert"
Expert = Annotated[T, EXPERT]
"""An option that `--help` omits and `--help-all` shows."""


def command_stub(
    function: Callable[..., None], arguments: Sequence[str], everything: bool
) -> tuple[Callable[..., None], str]:
    """Return a function that has a command's signature, for its help, and " METHOD" if a method is given.

    Args:
        function: function of the command.
        arguments: arguments of the command, which may name a method to fit.
        everything: whether to show expert options.
    """
    from ..models.registry import methods, metric_models

    hints = get_type_hints(function, include_extras=True)
    known: dict[str, type[Trainable]] = {**methods(), **metric_models()} if function.__name__ == "fit" else {}
    kind = next((known[word] for word in arguments if word in known), None)
    if known and kind is None:
        _list_methods(known)
    training_defaults = dict.fromkeys((option.name for option in fields(Training)), "default: the method's")
    defaults = training_defaults if kind is None else _training_defaults(kind)
    parameters = []
    for parameter in inspect.signature(function).parameters.values():
        hint = hints[parameter.name]
        if known and parameter.name == "method":
            if kind is None:
                continue
            hint = _method_options(kind, everything)
        elif EXPERT in get_args(hint) and not everything:
            continue
        elif is_dataclass(hint):
            hint = _copy_options(hint, everything, defaults)
            parameter = parameter.replace(default=inspect.Parameter.empty)  # the copy has the same defaults
        else:
            hint = _with_default(hint, parameter.default)
        parameters.append(parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY))

    def shown(**_: Any) -> None:
        """Do nothing; tyro prints the help of this function and never calls it."""

    shown.__doc__ = function.__doc__
    shown.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    shown.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return shown, "" if kind is None else f" {kind.name}"


def _with_default(hint: Any, default: Any, description: str | None = None) -> Any:
    """Return the type of an option, annotated with its default in words if that is a flag, missing or empty."""
    if not (default is None or isinstance(default, bool) or default in ((), "", {})):
        return hint
    words = description or (f"default: {_in_words(default)}" if isinstance(default, bool) else "optional")
    return Annotated[hint, tyro.conf.arg(help_behavior_hint=f"({words})")]


def _in_words(value: Any) -> str:
    """Return a default in words."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "none" if value is None or value in ((), "", {}) else str(value)


def _copy_options(kind: Any, everything: bool, defaults: Mapping[str, str], expert: Sequence[str] = ()) -> Any:
    """Return a subclass of a dataclass of options, for its help.

    Args:
        kind: dataclass of options.
        everything: whether to show expert options.
        defaults: {option: its default in words}.
        expert: further options to treat as expert options.
    """
    hints = get_type_hints(kind, include_extras=True)
    annotations, values = {}, {}
    for option in fields(kind):
        hint: Any = hints[option.name]
        default = option.default_factory() if option.default_factory is not MISSING else option.default
        hidden = not everything and (option.name in expert or EXPERT in get_args(hint))
        plain = get_args(hint)[0] if get_origin(hint) is Annotated else hint
        if is_dataclass(plain):
            hint = _copy_options(plain, everything, defaults)
            values[option.name] = field(default_factory=hint)
            hint = Annotated[hint, tyro.conf.Suppress] if hidden else hint
        else:
            if hidden:
                hint = Annotated[hint, tyro.conf.Suppress]
            if default is not MISSING:
                hint = _with_default(hint, default, defaults.get(option.name))
                factory = option.default_factory  # a mutable default needs one
                values[option.name] = field(default=default) if factory is MISSING else field(default_factory=factory)
        annotations[option.name] = hint
    body = {"__annotations__": annotations, "__doc__": kind.__doc__, "__post_init__": lambda self: None, **values}
    return dataclass(frozen=True)(type(kind.__name__, (kind,), body))


def _method_options(kind: type[Trainable], everything: bool) -> Any:
    """Return the options of a method; options shared with other methods are expert options."""
    own_options = {name for base in kind.__mro__ if base.__module__ == kind.__module__ for name in base.__annotations__}
    shared = [option.name for option in fields(kind) if option.name not in own_options and option.name != "latent"]
    presets: Mapping[str, Mapping[str, Any]] = getattr(kind, "presets", {})
    defaults = {}
    for option in fields(kind):
        by_data = {name: preset[option.name] for name, preset in presets.items() if option.name in preset}
        if by_data:
            defaults[option.name] = _by_preset(by_data)
    return _copy_options(kind, everything, defaults, shared)


def _training_defaults(kind: type[Trainable]) -> dict[str, str]:
    """Return the training defaults of a method, in words."""
    names = [option.name for option in fields(next(iter(kind.trainings.values())))]
    return {
        name: _by_preset(
            {data_name or kind.name: getattr(training, name) for data_name, training in kind.trainings.items()}
        )
        for name in names
    }


def _by_preset(values: Mapping[str, Any]) -> str:
    """Return the values by data preset, in words; a single value if all are equal."""
    descriptions = {name: _in_words(value) for name, value in values.items()}
    if len({*descriptions.values()}) == 1:
        name, value = next(iter(descriptions.items()))
        name = name if len(descriptions) == 1 else ""
        return f"default: {value}" + (f" ({name})" if name else "")
    return "default: " + ", ".join(f"{value} ({name or 'other data'})" for name, value in descriptions.items())


def _list_methods(trainables: Mapping[str, type[Trainable]]) -> None:
    """Print the methods by group, one line each."""
    groups: dict[str, list[type[Trainable]]] = {}
    for kind in trainables.values():
        groups.setdefault(_group(kind), []).append(kind)
    OUT.print("usage: dvae fit METHOD --out RUN [options]; `dvae fit METHOD --help` shows the options of a method.\n")
    for group, kinds in groups.items():
        OUT.print(group, style="bold", highlight=False)
        for kind in kinds:
            OUT.print(f"  {kind.name:<18} {kind.source}", highlight=False)
    OUT.print()


GROUPS = {"family": "classical DVAEs", "motion": "human motion", "baselines": "baselines"}


def _group(kind: type[Trainable]) -> str:
    parts = kind.__module__.split(".")
    return GROUPS.get(parts[2], parts[2]) if parts[1] == "models" else "evaluation networks"
