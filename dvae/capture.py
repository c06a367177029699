"""CUDA graphs: a function of tensors is recorded once on a GPU, and replayed without Python.

Small networks leave a GPU idle while Python starts one kernel after the other. A CUDA graph starts all kernels of the
function at once. Its kernels and their shapes are those of the recording, so everything that changes between calls is
in the tensors that the function receives, and the function must not read a value of the GPU.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from typing_extensions import override

WARM_UP = 3
"""Calls of a kind before its graph is recorded; libraries allocate memory and choose algorithms in the first ones."""
SYNCHRONIZES = "called a synchronizing CUDA operation"
"""Warning of torch for a synchronisation."""
MOST_GRAPHS, MOST_KINDS = 16, 1000
"""Largest number of graphs, each with the memory of one call, and of kinds whose calls are counted."""

_CHECKS: ContextVar[list[Tensor] | None] = ContextVar("checks", default=None)


@contextmanager
def deferring() -> Iterator[list[Tensor]]:
    """Collect the checks of `defer` in a list within the block, so that no check reads a value of the GPU."""
    checks = list[Tensor]()
    token = _CHECKS.set(checks)
    try:
        yield checks
    finally:
        _CHECKS.reset(token)


def is_deferring() -> bool:
    """Return whether the caller may not read values of the GPU."""
    return _CHECKS.get() is not None


def defer(failed: Tensor) -> bool:
    """Leave a check to the caller of `deferring`, and return whether there is one.

    Args:
        failed: boolean scalar, True if the check has failed.
    """
    checks = _CHECKS.get()
    if checks is not None:
        checks.append(failed)
    return checks is not None


def any_failed(checks: list[Tensor], device: torch.device) -> Tensor:
    """Return a boolean scalar, True if any of the collected checks has failed."""
    return torch.stack(checks).any() if checks else torch.zeros((), dtype=torch.bool, device=device)


class _HostDraws(TorchDispatchMode):
    """Mode that lists the random operations on the CPU, whose results a graph would repeat."""

    def __init__(self) -> None:
        super().__init__()
        self.names = list[str]()

    @override
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        results = result if isinstance(result, tuple) else (result,)
        if torch.Tag.nondeterministic_seeded in func.tags and any(each.device.type == "cpu" for each in results):
            self.names.append(f"{func} draws on the CPU")
        return result


class Captured:
    """A function on a GPU that is replayed as a CUDA graph, one for each kind of call.

    The first calls of a kind run the function itself. The last of them counts what a graph cannot repeat: reads of the
    GPU's values, uploads of other tensors and random numbers of the CPU. If there are any, calls of this kind always
    run the function, and a warning gives the reasons once.

    Args:
        function: function from a dictionary of tensors on the GPU to another. Within a kind, it may depend on nothing
            else that changes, except parameters and buffers, which it may change in place.
        name: name of the function, for the warning.
        device: the GPU.
    """

    def __init__(
        self, function: Callable[[Mapping[str, Tensor]], dict[str, Tensor]], name: str, device: torch.device
    ) -> None:
        self.function = function
        self.name = name
        self.device = device
        self.stream: Any = torch.cuda.Stream(device)
        self.obstacles = dict[Hashable, list[str]]()
        self._calls = Counter[Hashable]()
        self.graphs = dict[Hashable, tuple[Any, dict[str, Tensor], dict[str, Tensor]]]()

    def __call__(self, kind: Hashable, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the results of the function; those of a graph are overwritten by its next replay.

        Args:
            kind: value that determines the function's operations, except for the shapes and types of the inputs.
            inputs: tensors by name, on the CPU or the GPU.
        """
        kind = (kind, *((name, value.shape, value.dtype) for name, value in inputs.items()))
        if kind in self.graphs:
            graph, memory, results = self.graphs[kind]
            for name, value in inputs.items():
                memory[name].copy_(value, non_blocking=True)
            graph.replay()
            return results
        device_inputs = {name: value.to(self.device, non_blocking=True) for name, value in inputs.items()}
        if len(self._calls) > MOST_KINDS:
            self._calls.clear()
        self._calls[kind] += 1
        if kind in self.obstacles or len(self.graphs) == MOST_GRAPHS or self._calls[kind] <= WARM_UP:
            return self._run(kind, device_inputs)
        memory = {name: value.clone() for name, value in device_inputs.items()}
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=self.stream):
            results = self.function(memory)
        self.graphs[kind] = graph, memory, results
        graph.replay()
        return results

    def _run(self, kind: Hashable, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        """Run the function without a graph, and find obstacles in the last warm-up calls."""
        if self._calls[kind] > WARM_UP:
            return self.function(inputs)
        current, draws, caught = torch.cuda.current_stream(self.device), _HostDraws(), list[warnings.WarningMessage]()
        self.stream.wait_stream(current)
        with torch.cuda.stream(self.stream), ExitStack() as stack:  # the stream of the recording
            if self._calls[kind] == WARM_UP - 1:
                stack.enter_context(draws)
            elif self._calls[kind] == WARM_UP:
                caught = stack.enter_context(_synchronizations())
            results = self.function(inputs)
        current.wait_stream(self.stream)
        places = [f"{each.filename}:{each.lineno}" for each in caught if SYNCHRONIZES in str(each.message)]
        for each in caught:
            if SYNCHRONIZES not in str(each.message):
                warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
        obstacles = [*draws.names, *(f"{place} reads a value of the GPU, or uploads one" for place in places)]
        if obstacles:
            if not self.obstacles:
                reasons = "; ".join(dict.fromkeys(obstacles))
                warnings.warn(f"{self.name} runs without a CUDA graph: {reasons}", stacklevel=5)
            self.obstacles[kind] = obstacles
        return results


@contextmanager
def _synchronizations() -> Iterator[list[warnings.WarningMessage]]:
    """Collect the warnings of the block in a list, including one for each synchronisation with the GPU."""
    before = torch.cuda.get_sync_debug_mode()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield caught
        finally:
            torch.cuda.set_sync_debug_mode(before)
