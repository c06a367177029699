"""Inner functions that torch.compile makes faster, compiled in runs that ask for it (`Training.compile`).

Not a whole program: Pyro's handlers break its graph sixteen times a step, and it is slower then. Nor, on a processor,
networks: their time goes into products, which are the same compiled, and into activations, for which torch has faster
code than it generates. What gains are many operations on each of many numbers, as in energies and kinematics of motion
(`benchmarks/compiled.py` measures it). Such a function is marked by `compiled`; nothing else is ever compiled.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import wraps
from types import FunctionType
from typing import Any

import torch
from pyro import settings
from torch import Tensor

MARKED: dict[str, Callable[..., Tensor]] = {}
"""The functions that are marked, by name."""
_FORMS: dict[Any, Callable[..., Tensor]] = {}


@dataclass(frozen=True)
class Compiling:
    """What is compiled, and how.

    Args:
        backend: of torch.compile.
        used: names of the functions that have run compiled.
    """

    backend: str
    used: set[str] = field(default_factory=set)


_ASKED: ContextVar[Compiling | None] = ContextVar("compiling", default=None)


@contextmanager
def compiling(backend: str = "inductor") -> Iterator[Compiling]:
    """Within it functions that are marked run compiled; their gradients are taken within it too.

    Example:
        >>> from dvae.compiled import compiled, compiling
        >>> double = compiled(lambda x: x + x)
        >>> with compiling("eager"):
        ...     double(torch.ones(2))
        tensor([2., 2.])
    """
    from torch._functorch import config

    token = _ASKED.set(found := Compiling(backend))
    try:
        with config.patch(donated_buffer=False):  # or no gradient could be taken twice, as some objectives do
            yield found
    finally:
        _ASKED.reset(token)


def requested() -> bool:
    """Whether functions that are marked run compiled, for callers who have another way beside them."""
    return _ASKED.get() is not None


def compiled(function: Any) -> Callable[..., Tensor]:
    """Marks a function that is faster compiled.

    What it returns depends on its arguments alone, tensors and what can be hashed, which it does not change. It is
    compiled anew for other shapes, which are therefore to be the same from step to step.
    """

    @wraps(function)
    def run(*arguments: Any) -> Tensor:
        asked = _ASKED.get()
        if asked is None:
            found: Tensor = function(*arguments)
            return found
        asked.used.add(function.__qualname__)
        key = function, asked.backend, torch.is_grad_enabled(), *map(_kind, arguments)
        if key in _FORMS:
            return _FORMS[key](*arguments)
        # A code of its own: of one code torch compiles eight forms at most, and which depends on those before, so that
        # a run that is resumed could have other ones.
        code = function.__code__.replace()
        own = FunctionType(code, function.__globals__, function.__name__, function.__defaults__, function.__closure__)
        with _undisturbed():
            form = torch.compile(own, dynamic=False, fullgraph=True, backend=asked.backend)
            found = form(*arguments)
            if found.requires_grad:  # the backward pass is compiled when it is first run
                given = [value for value in arguments if isinstance(value, Tensor) and value.requires_grad]
                torch.autograd.grad(found.sum(), given)
                found = form(*arguments)
        _FORMS[key] = form
        return found

    MARKED[function.__qualname__] = run
    return run


def require_compiler(device: torch.device) -> None:
    """Compiles a trifle.

    Raises:
        RuntimeError: there is no compiler for the device, or not all that it needs.
    """
    try:
        with compiling():
            _trifle(torch.ones(2, device=device))
    except Exception as error:
        needed = "a C++ compiler and Python's headers" if device.type == "cpu" else "Triton and a C compiler"
        lines = [line for line in str(error).splitlines() if line.strip() and not line.endswith("raised:")]
        said = lines[0] if lines else "it does not say why"
        raise RuntimeError(
            f"compile=True takes {needed}, and torch cannot compile for {device.type} here ({type(error).__name__}: "
            f"{said}); install them (on Debian and Ubuntu: apt install g++ python3-dev), name another compiler by the "
            "variable CXX, or leave compile out"
        ) from error


@compiled
def _trifle(x: Tensor) -> Tensor:
    return x + 1


def _kind(argument: Any) -> Any:
    """What another form is compiled for."""
    if not isinstance(argument, Tensor):
        return argument
    return argument.shape, argument.stride(), argument.dtype, argument.device, argument.requires_grad


@contextmanager
def _undisturbed() -> Iterator[None]:
    """What is compiled within it leaves no trace: torch warns of its own parts, and turns off, for the whole process,
    that distributions check their arguments.
    """
    checked = settings.get("validate_distributions_torch")
    with warnings.catch_warnings(), settings.context(validate_distributions_torch=checked):
        warnings.simplefilter("ignore")
        yield
