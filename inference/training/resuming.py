"""Checkpoints of the training loop: write everything that a step depends on, and restore it after checks.

On a CPU, a restored run repeats the uninterrupted one bit for bit.

Example:
    run = Run("runs/mine")
    store(svi, run)

    svi.init()  # in another process, of the same model and options
    restore(svi, run)
"""

import reprlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from safetensors.torch import save as save_tensors
from torch import Tensor

from . import processes
from .checkpoints import BEST, LAST, OPTIMISER, CheckpointError, Run, read_weights, state_bytes, weights
from .objectives import StatefulObjective
from .options import stage_at
from .svi import SVI, NonFiniteError

# state that an optimiser needs for every parameter it has moved
_KEPT: dict[str, set[str]] = {"adam": {"step", "exp_avg", "exp_avg_sq"}, "sgd": set()}
_KEPT["adamw"] = _KEPT["adam"]

# fields of `State` in state.json
_STORED = ("step", "best_step", "best_bound", "last_value", "waited", "status", "processor_seconds")


def store(svi: SVI, run: Run) -> None:
    """Write a checkpoint of a run; every process calls it, and the first one writes."""
    state = svi.state
    random = {name: processes.gather(svi.fabric, value) for name, value in _random(svi).items()}
    svi.settle()
    if not svi.fabric.is_global_zero:
        return
    content = {f"random/{name}": value for name, value in random.items()}
    for place, kept in svi.optimizer.state_dict()["state"].items():
        content |= {f"optimizer/{place}/{key}": value for key, value in kept.items() if isinstance(value, Tensor)}
    if isinstance(svi.objective, StatefulObjective):
        content |= {f"objective/{name}": value for name, value in svi.objective.state.items()}
    content = {name: value.detach().cpu().clone().contiguous() for name, value in content.items()}
    files = {LAST: save_tensors(weights(svi.model)), OPTIMISER: save_tensors(content)}
    if state.best is not None and state.waited == 0:
        files[BEST] = save_tensors(state.best)
    found = {name: getattr(state, name) for name in (*_STORED, "per")}
    run.commit({**found, "optimizer": svi.training.optimizer}, files)


def restore(svi: SVI, run: Run) -> None:
    """Restore the last checkpoint of a run, after `SVI.init`.

    Raises:
        CheckpointError: when its files are damaged, or of another model, optimiser, objective with a state, or number
            of processes.
        ValueError: when the run has taken more steps than `steps`.
    """
    stored, state, model, training = run.state, svi.state, svi.model, svi.training
    if stored["step"] > training.steps:
        raise ValueError(
            f"steps is {training.steps}, but {run.path} has taken {stored['step']} steps already; steps "
            f"counts all of a run, so give more than {stored['step']} to continue"
        )
    parts = _parts(run, run.optimiser_state(state_bytes(model, 4) + 2**20))
    last = run.read(LAST, state_bytes(model))
    model.load_state_dict(read_weights(model, last, run.path / LAST))
    if stored["optimizer"] != training.optimizer:
        raise CheckpointError(
            f"{run.path} was fitted with optimizer={stored['optimizer']!r}, not "
            f"{training.optimizer!r}; resume with the same optimiser"
        )
    moments = _moments(svi, run, parts["optimizer"])
    _check_random(svi, run, parts["random"])
    count = len(parts["random"]["generator"])
    if count != svi.fabric.world_size:
        raise CheckpointError(
            f"{run.path} was fitted by {count} processes, not {svi.fabric.world_size}; resume with as many, as each "
            f"has its own random numbers: with devices={count} on one host, or by torchrun on several"
        )
    # a copy: set_state reads the whole storage, so a view would give another row's bytes, or crash
    random = {name: value[svi.fabric.global_rank].clone() for name, value in parts["random"].items()}
    try:
        # options such as the weight decay come from this call
        options = svi.optimizer.state_dict()["param_groups"]
        svi.optimizer.load_state_dict({"state": moments, "param_groups": options})
        svi.generator.set_state(random.pop("generator"))
        svi.random |= {name: value for name, value in random.items() if name in svi.random}
        with svi.drawing():  # fails if these are not states of a generator
            pass
    except (RuntimeError, TypeError, ValueError) as error:
        raise _damaged(run, str(error)) from error
    for name in _STORED:
        setattr(state, name, stored[name])
    if isinstance(svi.objective, StatefulObjective) and state.step > stage_at(svi.plan, state.step)[0]:
        _take_up(svi.objective, run, parts["objective"])
    if BEST in stored["fingerprints"]:
        state.best = read_weights(model, run.read(BEST, state_bytes(model)), run.path / BEST)


@contextmanager
def mark_failure(svi: SVI, run: Run) -> Iterator[None]:
    """Store the status "failed" with the last checkpoint on a `NonFiniteError`; its files do not change."""
    try:
        yield
    except NonFiniteError:
        if svi.fabric.is_global_zero:
            run.commit({**run.state, "status": "failed"}, {})
        raise


def _random(svi: SVI) -> dict[str, Tensor]:
    """Return the states of the random number generators by name."""
    return {"generator": svi.generator.get_state(), **svi.random}


def _parts(run: Run, content: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """Return the tensors by part and by the rest of their path."""
    parts: dict[str, dict[str, Tensor]] = {"optimizer": {}, "random": {}, "objective": {}}
    for path, value in content.items():
        part, _, name = path.partition("/")
        if part not in parts:
            raise _damaged(run, f"{reprlib.repr(path)} does not belong to {', '.join(parts)}")
        parts[part][name] = value
    return parts


def _moments(svi: SVI, run: Run, found: Mapping[str, Tensor]) -> dict[int, dict[str, Tensor]]:
    """Return the state of the optimiser by index of the parameter.

    Raises:
        CheckpointError: when the optimiser could not have written it for this model at its step, naming the error.
    """
    places = {str(place): place for place in range(len(svi.parameters))}
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in found.items():
        place, _, key = name.partition("/")
        if place not in places:
            raise _damaged(run, f"{reprlib.repr(f'optimizer/{name}')} does not belong to a parameter")
        parameter = svi.parameters[places[place]]
        if not _sound(key, value, parameter, run.state["step"]):
            shape = f"finite and of shape {tuple(parameter.shape)}"
            raise _damaged(run, f"{reprlib.repr(f'optimizer/{name}')} is not in the optimiser's format, {shape}")
        moments.setdefault(places[place], {})[key] = value
    for at, kept in moments.items():
        if missing := _KEPT[svi.training.optimizer] - kept.keys():
            raise _damaged(run, f"optimizer/{at} has no {' and no '.join(sorted(missing))}")
    return moments


def _check_random(svi: SVI, run: Run, found: Mapping[str, Tensor]) -> None:
    """Refuse values that are not states of the run's random number generators.

    Raises:
        CheckpointError: naming the invalid state.
    """
    own = _random(svi)
    for key, value in found.items():
        size = own[key].numel() if key in own else None
        known = value.dtype == torch.uint8 and value.ndim == 2
        if not known or size not in (None, value.shape[1]) or key not in ("generator", "torch", "cuda"):
            raise _damaged(run, f"{reprlib.repr(f'random/{key}')} is not a state of a random number generator")
    rows = {key: len(value) for key, value in found.items()}
    if missing := {"generator", "torch"} - rows.keys():
        raise _damaged(run, f"random has no {' and no '.join(sorted(missing))}")
    if len(set(rows.values())) > 1:
        raise _damaged(run, f"random has states of {' and '.join(map(str, rows.values()))} processes")


def _take_up(objective: StatefulObjective, run: Run, found: Mapping[str, Tensor]) -> None:
    """Restore the state of an objective from a checkpoint.

    Raises:
        CheckpointError: when the state is of another objective, or damaged.
    """
    own = objective.state
    if found.keys() != own.keys():
        held = reprlib.repr(list(found)) if found else "none"
        raise CheckpointError(
            f"{run.path} was fitted with another objective: the state of this one is {', '.join(own)}, the run's "
            f"{held}; resume with the objective and the stages of the fit. Stages begin elsewhere when their steps "
            "change"
        )
    for name, value in own.items():
        given = found[name]
        as_written = (given.dtype, given.shape) == (value.dtype, value.shape)
        if not as_written or not torch.isfinite(given).all():
            shape = f"finite, {value.dtype} and of shape {tuple(value.shape)}"
            raise _damaged(run, f"objective/{name} is not in the objective's format, {shape}")
    try:
        objective.restore({name: value.detach().clone() for name, value in found.items()})
    except ValueError as error:
        raise _damaged(run, str(error)) from error


def _sound(key: str, value: Tensor, parameter: Tensor, step: int) -> bool:
    """Return whether a value is a valid step count, or a valid moment of the parameter."""
    if not value.is_floating_point():
        return False
    if key == "step":
        return value.ndim == 0 and 0 <= value.item() <= step and value.item() % 1 == 0
    if key not in ("exp_avg", "exp_avg_sq", "momentum_buffer") or value.shape != parameter.shape:
        return False
    return bool(torch.isfinite(value).all() and (key != "exp_avg_sq" or (value >= 0).all()))


def _damaged(run: Run, problem: str) -> CheckpointError:
    return CheckpointError(f"{run.path / OPTIMISER} is damaged: {problem}; copy the run directory whole, or fit again")
