"""Checkpoints of the loop: what a step depends on goes to a run directory, and comes back checked.

A run that is restored repeats, bit for bit on a CPU, what the uninterrupted one would have done.

Example:
    run = Run("runs/mine")
    store(svi, run)

    svi.init()  # in another process, of the same model and options
    restore(svi, run)
"""

import io
import reprlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from safetensors.torch import save as save_tensors
from torch import Tensor

from . import processes
from .checkpoints import BEST, LAST, OPTIMISER, CheckpointError, Run, read_weights, state_bytes, weights
from .objectives import Adapting
from .options import stage_at
from .svi import SVI, NonFiniteError

# what an optimiser needs of every parameter that it has moved
_KEPT: dict[str, set[str]] = {"adam": {"step", "exp_avg", "exp_avg_sq"}, "sgd": set()}
_KEPT["adamw"] = _KEPT["adam"]

# what state.json holds of `State`
_STORED = ("step", "best_step", "best_bound", "last_value", "waited", "status", "processor_seconds")


def store(svi: SVI, run: Run) -> None:
    """Write a checkpoint of where a run stands; every process calls it, and the first one writes."""
    state = svi.state
    random = {name: processes.gathered(svi.fabric, value) for name, value in _random(svi).items()}
    svi.settle()
    if not svi.fabric.is_global_zero:
        return
    buffer = io.BytesIO()
    content = {"name": svi.training.optimizer, "optimizer": svi.optimizer.state_dict(), "random": random}
    if isinstance(svi.objective, Adapting):
        content["objective"] = {name: value.detach().cpu().clone() for name, value in svi.objective.state.items()}
    torch.save(content, buffer)
    files = {LAST: save_tensors(weights(svi.model)), OPTIMISER: buffer.getvalue()}
    if state.best is not None and state.waited == 0:
        files[BEST] = save_tensors(state.best)
    run.commit({name: getattr(state, name) for name in (*_STORED, "per")}, files)


def restore(svi: SVI, run: Run) -> None:
    """Return to the last checkpoint of a run, after `SVI.init`.

    Raises:
        CheckpointError: when its files are damaged, of another model, another optimiser, another objective with a
            state or another number of processes.
        ValueError: when it has taken more steps than it is to take.
    """
    stored, state, model, training = run.state, svi.state, svi.model, svi.training
    if stored["step"] > training.steps:
        raise ValueError(
            f"steps is {training.steps}, but {run.path} has taken {stored['step']} steps already; steps "
            f"counts all of a run, so give more than {stored['step']} to go on"
        )
    content = run.optimiser_state(state_bytes(model, 4) + 2**20)
    last = run.read(LAST, state_bytes(model))
    model.load_state_dict(read_weights(model, last, run.path / LAST))
    _check_state(svi, run, content)
    if content["name"] != training.optimizer:
        raise CheckpointError(
            f"{run.path} was fitted with optimizer={content['name']!r}, not "
            f"{training.optimizer!r}; resume with the same optimiser"
        )
    count = len(content["random"]["generator"])
    if count != svi.fabric.world_size:
        raise CheckpointError(
            f"{run.path} was fitted by {count} processes, not {svi.fabric.world_size}; resume with as many, as each "
            f"has random numbers of its own: with devices={count} on one host, or by torchrun on several"
        )
    # a copy: set_state reads the storage, so it takes another row's bytes for a view, or crashes
    random = {name: value[svi.fabric.global_rank].clone() for name, value in content["random"].items()}
    try:
        # options such as the weight decay are those of this call
        options = svi.optimizer.state_dict()["param_groups"]
        svi.optimizer.load_state_dict({"state": content["optimizer"]["state"], "param_groups": options})
        svi.generator.set_state(random.pop("generator"))
        svi.random |= {name: value for name, value in random.items() if name in svi.random}
        with svi.drawing():  # which fails where these are no states
            pass
    except (RuntimeError, TypeError, ValueError) as error:
        raise _damaged(run, str(error)) from error
    for name in _STORED:
        setattr(state, name, stored.get(name, getattr(state, name)))  # earlier versions kept no time
    if isinstance(svi.objective, Adapting) and state.step > stage_at(svi.plan, state.step)[0]:
        _take_up(svi.objective, run, content.get("objective", {}))
    if BEST in stored["fingerprints"]:
        state.best = read_weights(model, run.read(BEST, state_bytes(model)), run.path / BEST)


@contextmanager
def marking_failure(svi: SVI, run: Run) -> Iterator[None]:
    """A `NonFiniteError` within it is noted beside the last checkpoint, whose files stay as they are."""
    try:
        yield
    except NonFiniteError:
        if svi.fabric.is_global_zero:
            run.commit({**run.state, "status": "failed"}, {})
        raise


def _random(svi: SVI) -> dict[str, Tensor]:
    """The states of the random number generators by name."""
    return {"generator": svi.generator.get_state(), **svi.random}


def _check_state(svi: SVI, run: Run, content: Any) -> None:
    """Refuse a state of optimiser and random numbers that no run of this model writes at its step.

    Raises:
        CheckpointError: naming what is wrong.
    """
    parts = {"name": str, "optimizer": dict, "random": dict}
    if not isinstance(content, dict) or not all(isinstance(content.get(key), kind) for key, kind in parts.items()):
        raise _damaged(run, f"it holds no {', '.join(parts)}")
    moments, own = content["optimizer"].get("state"), _random(svi)
    if not isinstance(moments, dict):
        raise _damaged(run, "its optimizer has no state")
    for place, kept in moments.items():
        if type(place) is not int or not 0 <= place < len(svi.parameters) or not isinstance(kept, dict):
            raise _damaged(run, f"optimizer.state[{place!r}] is of no parameter")
        if (missing := _KEPT[svi.training.optimizer] - kept.keys()) and content["name"] == svi.training.optimizer:
            raise _damaged(run, f"optimizer.state[{place}] has no {' and no '.join(sorted(missing))}")
        for key, value in kept.items():
            if (key, value) != ("momentum_buffer", None) and not _sound(
                key, value, svi.parameters[place], run.state["step"]
            ):
                raise _damaged(
                    run,
                    f"optimizer.state[{place}][{key!r}] is not as the optimiser writes it, finite and of shape "
                    f"{tuple(svi.parameters[place].shape)}",
                )
    for key, value in content["random"].items():
        size = own[key].numel() if key in own else None
        known = isinstance(value, Tensor) and value.dtype == torch.uint8 and value.ndim == 2
        if not known or size not in (None, value.shape[1]) or key not in ("generator", "torch", "cuda"):
            raise _damaged(run, f"random[{key!r}] is no state of a random number generator")
    rows = {key: len(value) for key, value in content["random"].items()}
    if missing := {"generator", "torch"} - rows.keys():
        raise _damaged(run, f"random has no {' and no '.join(sorted(missing))}")
    if len(set(rows.values())) > 1:
        raise _damaged(run, f"random has states of {' and '.join(map(str, rows.values()))} processes")


def _take_up(objective: Adapting, run: Run, found: Any) -> None:
    """Has an objective go on with the state that a checkpoint holds of it.

    Raises:
        CheckpointError: it is of another objective, or no state that one writes.
    """
    own = objective.state
    if not isinstance(found, dict) or found.keys() != own.keys():
        held = reprlib.repr(list(found)) if isinstance(found, dict) and found else "none"
        raise CheckpointError(
            f"{run.path} was fitted with another objective: the state of this one is {', '.join(own)}, the run's "
            f"{held}; resume with the objective and the stages that it was fitted with, which begin elsewhere where "
            "steps are others"
        )
    for name, value in own.items():
        given = found[name]
        as_written = isinstance(given, Tensor) and (given.dtype, given.shape) == (value.dtype, value.shape)
        if not as_written or not torch.isfinite(given).all():
            shape = f"finite, {value.dtype} and of shape {tuple(value.shape)}"
            raise _damaged(run, f"objective[{name!r}] is not as the objective writes it, {shape}")
    try:
        objective.restore({name: value.detach().clone() for name, value in found.items()})
    except ValueError as error:
        raise _damaged(run, str(error)) from error


def _sound(key: Any, value: Any, parameter: Tensor, step: int) -> bool:
    """Whether a value of the optimiser's state is one: its count of steps, or a moment of the parameter."""
    if not isinstance(value, Tensor) or not value.is_floating_point():
        return False
    if key == "step":
        return value.ndim == 0 and 0 <= value.item() <= step and value.item() % 1 == 0
    if key not in ("exp_avg", "exp_avg_sq", "momentum_buffer") or value.shape != parameter.shape:
        return False
    return bool(torch.isfinite(value).all() and (key != "exp_avg_sq" or (value >= 0).all()))


def _damaged(run: Run, problem: str) -> CheckpointError:
    return CheckpointError(f"{run.path / OPTIMISER} is damaged: {problem}; copy the run directory whole, or fit again")
