"""A simulated GPU that lists the transfers and synchronisations of a program, on a machine without a GPU.

The tensors of torch's `FakeTensorMode` have no values, so a program that reads a value fails. Without a CUDA build
they also have no gradients. Here a tensor on the device wraps a tensor on the CPU, and its operations run there. An
operation that mixes the two devices raises an error, as in CUDA. Each copy between the devices is listed, and so is
each value on which the program synchronises.

CUDA graphs are simulated too: `torch.cuda.graph` records the operations on the device, and a read or an upload is an
error in it. A replay runs the same operations on the same tensors, so everything that Python decided in the recording
stays as it was, as on a GPU. It also overwrites the memory of graphs of the same pool that were recorded later, which
may reuse what this graph has freed.

A real GPU draws other random numbers than the CPU. Under `SameNoise` it uses the random numbers of the CPU, so results
agree.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self
from unittest import mock

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode
from typing_extensions import override

aten: Any = torch.ops.aten
READS = {  # CUDA synchronises to read the values, shapes or error codes of these operations
    aten._local_scalar_dense,
    aten.is_nonzero,
    aten.equal,
    aten.nonzero,
    aten.masked_select,
    aten._unique2,
    aten.unique_dim,
    aten.unique_consecutive,
    aten.repeat_interleave,
    aten.bincount,
    aten._linalg_check_errors,
}
INDEXED = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}
BENEATH = {"torch", "pyro", "zuko", "roma"}


class OnDevice(Tensor):
    """A CPU tensor that reports that it is on the device."""

    # a device number that no machine has: caches of real devices cannot be used by mistake
    device: ClassVar[torch.device] = torch.device("cuda", 127)  # type: ignore[misc]
    own: Tensor

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, own: Tensor, requires_grad: bool = False) -> Self:  # noqa: D102
        tensor: Any = Tensor._make_wrapper_subclass(
            cls, own.shape, own.stride(), own.storage_offset(), dtype=own.dtype, requires_grad=requires_grad
        )
        tensor.own = own
        return tensor  # type: ignore[no-any-return]

    @override
    def __repr__(self) -> str:  # type: ignore[override]
        return f"OnDevice({self.own!r})"

    @classmethod
    @override
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        raise RuntimeError(
            f"{func} of a tensor on {cls.device}, which exists only in a block of on_device(); call it there"
        )


class Traffic(TorchDispatchMode):
    """Transfers between CPU and device, each as "file:line operation" of its origin.

    Attributes:
        reads: copies to the CPU, and synchronisations: values, and shapes and errors that depend on values.
        uploads: copies to the device.
        tape: graph that records the operations, or None.
        sync_debug_mode: "warn" to warn of reads and uploads, as torch does on a GPU.
    """

    def __init__(self) -> None:
        super().__init__()
        self.reads: list[str] = []
        self.uploads: list[str] = []
        self.within = False
        self.tape: Tape | None = None
        self.sync_debug_mode: Any = "default"

    def note(self, transfers: list[str], operation: Any) -> None:
        """Add a transfer to a list; warn of it in debug mode, and raise an error while a graph is recorded."""
        origin = _origin(operation)
        transfers.append(origin)
        if self.tape is not None:
            raise RuntimeError(f"operation not permitted when stream is capturing: {origin}")
        if self.sync_debug_mode == "warn":
            path, _, line = origin.partition(" ")[0].rpartition(":")
            warnings.warn_explicit("called a synchronizing CUDA operation", UserWarning, path, int(line))

    def set_sync_debug_mode(self, mode: Any) -> None:
        """Replace `torch.cuda.set_sync_debug_mode`."""
        self.sync_debug_mode = mode

    def clear(self) -> None:
        """Clear both lists."""
        self.reads.clear()
        self.uploads.clear()

    @override
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = list(_tensors((*args, *kwargs.values())))
        device_tensors = {id(value.own): value for value in tensors if isinstance(value, OnDevice)}
        cpu_tensors = [value for value in tensors if not isinstance(value, OnDevice) and value.dim()]
        device, packet = kwargs.get("device"), func.overloadpacket
        is_requested = device is not None and device.type == "cuda"
        if is_requested:
            kwargs["device"] = torch.device("cpu")
            if tensors and not device_tensors:
                self.note(self.uploads, packet)
                cpu_tensors = []
        elif device_tensors and packet is aten.copy_:
            target, source = (isinstance(value, OnDevice) for value in args[:2])
            if target != source:
                self.note(self.uploads if target else self.reads, packet)
            cpu_tensors = []
        elif device_tensors and packet in INDEXED:
            indices = [index for index in args[1] if index is not None]
            fill = len(args) > 2 and args[2].numel() == 1  # filling under a mask needs no indices
            if any(index.dtype == torch.bool for index in indices) and not fill:
                self.note(self.reads, packet)
            if cpu_indices := [index for index in indices if not isinstance(index, OnDevice)]:
                self.note(self.uploads, packet)
                cpu_tensors = [value for value in cpu_tensors if all(value is not index for index in cpu_indices)]
        elif device_tensors and packet in READS:
            self.note(self.reads, packet)
        # tensors that torch creates in a function of device tensors are on the device too
        is_within = self.within and not tensors and device is not None
        if not (device_tensors or is_requested or is_within):
            return func(*args, **kwargs)
        if kwargs.get("generator") is not None:
            raise RuntimeError(f"{packet} on {OnDevice.device} with a generator of the CPU; draw without one")
        if cpu_tensors:
            shapes = ", ".join(str(tuple(value.shape)) for value in cpu_tensors)
            raise RuntimeError(
                f"{packet} of tensors on {OnDevice.device} and on the CPU {shapes}; move them to one device"
            )
        cpu_args = [_map_tensors(value, OnDevice, lambda v: v.own) for value in (*args, *kwargs.values())]
        run = func if self.tape is None else partial(self.tape.record, func)
        result = run(*cpu_args[: len(args)], **dict(zip(kwargs, cpu_args[len(args) :], strict=True)))
        if torch.Tag.inplace_view in func.tags:  # the wrapper stores its own shape
            with no_dispatch():
                func(*args, **kwargs)
        return _map_tensors(
            result, Tensor, lambda value: device_tensors[id(value)] if id(value) in device_tensors else OnDevice(value)
        )


class Tape:
    """A simulated `torch.cuda.CUDAGraph`."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, Any, Any, bool, list[Tensor]]] = []
        self.pool: list[Tape] = [self]
        self._own: set[int] = set()  # storages that the recording allocates
        self._changed: dict[int, tuple[Tensor, Tensor]] = {}  # other storages that it writes to, and their values

    def record(self, func: Any, *args: Any, **kwargs: Any) -> Any:
        """Run an operation and record it."""
        given = dict(zip([argument.name for argument in func._schema.arguments], args, strict=False)) | kwargs
        for argument in func._schema.arguments:
            is_running = argument.name.startswith("running_")  # batch norms write to it without saying so
            if is_running or (argument.alias_info is not None and argument.alias_info.is_write):
                for storage in map(Tensor.untyped_storage, _tensors([given.get(argument.name)])):
                    if storage.data_ptr() not in self._own | self._changed.keys():
                        whole = torch.empty(0, dtype=torch.uint8).set_(storage)  # type: ignore[call-overload]
                        self._changed[storage.data_ptr()] = whole, whole.clone()
        before = {tensor.untyped_storage().data_ptr() for tensor in _tensors([*args, *kwargs.values()])}
        # aliases, since an operation such as `t_` changes the shape of a tensor
        aliases = [_map_tensors(value, Tensor, Tensor.detach) for value in (*args, *kwargs.values())]
        call = func, aliases[: len(args)], dict(zip(kwargs, aliases[len(args) :], strict=True))
        result = func(*args, **kwargs)
        results = list(_tensors([result]))
        new = {tensor.untyped_storage().data_ptr() for tensor in results} - before
        self._own |= new
        if new or not results or (func._schema.is_mutable and torch.Tag.inplace_view not in func.tags):
            self.calls.append((*call, torch.is_grad_enabled(), [tensor.detach() for tensor in results]))
        return result

    def end(self, random_state: Tensor) -> None:
        """Undo the changes of a recording, because a GPU computes nothing while it records."""
        torch.set_rng_state(random_state)
        for whole, values in self._changed.values():
            whole.copy_(values)

    def replay(self) -> None:
        """Run the recorded operations again, with results in the recorded tensors."""
        for later in self.pool[self.pool.index(self) + 1 :]:
            later.spoil()
        for func, args, kwargs, is_training, recorded in self.calls:
            with no_dispatch(), torch.set_grad_enabled(is_training):  # oneDNN has other kernels in training
                for before, now in zip(recorded, _tensors([func(*args, **kwargs)]), strict=True):
                    if now.data_ptr() != before.data_ptr():
                        before.copy_(now)

    def spoil(self) -> None:
        """Overwrite all memory that the recording has allocated, with NaN in floating-point numbers."""
        for *_, recorded in self.calls:
            for storage in map(Tensor.untyped_storage, recorded):
                if storage.data_ptr() in self._own:
                    storage.fill_(255)  # type: ignore[attr-defined]


class _Moves(TorchFunctionMode):
    """Mode for moves between devices, which torch skips because both tensors are on the CPU."""

    def __init__(self, traffic: Traffic) -> None:
        super().__init__()
        self.traffic = traffic

    @override
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in (Tensor.to, Tensor.cpu, Tensor.cuda, Tensor.type_as):
            return self._move(func, args[0], [*args[1:], *kwargs.values()])
        if func in (Tensor.numpy, Tensor.__array__, Tensor.tolist) and isinstance(args[0], OnDevice):
            if func is not Tensor.tolist:
                raise TypeError(f"a tensor on {OnDevice.device} cannot become an array; move it to the CPU first")
            self.traffic.note(self.traffic.reads, "tolist")
            return args[0].own.tolist()
        before, self.traffic.within = self.traffic.within, any(isinstance(value, OnDevice) for value in _tensors(args))
        try:
            result = func(*args, **kwargs)
        finally:
            self.traffic.within = before
        if func is Tensor.new_tensor and isinstance(args[0], OnDevice) and not isinstance(result, OnDevice):
            self.traffic.note(self.traffic.uploads, "new_tensor")
            return OnDevice(result.detach(), result.requires_grad)
        return result

    def _move(self, func: Any, value: Tensor, args: list[Any]) -> Tensor:
        args = args + [arg for v in args if isinstance(v, Tensor) for arg in (v.device, v.dtype)]
        ends = {Tensor.cpu: "cpu", Tensor.cuda: "cuda"}
        device = next((arg for arg in args if isinstance(arg, str | torch.device)), ends.get(func, value.device))
        cast = Tensor.to(value, next((arg for arg in args if isinstance(arg, torch.dtype)), value.dtype))
        is_on_device = torch.device(device).type == "cuda"
        if is_on_device == isinstance(value, OnDevice):
            return cast
        if is_on_device:
            self.traffic.note(self.traffic.uploads, "to")
            return OnDevice(cast.detach().clone(), value.requires_grad)
        self.traffic.note(self.traffic.reads, "to")
        return cast.own.clone()  # type: ignore[attr-defined, no-any-return]


def _tensors(values: Iterable[Any]) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from _tensors(value)


def _map_tensors(value: Any, kind: type[Tensor], to: Callable[[Any], Tensor]) -> Any:
    """Return the value with its tensors of a kind replaced; torch's tree map would take most of the time of a step."""
    if isinstance(value, kind):
        return to(value)
    return type(value)([_map_tensors(each, kind, to) for each in value]) if isinstance(value, list | tuple) else value


def _origin(operation: Any) -> str:
    """Return the origin of an operation: the innermost line outside this file and the libraries in `BENEATH`."""
    frame: Any = sys._getframe(1)
    while frame.f_back and (
        (name := frame.f_globals.get("__name__", "")) == __name__ or name.partition(".")[0] in BENEATH
    ):
        frame = frame.f_back
    return f"{'/'.join(Path(frame.f_code.co_filename).parts[-2:])}:{frame.f_lineno} {operation}"


@contextmanager
def on_device() -> Iterator[Traffic]:
    """Simulate the device "cuda" in the block, and list the transfers to and from it.

    Example:
        >>> import torch
        >>> from dvae.testing.device import on_device
        >>> with on_device() as traffic:
        ...     there = torch.ones(3).to("cuda")
        ...     total = float(there.sum())
        >>> total, len(traffic.uploads), len(traffic.reads)
        (3.0, 1, 1)
    """
    lifting = torch._C._only_lift_cpu_tensors()
    with ExitStack() as stack:
        for name in ("_lazy_init", "get_rng_state", "set_rng_state"):  # all draws use the random state of the CPU
            stack.enter_context(mock.patch.object(torch.cuda, name, return_value=torch.empty(0, dtype=torch.uint8)))
        torch._C._set_only_lift_cpu_tensors(True)  # so that torch.tensor(..., device=...) moves them with `to`
        stack.callback(torch._C._set_only_lift_cpu_tensors, lifting)
        traffic = stack.enter_context(Traffic())

        @contextmanager
        def graph(tape: Tape, pool: list[Tape], *_: Any, **__: Any) -> Iterator[None]:
            pool.append(tape)
            traffic.tape, tape.pool, random_state = tape, pool, torch.get_rng_state()
            try:
                yield
            finally:
                traffic.tape = None
                with no_dispatch():
                    tape.end(random_state)

        stream = mock.MagicMock()
        replacements = {
            "CUDAGraph": Tape,
            "Stream": stream,
            "stream": stream,
            "current_stream": stream,
            "set_stream": stream,
            "graph": graph,
            "graph_pool_handle": list,
            "set_sync_debug_mode": traffic.set_sync_debug_mode,
            "get_sync_debug_mode": lambda: traffic.sync_debug_mode,
        }
        for name, replacement in replacements.items():
            stack.enter_context(mock.patch.object(torch.cuda, name, replacement))
        by_device = torch.optim.Optimizer._group_tensors_by_device_and_dtype

        def group(lists: Any, with_indices: bool = False) -> Any:  # torch's reads the device of the CPU tensor
            groups = by_device(lists, with_indices)
            is_on_device = isinstance(lists[0][0], OnDevice)
            return {(OnDevice.device if is_on_device else d, dtype): v for (d, dtype), v in groups.items()}

        stack.enter_context(mock.patch.object(torch.optim.Optimizer, by_device.__name__, staticmethod(group)))
        stack.enter_context(_Moves(traffic))
        yield traffic


class SameNoise(TorchDispatchMode):
    """Mode that draws the random numbers of a GPU on the CPU, from the CPU's seed, and copies them to the GPU.

    It does not support generators of the GPU, and does not copy draws into `out=`.
    """

    @override
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        device = next((value.device for value in _tensors((*args, *kwargs.values()))), None)
        device = torch.device(kwargs.get("device") or device or "cpu")
        # cuDNN networks and fused attention have this tag because of dropout, but no CPU kernel
        has_cpu_kernel = torch._C._dispatch_has_computed_kernel_for_dispatch_key(func.name(), "CPU")
        if torch.Tag.nondeterministic_seeded not in func.tags or device.type == "cpu" or not has_cpu_kernel:
            return func(*args, **kwargs)
        if "device" in kwargs:
            kwargs["device"] = torch.device("cpu")
        cpu_args = [_map_tensors(value, Tensor, Tensor.cpu) for value in (*args, *kwargs.values())]
        draws = func(*cpu_args[: len(args)], **dict(zip(kwargs, cpu_args[len(args) :], strict=True)))
        if func.overloadpacket.__name__.endswith("_"):
            return args[0].copy_(draws)
        return _map_tensors(draws, Tensor, lambda value: value.to(device))


def move(module: nn.Module) -> nn.Module:
    """Move the parameters and buffers of a module to the device, as `to` does, and nothing else."""
    copies: dict[int, Any] = {}
    for part in module.modules():
        for name, value in part._parameters.items():
            if value is not None and not isinstance(value, OnDevice):
                parameter = copies.setdefault(id(value), nn.Parameter(OnDevice(value.detach()), value.requires_grad))
                setattr(part, name, parameter)
        for name, buffer in part._buffers.items():
            if buffer is not None and not isinstance(buffer, OnDevice):
                part._buffers[name] = copies.setdefault(id(buffer), OnDevice(buffer))
    return module
