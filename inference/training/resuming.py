"""Checkpoints of the training loop: write everything that a step depends on, and restore it after checking it.

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

# state of an optimiser for every parameter that it has changed
_MOMENTS: dict[str, set[str]] = {"adam": {"step", "exp_avg", "exp_avg_sq"}, "sgd": set()}
_MOMENTS["adamw"] = _MOMENTS["adam"]

# fields of `State` in state.json
_STORED = ("step", "best_step", "best_bound", "last_value", "waited", "status", "processor_seconds")


def store(svi: SVI, run: Run) -> None:
    """Write a checkpoint of a run. Every process must call it; the first one writes."""
    state = svi.state
    random = {name: processes.gather(svi.fabric, value) for name, value in _random(svi).items()}
    svi.settle()
    if not svi.fabric.is_global_zero:
        return
    content = {f"random/{name}": value for name, value in random.items()}
    for index, values in svi.optimizer.state_dict()["state"].items():
        content |= {f"optimizer/{index}/{key}": value for key, value in values.items() if isinstance(value, Tensor)}
    if isinstance(svi.objective, StatefulObjective):
        content |= {f"objective/{name}": value for name, value in svi.objective.state.items()}
    content = {name: value.detach().cpu().clone().contiguous() for name, value in content.items()}
    files = {LAST: save_tensors(weights(svi.model)), OPTIMISER: save_tensors(content)}
    if state.best is not None and not (run.exists and run.state["best_step"] == state.best_step):
        files[BEST] = save_tensors(state.best)
    fields = {name: getattr(state, name) for name in (*_STORED, "per")}
    run.commit({**fields, "optimizer": svi.training.optimizer, "select": svi.training.select}, files)


def restore(svi: SVI, run: Run) -> None:
    """Restore the last checkpoint of a run, after `SVI.init`.

    Raises:
        CheckpointError: when its files are damaged, or from a run with another model, optimiser, stateful objective or
            number of processes.
        ValueError: when the run has taken more steps than `steps`.
    """
    stored, state, model, training = run.state, svi.state, svi.model, svi.training
    if stored["step"] > training.steps:
        raise ValueError(
            f"steps is {training.steps}, but {run.path} has taken {stored['step']} steps already; pass the "
            f"total number of steps of the run, at least {stored['step']}"
        )
    parts = _parts(run, run.optimiser_state(state_bytes(model, 4) + 2**20))
    last = run.read(LAST, state_bytes(model))
    model.load_state_dict(read_weights(model, last, run.path / LAST))
    if stored["optimizer"] != training.optimizer:
        raise CheckpointError(
            f"{run.path} was fitted with optimizer={stored['optimizer']!r}, not {training.optimizer!r}; resume with "
            "the same optimiser"
        )
    if (select := stored.get("select", "bound")) != training.select:
        raise CheckpointError(
            f"{run.path} selects weights with select={select!r}, not {training.select!r}; resume with the "
            "same, because scores of two kinds cannot be compared"
        )
    moments = _moments(svi, run, parts["optimizer"])
    _check_random(svi, run, parts["random"])
    count = len(parts["random"]["generator"])
    if count != svi.fabric.world_size:
        raise CheckpointError(
            f"{run.path} was fitted by {count} processes, not {svi.fabric.world_size}; resume with {count}, as "
            f"each has its own random numbers: use devices={count} on one host, or torchrun on several"
        )
    # Copy, because set_state reads the whole storage: a view would return another row's bytes, or crash.
    random = {name: value[svi.fabric.global_rank].clone() for name, value in parts["random"].items()}
    try:
        # Options such as weight_decay come from this fit, not from the checkpoint.
        options = svi.optimizer.state_dict()["param_groups"]
        svi.optimizer.load_state_dict({"state": moments, "param_groups": options})
        svi.reset_graphs()
        svi.generator.set_state(random.pop("generator"))
        svi.random |= {name: value for name, value in random.items() if name in svi.random}
        with svi.drawing():  # fails if the tensors are not states of a generator
            pass
    except (RuntimeError, TypeError, ValueError) as error:
        raise _damaged(run, str(error)) from error
    for name in _STORED:
        setattr(state, name, stored[name])
    if isinstance(svi.objective, StatefulObjective) and state.step > stage_at(svi.plan, state.step)[0]:
        _restore_objective(svi.objective, run, parts["objective"])
    if BEST in stored["fingerprints"]:
        state.best = read_weights(model, run.read(BEST, state_bytes(model)), run.path / BEST)


@contextmanager
def mark_failure(svi: SVI, run: Run) -> Iterator[None]:
    """On a `NonFiniteError`, store the status "failed" with the last checkpoint, without changing its files."""
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
    """Return the tensors by part of the checkpoint, and by name in this part."""
    parts: dict[str, dict[str, Tensor]] = {"optimizer": {}, "random": {}, "objective": {}}
    for path, value in content.items():
        part, _, name = path.partition("/")
        if part not in parts:
            raise _damaged(run, f"{reprlib.repr(path)} does not belong to {', '.join(parts)}")
        parts[part][name] = value
    return parts


def _moments(svi: SVI, run: Run, tensors: Mapping[str, Tensor]) -> dict[int, dict[str, Tensor]]:
    """Return the state of the optimiser by index of the parameter.

    Raises:
        CheckpointError: when the optimiser cannot have had this state for this model at the run's step.
    """
    indices = {str(index): index for index in range(len(svi.parameters))}
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        index, _, key = name.partition("/")
        if index not in indices:
            raise _damaged(run, f"{reprlib.repr(f'optimizer/{name}')} does not belong to a parameter")
        parameter = svi.parameters[indices[index]]
        if not _is_valid(key, value, parameter, run.state["step"]):
            shape = f"finite and of shape {tuple(parameter.shape)}"
            raise _damaged(run, f"{reprlib.repr(f'optimizer/{name}')} is not in the optimiser's format, {shape}")
        moments.setdefault(indices[index], {})[key] = value
    for number, state in moments.items():
        if missing := _MOMENTS[svi.training.optimizer] - state.keys():
            raise _damaged(run, f"optimizer/{number} has no {' and no '.join(sorted(missing))}")
    return moments


def _check_random(svi: SVI, run: Run, states: Mapping[str, Tensor]) -> None:
    """Refuse values that are not states of the run's random number generators.

    Raises:
        CheckpointError: with the name of an invalid state.
    """
    own_states = _random(svi)
    for key, value in states.items():
        size = own_states[key].numel() if key in own_states else None
        is_state = value.dtype == torch.uint8 and value.ndim == 2
        if not is_state or size not in (None, value.shape[1]) or key not in ("generator", "torch", "cuda"):
            raise _damaged(run, f"{reprlib.repr(f'random/{key}')} is not a state of a random number generator")
    rows = {key: len(value) for key, value in states.items()}
    if missing := {"generator", "torch"} - rows.keys():
        raise _damaged(run, f"random has no {' and no '.join(sorted(missing))}")
    if len(set(rows.values())) > 1:
        raise _damaged(run, f"random has states of {' and '.join(map(str, rows.values()))} processes")


def _restore_objective(objective: StatefulObjective, run: Run, tensors: Mapping[str, Tensor]) -> None:
    """Restore the state of an objective from a checkpoint.

    Raises:
        CheckpointError: when the state is of another objective, or damaged.
    """
    own_state = objective.state
    if tensors.keys() != own_state.keys():
        names = reprlib.repr(list(tensors)) if tensors else "none"
        raise CheckpointError(
            f"{run.path} was fitted with another objective: its state has {names}, that of the given objective has "
            f"{', '.join(own_state)}; resume with the objective and stages of the fit. (Stages with other numbers of "
            "steps begin at other steps.)"
        )
    for name, value in own_state.items():
        tensor = tensors[name]
        as_written = (tensor.dtype, tensor.shape) == (value.dtype, value.shape)
        if not as_written or not torch.isfinite(tensor).all():
            shape = f"finite, {value.dtype} and of shape {tuple(value.shape)}"
            raise _damaged(run, f"objective/{name} is not in the objective's format, {shape}")
    try:
        objective.restore({name: value.detach().clone() for name, value in tensors.items()})
    except ValueError as error:
        raise _damaged(run, str(error)) from error


def _is_valid(key: str, value: Tensor, parameter: Tensor, step: int) -> bool:
    """Return whether a value is a valid step count, or a valid moment for the parameter."""
    if not value.is_floating_point():
        return False
    if key == "step":
        return value.ndim == 0 and 0 <= value.item() <= step and value.item() % 1 == 0
    if key not in ("exp_avg", "exp_avg_sq", "momentum_buffer") or value.shape != parameter.shape:
        return False
    return bool(torch.isfinite(value).all() and (key != "exp_avg_sq" or (value >= 0).all()))


def _damaged(run: Run, problem: str) -> CheckpointError:
    return CheckpointError(f"{run.path / OPTIMISER} is damaged: {problem}; copy the run directory whole, or fit again")
