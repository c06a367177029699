"""Training in several processes, on one machine or several: exchange of gradients, and errors if a process is lost.

Each process draws its own batches (synchronous data parallelism). Before a step of the optimiser, gradients are
averaged, as if one process had all these batches. They are sent together with the loss in one message, because models
are small and the number of messages costs more than their size. On two cores, 1,000 numbers took 0.32 ms, and 300,000
took 0.49 ms, so buckets that are sent during the backward pass would cost more than they save. torch's own wrapper
sends gradients in buckets, copies buffers at every pass, and refuses a parameter without a gradient.

lightning-fabric starts the processes on one machine, torchrun those on several (`docs/how-to/scale_and_gpus.md`).
"""

import atexit
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, distributed, nn

from .options import Training

if TYPE_CHECKING:
    from lightning_fabric import Fabric

LONGEST_WAIT = timedelta(minutes=10)
"""Time limit for a process that does not answer, for example after a network failure.

A process that has ended is detected at once.
"""


class LostProcess(RuntimeError):
    """Error if another process of the run has ended, or does not answer."""


def launch(training: Training) -> "Fabric":
    """Start the processes of a run, or join those that torchrun has started.

    Raises:
        ValueError: when the number of processes that torchrun has started differs from `devices`, the program is not in
            a file and cannot be started again, or the accelerator is not available.
    """
    _check(training)
    from lightning_fabric import Fabric  # the import takes over a second, half the time of `import dvae`
    from lightning_fabric.strategies.ddp import DDPStrategy

    class Unwrapped(DDPStrategy):
        def setup_module(self, module: nn.Module) -> nn.Module:  # type: ignore[override]
            return module

    local_processes, hosts = _count_processes(training.devices)
    fabric: Fabric = Fabric(
        accelerator=training.accelerator,
        devices=local_processes,
        num_nodes=hosts,
        precision=training.precision,
        strategy=Unwrapped(timeout=LONGEST_WAIT) if local_processes * hosts > 1 else "auto",
    )
    fabric.launch()
    if fabric.world_size > 1:
        atexit.unregister(_leave)
        atexit.register(_leave)
    return fabric


def is_torchrun() -> bool:
    """Return whether torchrun has started this process."""
    return distributed.is_available() and distributed.is_torchelastic_launched()


def is_restartable() -> bool:
    """Return whether torchrun restarts the processes when one of them has ended (`--max-restarts`).

    torchrun does not count restarts that another host has requested.
    """
    return is_torchrun() and os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0") != "0"


def seed_of(seed: int, process: int) -> int:
    """Return the seed of a process: the run's seed for the first, independent derived seeds for the others."""
    return int(np.random.SeedSequence([seed % 2**64, process]).generate_state(1)[0]) if process else seed


def sum_over_processes(fabric: "Fabric", value: Tensor) -> Tensor:
    """Return the sum over the processes."""
    return _all_reduce(value.to(fabric.device, copy=True)) if fabric.world_size > 1 else value


def average_gradients(
    fabric: "Fabric", parameters: Sequence[nn.Parameter], loss: Tensor, frames: Tensor, flags: Sequence[bool] = ()
) -> tuple[Tensor, Tensor | float, Tensor]:
    """Average gradients over processes, weighted by steps, as for one batch of the sequences of all processes.

    A parameter that has no gradient in any process remains without one.

    Args:
        fabric: fabric of the processes.
        parameters: trained parameters, after the backward pass.
        loss: loss of this process's batch, a scalar.
        frames: number of steps in this process's batch, a scalar.
        flags: flags of this process, in the same message, because each message may take a tenth of a step.

    Returns:
        The loss of the joint batch, this process's share of its steps, and a number for each flag, above 0 if the flag
        of any process is set.
    """
    if fabric.world_size == 1:
        return loss.detach(), 1.0, loss.new_zeros(len(flags))
    has_gradient = [parameter.grad is not None for parameter in parameters]
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
    numbers = torch.tensor([1.0, *flags, *has_gradient], device=loss.device)
    message = torch.cat([loss.detach()[None], numbers, *(gradient.flatten() for gradient in gradients)])
    joint = _all_reduce(message.mul_(frames))
    all_frames = joint[1].clone()
    total_loss, _, any_flags, counts, *means = joint.div_(all_frames).split(
        [1, 1, len(flags), len(has_gradient), *(p.numel() for p in parameters)]
    )
    has_any_gradient = has_gradient if all(has_gradient) else (counts > 0).tolist()
    for parameter, mean, has_any in zip(parameters, means, has_any_gradient, strict=True):
        parameter.grad = mean.view_as(parameter).to(parameter.dtype) if has_any else None
    return total_loss[0], frames / all_frames, any_flags


def broadcast_values(fabric: "Fabric", values: Iterable[Tensor]) -> None:
    """Copy the first process's values to every process, in place."""
    if fabric.world_size > 1:
        with _lost_process_errors():
            for value in values:
                sent = value.contiguous()
                distributed.broadcast(sent, src=0)
                value.copy_(sent)


def gather(fabric: "Fabric", value: Tensor) -> Tensor:
    """Return the values (N,) of all processes, as (processes, N) on the CPU."""
    rows = value.new_zeros(fabric.world_size, *value.shape)
    rows[fabric.global_rank] = value
    return sum_over_processes(fabric, rows).cpu()


def wait(fabric: "Fabric") -> None:
    """Wait until every process has reached this call."""
    with _lost_process_errors():
        fabric.barrier()


def _all_reduce(value: Tensor) -> Tensor:
    """Replace a value by its sum over the processes, and return it."""
    with _lost_process_errors():
        distributed.all_reduce(value)  # fabric's version adds a barrier, which is one more message
    return value


def _check(training: Training) -> None:
    """Refuse an unavailable accelerator, and several processes for a program that cannot be started again."""
    accelerator, devices = training.accelerator, training.devices
    available = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    available["gpu"] = any(available.values())
    if not available.get(accelerator, True):
        raise ValueError(
            f"accelerator is {accelerator!r}, but torch {torch.__version__} finds none on this machine; 'auto' uses an "
            "available one"
        )
    if devices > 1 and not is_torchrun() and sys.argv[0] in ("", "-", "-c"):
        raise ValueError(
            f"devices={devices} starts {devices} copies of the program, which must be in a file; "
            "save it as a .py file and run that file"
        )


def _count_processes(devices: int) -> tuple[int, int]:
    """Return the number of processes on this host, and the number of hosts."""
    if not is_torchrun():
        return devices, 1
    local_processes, all_processes = int(os.environ["LOCAL_WORLD_SIZE"]), int(os.environ["WORLD_SIZE"])
    if devices not in (1, local_processes):
        raise ValueError(
            f"devices is {devices}, but torchrun has started {local_processes} processes on this host; remove devices"
        )
    return local_processes, all_processes // local_processes


@contextmanager
def _lost_process_errors() -> Iterator[None]:
    """Raise `LostProcess` for errors of communication, because torch's messages only name the connection."""
    try:
        yield
    except RuntimeError as error:
        minutes = LONGEST_WAIT.total_seconds() / 60
        raise LostProcess(
            f"another process of this run has ended, or has not answered for {minutes:g} minutes; see its output for "
            "the reason. Resume the run with the same number of processes to continue from its last checkpoint"
        ) from error


def _leave() -> None:
    """Leave the process group: its threads would abort the interpreter at exit. For NCCL, Fabric does this."""
    if distributed.is_initialized():
        distributed.destroy_process_group()
