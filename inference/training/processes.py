"""One run in several processes, of one machine or of many: what they exchange, and what happens where one is gone.

Every process draws batches of its own, and before a step of the optimiser gradients become those that one process would
have with all these batches (synchronous data parallelism). They are sent at once, with the loss: models are small, and
exchanges cost by their number more than by their bytes. (torch's own wrapper sends them in buckets, copies buffers at
every pass, and refuses a parameter without a gradient.)

lightning-fabric starts the processes of one machine, torchrun those of several (`docs/scaling.md`).
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
"""For a process that does not answer, as where a host has lost its network; one that has ended is noticed at once."""


class LostProcess(RuntimeError):
    """Another process of the run has ended, or does not answer."""


def launched(training: Training) -> "Fabric":
    """Start the processes of a run, or join those that torchrun has started.

    Raises:
        ValueError: torchrun has started another number of processes than `devices`, or there is no program that could
            be started as often, or no such accelerator.
    """
    _check(training)
    from lightning_fabric import Fabric  # over a second to import, half of what `import dvae` would take
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


def by_torchrun() -> bool:
    """Whether torchrun has started this process."""
    return distributed.is_available() and distributed.is_torchelastic_launched()


def restartable() -> bool:
    """Whether torchrun starts the processes again when one of them has ended (`--max-restarts`).

    It counts restarts, but not those that another host has asked for.
    """
    return by_torchrun() and os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0") != "0"


def seed_of(seed: int, process: int) -> int:
    """The seed of a process: the run's own for the first, streams that no run of another seed has for the others."""
    return int(np.random.SeedSequence([seed % 2**64, process]).generate_state(1)[0]) if process else seed


def summed(fabric: "Fabric", value: Tensor) -> Tensor:
    """The sum over the processes."""
    return _all_reduce(value.to(fabric.device, copy=True)) if fabric.world_size > 1 else value


def together(
    fabric: "Fabric", parameters: Sequence[nn.Parameter], loss: Tensor, frames: Tensor
) -> tuple[Tensor, Tensor | float]:
    """Has gradients be those of the batches of all processes as one, whose loss is per frame.

    A parameter has none where it has none in any process.

    Args:
        fabric: of the processes.
        parameters: that the optimiser is to move, after the backward pass.
        loss: of this process's batch, a scalar.
        frames: of this process's batch, a scalar.

    Returns:
        The loss of all batches, and the share that this process's has of their frames.
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


def agree(fabric: "Fabric", values: Iterable[Tensor]) -> None:
    """Give every process the values that the first one has, in place."""
    if fabric.world_size > 1:
        with _answered():
            for value in values:
                sent = value.contiguous()
                distributed.broadcast(sent, src=0)
                value.copy_(sent)


def gathered(fabric: "Fabric", value: Tensor) -> Tensor:
    """The values (N,) of all processes, (processes, N), on the CPU."""
    rows = value.new_zeros(fabric.world_size, *value.shape)
    rows[fabric.global_rank] = value
    return summed(fabric, rows).cpu()


def wait(fabric: "Fabric") -> None:
    """Go on when every process has come here."""
    with _answered():
        fabric.barrier()


def _all_reduce(value: Tensor) -> Tensor:
    """The sum over the processes, in place of the value."""
    with _answered():
        distributed.all_reduce(value)  # fabric's own has them wait for one another first, in a message more
    return value


def _check(training: Training) -> None:
    """Refuses an accelerator that is not there, and more processes of a program that cannot be started again."""
    accelerator, devices = training.accelerator, training.devices
    there = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    there["gpu"] = any(there.values())
    if not there.get(accelerator, True):
        found = f"torch {torch.__version__} finds none here"
        raise ValueError(f"accelerator is {accelerator!r}, and {found}; 'auto' takes what there is")
    if devices > 1 and not by_torchrun() and sys.argv[0] in ("", "-", "-c"):
        raise ValueError(f"devices={devices} starts the program as often, and this one is in no file; write it to one")


def _places(devices: int) -> tuple[int, int]:
    """Processes on this host, and hosts."""
    if not by_torchrun():
        return devices, 1
    here, all_processes = int(os.environ["LOCAL_WORLD_SIZE"]), int(os.environ["WORLD_SIZE"])
    if devices not in (1, here):
        raise ValueError(f"devices is {devices}, and torchrun has started {here} processes here; leave devices out")
    return here, all_processes // here


@contextmanager
def _answered() -> Iterator[None]:
    """What fails within it is another process: torch names the connection, and a cause that is none of the user's."""
    try:
        yield
    except RuntimeError as error:
        minutes = LONGEST_WAIT.total_seconds() / 60
        raise LostProcess(
            f"another process of this run has ended, or has not answered for {minutes:g} minutes; its own output says "
            "why. Resume the run with as many processes to go on from its last checkpoint"
        ) from error


def _leave() -> None:
    """Leave the group of processes: threads of it that outlive the interpreter abort it. For NCCL Fabric does so."""
    if distributed.is_initialized():
        distributed.destroy_process_group()
