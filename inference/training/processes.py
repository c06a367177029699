"""Training in several processes on one machine or many: exchange of gradients, and errors when a process is lost.

Each process draws its own batches (synchronous data parallelism). Before a step of the optimiser, gradients are
averaged, as if one process had all these batches. They are sent together with the loss in one message: models are
small, so the number of messages costs more than their size. torch's own wrapper sends gradients in buckets, copies
buffers at every pass, and refuses a parameter without a gradient.

lightning-fabric starts the processes on one machine, torchrun those on several (`docs/scaling.md`).
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

A process that has ended is noticed at once.
"""


class LostProcess(RuntimeError):
    """Another process of the run has ended, or does not answer."""


def launch(training: Training) -> "Fabric":
    """Start the processes of a run, or join those that torchrun has started.

    Raises:
        ValueError: when torchrun has started another number of processes than `devices`, when the program is in no file
            and cannot be started again, or when the accelerator is not available.
    """
    _check(training)
    from lightning_fabric import Fabric  # the import takes over a second, half the time of `import dvae`
    from lightning_fabric.strategies.ddp import DDPStrategy

    class Unwrapped(DDPStrategy):
        def setup_module(self, module: nn.Module) -> nn.Module:  # type: ignore[override]
            return module

    here, hosts = _places(training.devices)
    fabric: Fabric = Fabric(
        accelerator=training.accelerator,
        devices=here,
        num_nodes=hosts,
        precision=training.precision,
        strategy=Unwrapped(timeout=LONGEST_WAIT) if here * hosts > 1 else "auto",
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

    torchrun counts restarts, except those that another host has asked for.
    """
    return is_torchrun() and os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0") != "0"


def seed_of(seed: int, process: int) -> int:
    """Return the seed of a process: the run's seed for the first, independent derived seeds for the others."""
    return int(np.random.SeedSequence([seed % 2**64, process]).generate_state(1)[0]) if process else seed


def sum_over_processes(fabric: "Fabric", value: Tensor) -> Tensor:
    """Return the sum over the processes."""
    return _all_reduce(value.to(fabric.device, copy=True)) if fabric.world_size > 1 else value


def average_gradients(
    fabric: "Fabric", parameters: Sequence[nn.Parameter], loss: Tensor, frames: Tensor
) -> tuple[Tensor, Tensor | float]:
    """Average gradients over processes, as for one batch of all their sequences with a loss per frame.

    A parameter keeps no gradient if it has none in any process.

    Args:
        fabric: fabric of the processes.
        parameters: trained parameters, after the backward pass.
        loss: loss of this process's batch, a scalar.
        frames: number of frames in this process's batch, a scalar.

    Returns:
        The loss of the joint batch, and this process's share of its frames.
    """
    if fabric.world_size == 1:
        return loss.detach(), 1.0
    had = [parameter.grad is not None for parameter in parameters]
    given = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
    numbers = torch.tensor([1.0, *had], device=loss.device)
    own = torch.cat([loss.detach()[None], numbers, *(gradient.flatten() for gradient in given)])
    joint = _all_reduce(own.mul_(frames))
    all_frames = joint[1].clone()
    whole, _, has, *means = joint.div_(all_frames).split([1, 1, len(had), *(p.numel() for p in parameters)])
    anywhere = had if all(had) else (has > 0).tolist()
    for parameter, mean, there in zip(parameters, means, anywhere, strict=True):
        parameter.grad = mean.view_as(parameter).to(parameter.dtype) if there else None
    return whole[0], frames / all_frames


def broadcast_values(fabric: "Fabric", values: Iterable[Tensor]) -> None:
    """Copy the first process's values to every process, in place."""
    if fabric.world_size > 1:
        with _answered():
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
    with _answered():
        fabric.barrier()


def _all_reduce(value: Tensor) -> Tensor:
    """Replace a value by its sum over the processes, and return it."""
    with _answered():
        distributed.all_reduce(value)  # fabric's own adds a barrier, which is one more message
    return value


def _check(training: Training) -> None:
    """Refuse an unavailable accelerator, and several processes of a program that cannot be started again."""
    accelerator, devices = training.accelerator, training.devices
    there = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    there["gpu"] = any(there.values())
    if not there.get(accelerator, True):
        found = f"torch {torch.__version__} finds none here"
        raise ValueError(f"accelerator is {accelerator!r}, but {found}; 'auto' uses an available one")
    if devices > 1 and not is_torchrun() and sys.argv[0] in ("", "-", "-c"):
        raise ValueError(
            f"devices={devices} starts as many copies of the program, but it is in no file; write it to one"
        )


def _places(devices: int) -> tuple[int, int]:
    """Return the numbers of processes on this host and of hosts."""
    if not is_torchrun():
        return devices, 1
    here, all_processes = int(os.environ["LOCAL_WORLD_SIZE"]), int(os.environ["WORLD_SIZE"])
    if devices not in (1, here):
        raise ValueError(f"devices is {devices}, but torchrun has started {here} processes here; remove devices")
    return here, all_processes // here


@contextmanager
def _answered() -> Iterator[None]:
    """Raise `LostProcess` for errors of communication, as torch's messages only name the connection."""
    try:
        yield
    except RuntimeError as error:
        minutes = LONGEST_WAIT.total_seconds() / 60
        raise LostProcess(
            f"another process of this run has ended, or has not answered for {minutes:g} minutes; its own output gives "
            "the reason. Resume the run with as many processes to continue from its last checkpoint"
        ) from error


def _leave() -> None:
    """Leave the process group: its threads would abort the interpreter at exit. For NCCL, Fabric does this."""
    if distributed.is_initialized():
        distributed.destroy_process_group()
