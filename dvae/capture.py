"""CUDA graphs: a function of tensors is recorded once on a GPU, and replayed without Python.

Small networks leave a GPU idle while Python starts one kernel after the other. A CUDA graph starts all kernels of the
function at once. Its kernels and their shapes are those of the recording. Everything that changes between calls is
therefore in the tensors that the function receives, and the function must not read a value of the GPU.
"""

from __future__ import annotations

import gc
import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.weak import WeakIdKeyDictionary
from typing_extensions import override

WARM_UP = 3
"""Calls of a kind before its graph is recorded; libraries allocate memory and choose algorithms in the first ones."""
MOST_GRAPHS, MOST_KINDS = 16, 1000
"""Largest number of graphs, each with the memory of one call, and of kinds whose calls are counted."""
SYNCHRONIZES = "called a synchronizing CUDA operation"
"""Warning of torch for a synchronisation."""
PROTOTYPE = "Synchronization debug mode is a prototype"
"""Warning of torch for the mode that warns of synchronisations."""

_CHECKS: ContextVar[list[Tensor] | None] = ContextVar("checks", default=None)
Function = Callable[[Mapping[str, Tensor]], dict[str, Tensor]]
Tensors = TypeVar("Tensors", bound=Any)


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


class Captured:
    """Functions on a GPU that are replayed as CUDA graphs, one for each kind of call.

    The first calls of a kind run the function itself. The last of them count what a graph cannot repeat: reads of the
    GPU's values, uploads of other tensors and random numbers of the CPU. If there are any, calls of this kind always
    run the function, and a warning gives the reasons once. So do calls whose recording fails, for example because a
    library synchronises.

    Args:
        name: name of the functions, for warnings and errors.
        device: the GPU.
    """

    def __init__(self, name: str, device: torch.device) -> None:
        self.name = name
        self.device = device
        self.recording = False
        self.obstacles = dict[Hashable, list[str]]()
        self.graphs = dict[Hashable, _Graph]()
        self._stream: Any = torch.cuda.Stream(device)
        # one for all graphs, because the results of a call are read or copied before the next one
        self._pool: Any = torch.cuda.graph_pool_handle()
        self._calls = Counter[Hashable]()

    def __call__(self, kind: Hashable, function: Function, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the results of the function; the next replay of any graph may overwrite those of a graph.

        Args:
            kind: value that determines the function's operations, except for the shapes and types of the inputs.
            function: function from a dictionary of tensors on the GPU to another. Within a kind, it may depend on
                nothing else that changes, except parameters and buffers, which it may change in place.
            inputs: tensors by name, on the CPU or the GPU.
        """
        kind = (kind, *((name, value.shape, value.dtype) for name, value in inputs.items()))
        if kind in self.graphs:
            return self.graphs[kind].replay(inputs)
        device_inputs = {name: value.to(self.device, non_blocking=True) for name, value in inputs.items()}
        if len(self._calls) > MOST_KINDS:
            self._calls.clear()
        self._calls[kind] += 1
        if self._calls[kind] <= WARM_UP:
            return self._warm_up(kind, function, device_inputs)
        if kind in self.obstacles:
            return function(device_inputs)
        if len(self.graphs) == MOST_GRAPHS:
            self._warn(f"there are {MOST_GRAPHS} graphs for other shapes already")
            self.obstacles[kind] = []
            return function(device_inputs)
        try:
            self.graphs[kind] = self._record(function, device_inputs)
        except torch.cuda.OutOfMemoryError:
            raise
        except RuntimeError as error:
            self._warn(f"the recording failed: {error.__context__ or error}")
            self.obstacles[kind] = [str(error)]
            return function(device_inputs)
        return self.graphs[kind].replay(inputs)

    def checked(self, kind: Hashable, function: Function, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the results of a function that may call `defer`; no replay overwrites them.

        If a check fails, the function is called again with the same random numbers and without a graph, so that the
        check raises its error.
        """

        def record(inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
            with deferring() as checks:
                results = function(inputs)
            return {**results, "failed": any_failed(checks, self.device)}

        random = torch.get_rng_state(), torch.cuda.get_rng_state(self.device)
        results = {name: value.clone() for name, value in self(kind, record, inputs).items()}
        if not results.pop("failed"):
            return results
        torch.set_rng_state(random[0])
        torch.cuda.set_rng_state(random[1], self.device)
        return function({name: value.to(self.device) for name, value in inputs.items()})

    def clear(self) -> None:
        """Drop all graphs, and forget the calls."""
        self.graphs.clear()
        self.obstacles.clear()
        self._calls.clear()

    def _record(self, function: Function, inputs: Mapping[str, Tensor]) -> _Graph:
        memory = {name: value.clone() for name, value in inputs.items()}
        graph, current = torch.cuda.CUDAGraph(), torch.cuda.current_stream(self.device)
        gc.collect()  # the memory of a graph that is collected during a recording would invalidate it
        self.recording = True
        try:
            # other threads may use the GPU meanwhile
            with (
                _Reads() as reads,
                torch.cuda.graph(graph, self._pool, self._stream, capture_error_mode="thread_local"),
            ):
                results = function(memory)
        finally:
            self.recording = False
            torch.cuda.set_stream(current)  # torch does not leave the stream of a recording that fails
        return _Graph(graph, memory, results, [*reads.tensors.values()])

    def _warm_up(self, kind: Hashable, function: Function, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        """Run the function on the stream of the recording; the last two calls look for obstacles."""
        current, draws, caught = torch.cuda.current_stream(self.device), _HostDraws(), list[warnings.WarningMessage]()
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream), ExitStack() as stack:
            if self._calls[kind] == WARM_UP - 1:
                stack.enter_context(draws)
            elif self._calls[kind] == WARM_UP:
                caught = stack.enter_context(_synchronizations())
            results = function(inputs)
        current.wait_stream(self._stream)
        obstacles = list(draws.names)
        for each in caught:
            if SYNCHRONIZES in str(each.message):
                obstacles.append(f"{each.filename}:{each.lineno} reads a value of the GPU, or uploads one")
            elif PROTOTYPE not in str(each.message):
                warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
        if obstacles:
            self._warn("; ".join(dict.fromkeys(obstacles)))
            self.obstacles[kind] = obstacles
        return results

    def _warn(self, reasons: str) -> None:
        """Warn of the first kind without a graph."""
        if not self.obstacles:
            warnings.warn(f"{self.name} runs without a CUDA graph: {reasons}", stacklevel=5)


def replayed(
    captured: Captured | None, kind: Hashable, function: Callable[[Tensors], dict[str, Tensor]]
) -> Callable[[Tensors], dict[str, Tensor]]:
    """Return a function of a batch, replayed as a CUDA graph unless `captured` is None.

    Args:
        captured: the graphs.
        kind: as in `Captured`.
        function: function from a batch on the GPU to results, which may call `defer`.
    """
    if captured is None:
        return function
    return lambda batch: captured.checked(
        kind, lambda inputs: function(type(batch).from_leaves(inputs)), batch.leaves()
    )


class _Graph:
    """A recorded function.

    Args:
        graph: CUDA graph.
        memory: inputs of the recording by name, which each replay overwrites.
        results: results of the recording by name, which each replay overwrites.
        reads: all other tensors that the graph reads. They must stay in memory, such as constants in a cache.
    """

    def __init__(self, graph: Any, memory: dict[str, Tensor], results: dict[str, Tensor], reads: list[Tensor]) -> None:
        self.graph, self.memory, self.results, self.reads = graph, memory, results, reads

    def replay(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the results for new inputs."""
        for name, value in inputs.items():
            self.memory[name].copy_(value, non_blocking=True)
        self.graph.replay()
        return self.results


class _Reads(TorchDispatchMode):
    """Mode that collects the tensors that operations read without having computed them."""

    def __init__(self) -> None:
        super().__init__()
        self.tensors = dict[int, Tensor]()
        self._computed = WeakIdKeyDictionary()

    @override
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        for value in tree_leaves((args, kwargs)):
            if isinstance(value, Tensor) and value not in self._computed:
                self.tensors[id(value)] = value
        result = func(*args, **(kwargs or {}))
        self._computed.update({value: True for value in tree_leaves(result) if isinstance(value, Tensor)})
        return result


class _HostDraws(TorchDispatchMode):
    """Mode that lists the random operations on the CPU, whose results a graph would repeat."""

    def __init__(self) -> None:
        super().__init__()
        self.names = list[str]()

    @override
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if torch.Tag.nondeterministic_seeded in func.tags:
            tensors = [value for value in tree_leaves((args, kwargs, result)) if isinstance(value, Tensor)]
            if all(value.device.type == "cpu" for value in tensors):  # fused attention on a GPU has CPU seeds
                self.names.append(f"{func} draws on the CPU")
        return result


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
