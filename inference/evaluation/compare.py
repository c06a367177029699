"""Comparison of models on held-out sequences, as a statistician would make it.

Every model is scored on the same sequences, teacher-forced: evidence lower bound, importance-weighted bound with the
Pareto diagnosis of its weights, the particle filter's bound where it is asked for, KL of every latent, and what the
guide's latents tell of the data. Free-running scores come from `evaluate`. Models are ranked by the importance-weighted
bound per frame. What their differences are sure of stands in `comparison`.
"""

import dataclasses
import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ...data.batch import Batch
from ...data.sequences import HeldOutWindows, Listed, called, clusters, sequences, take_split
from ...program.model import DynamicalVAE
from ..bounds.elbo import require_likelihood
from ..bounds.particles import obstacle
from ..bounds.teacher_forced import bounds, filtered, information, length_of, variances
from .comparison import Comparison, Contender
from .evaluate import evaluate
from .held import on_device_of, reproducibly
from .record import plain
from .result import progress_bar
from .scores import Measure, Scores, proper

_PAIRS = 4096  # sequences times contrasts to hold at once


def compare(
    models: Mapping[str, DynamicalVAE | Sequence[DynamicalVAE]],
    data: HeldOutWindows | Listed | Tensor | np.ndarray | Batch,
    *,
    scores: Scores = proper,
    particles: int = 64,
    estimates: int = 1,
    filter_particles: int = 0,
    contrasts: int = 128,
    samples: int = 50,
    draw_emission: bool | None = None,
    seed: int = 0,
    batch_size: int = 32,
    configs: Mapping[str, Mapping[str, Any]] | None = None,
    progress: bool = True,
) -> Comparison:
    """Compare models on held-out sequences: bounds, differences with their errors, use of latents, forecasts.

    All models see the same sequences, and each draws from the same seed, so that no score depends on which others are
    compared; scores do depend on `batch_size`, as draws come batch by batch.

    *Active units* of a latent (Burda et al., 2016): coordinates whose posterior mean varies over the data with a
    variance above 0.01. For a local latent the variance is that over sequences at the same step, pooled over steps:
    what all sequences share, such as a clock, is no activity. Posterior means of a guide that reads its own past are
    averages over 8 draws of it, and the variance that is due to the draws is subtracted. The threshold is meant for
    latents of about unit scale.

    *Information* of a latent on the data, among M sequences (`contrasts`), M the same for all models:

        mean over n of  log q(z_n | own past, x_n) - log (1/M) sum_m q(z_n | own past, x_m)

    with z_n drawn for x_n, "own past" what q reads of the latents, and x_m with its context. It is 0 where q ignores
    the data, and at most log M. For a static latent whose factor reads data only it is the mutual information under
    the guide among these sequences (Hoffman and Johnson, 2016), and in expectation a lower bound of that over the
    population (Poole et al., 2019, section 2.4). For a local latent it is taken by step, in nats a step, log M being
    the limit of each: a whole trajectory of z nearly always tells one sequence from all others, and its information
    would be log M for every model. Where q reads data only, this is I(x; z_t). Where q reads other latents too, it is
    what x adds to them. The contrasts are not weighted by how well they explain that past; hence it is at least
    I(x; z_t | past), by the divergence of the two mixtures, and does not vanish because the past has already told
    which sequence it is. Contrasts may be windows of one clip that overlap: nothing tells apart what they share, so
    that log M is out of reach among them.

    Args:
        models: name to a model, or to several that differ in their training seed only.
        data: windows (such as `ArrayWindows`), x `(N, T, D)`, or a batch of `N` sequences, which may be ragged.
        scores: of forecasts; see `evaluate`.
        particles: K of the importance-weighted bound. k-hat needs 25, and 100 or more to be read sequence by sequence.
        estimates: independent importance-weighted estimates of every sequence, of K particles each. The bound is
            their mean. `Comparison.to_arviz` needs 25 or more.
        filter_particles: K of the particle filter's bound too (FIVO, see `particle_bound`); 0 leaves it out. Models of
            which it cannot be had, as where the guide goes backward, are left without it, and say why.
        contrasts: M, the sequences, drawn at random, among which information is measured; all if there are no more,
            0 leaves it out.
        samples: forecasts per window of the free-running scores; 0 leaves these out, which take longest. Data that are
            no windows, or whole sequences, have none.
        draw_emission: forecast draws of x, or (False) its means; None as in `evaluate`.
        seed: of every model's draws, and of the choice of contrasts.
        batch_size: sequences scored at once.
        configs: `{name: configuration}`, stored with the rows; anything that JSON can hold.
        progress: whether to show a progress bar.

    Returns:
        The comparison; print it, or take its `table`, `plot`, `difference`, `to_json` and `to_arviz`.

    Raises:
        ValueError: no models, models of different equations or sizes in one row, numbers out of range, data without
            sequences; windows that are ragged, for forecasts.
        TypeError: data of another kind, or what is no model.
        FloatingPointError: a bound that is not finite, naming model and sequence.

    Example:
        >>> model = dvae.twin("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})", {"z": 1, "x": 2}, 4)
        >>> found = dvae.compare({"twin": model}, torch.randn(6, 4, 2), particles=32, contrasts=0, progress=False)
        >>> found.ranking
        ['twin']
    """
    if min(particles, estimates, batch_size) < 1 or min(filter_particles, contrasts, samples) < 0:
        raise ValueError(
            "particles, estimates and batch_size are at least 1, filter_particles, contrasts and samples at least 0, "
            f"not {particles}, {estimates}, {batch_size}, {filter_particles}, {contrasts} and {samples}"
        )
    data = take_split(data, "test")
    windows = data if isinstance(data, HeldOutWindows) else None
    whole = windows is not None and windows.protocol.observed is None
    samples = 0 if windows is None or whole else samples
    contenders = _contenders(models)
    labelled = {label: model for label, _, model in _each(contenders)}
    of: dict[str, str] = {}
    for label, model in labelled.items():
        of.setdefault(model.view.measured or "the data", label)
    if len(of) > 1:
        raise ValueError(
            "bounds compare where they are densities of the same, but here are "
            f"{' and '.join(f'those of {label}, of {what}' for what, label in of.items())}; evaluate compares forecasts"
        )
    batch = sequences(data).batch
    alone = batch.group.tolist() if batch.group is not None else range(length_of(batch))
    keys = [("data", str(n), 0) for n in alone] if windows is None else clusters(windows)
    chosen = torch.randperm(len(keys), generator=torch.Generator().manual_seed(seed))[:contrasts]
    shared: dict[str, Any] = {"seed": seed, "batch_size": batch_size, "progress": progress}
    free: dict[str, dict[str, Any]] = {label: {} for label in labelled}
    measures: Sequence[Measure] = ()
    emission = "drawn" if draw_emission else "mean"
    if windows is not None and samples:
        drawn: dict[str, Any] = {"samples": samples, "draw_emission": draw_emission, "references": False}
        measures = [measure for measure in scores(windows) if measure.least <= samples and not measure.bins]
        made = evaluate(labelled, windows, scores=lambda _: measures, **drawn, **shared)
        emission = made.emission
        free = {label: {m.name: np.array(made.rows[label].clip_means[m.name]) for m in measures} for label in labelled}
    measured = {
        label: _measured(label, model, batch, keys, chosen, particles, estimates, filter_particles, **shared)
        | {"free_running": free[label]}
        for label, model in labelled.items()
    }
    rows = {}
    for name, versions in contenders.items():
        seeds = [measured[label] for label, other, _ in _each(contenders) if other == name]
        rows[name] = _contender(versions[0], seeds, dict((configs or {}).get(name, {})))
    x = batch[next(iter(labelled.values())).observed[0]]
    return Comparison(
        rows=rows,
        keys=keys,
        frames=next(iter(measured.values()))["frames"],
        data={
            "fingerprint": windows.fingerprint if windows is not None else _fingerprint(batch),
            "sequences": len(keys),
            "frames": x.shape[1],
            "coordinates": x.shape[2],
            **({"called": list(called(windows.description))} if windows and "called" in windows.description else {}),
        },
        protocol=plain(dataclasses.asdict(windows.protocol)) if windows is not None else {},
        particles=particles,
        filter_particles=filter_particles,
        contrasts=len(chosen),
        samples=samples,
        emission=emission,
        seed=seed,
        shown={measure.name: measure.unit for measure in measures if measure.headline},
        better={measure.name: measure.better for measure in measures if measure.headline},
        notes=["no forecasts: whole sequences have no future"]
        if whole
        else list(dict.fromkeys(measure.note for measure in measures if measure.headline and measure.note)),
    )


def _measured(
    label: str,
    model: DynamicalVAE,
    batch: Batch,
    keys: Sequence[tuple[str, str, int]],
    chosen: Tensor,
    particles: int,
    estimates: int,
    filter_particles: int,
    *,
    seed: int,
    batch_size: int,
    progress: bool,
) -> dict[str, Any]:
    """Everything teacher-forced of one model, each part with draws from the seed."""
    with progress_bar(progress) as bar:

        def parts(what: str, count: int, size: int) -> Iterator[slice]:
            for start in bar.track(range(0, count, size), description=f"{label}, {what}"):
                yield slice(start, start + size)

        with reproducibly(model, seed):
            found = bounds(label, model, batch, keys, particles, estimates, parts("bounds", len(keys), batch_size))
        found["notes"] = []
        if filter_particles and (refused := obstacle(model, model.read(on_device_of(model, batch)))):
            found["notes"].append(f"no particle bound: {refused}")
        elif filter_particles:
            with reproducibly(model, seed):
                pieces = parts("particle bound", len(keys), batch_size)
                found["bounds"] |= filtered(label, model, batch, keys, filter_particles, pieces)
        with reproducibly(model, seed):
            found["variances"] = variances(model, batch, parts("active units", len(keys), batch_size))
        with reproducibly(model, seed):
            pieces = parts("information", len(chosen), max(1, _PAIRS // max(1, len(chosen))))
            found["information"] = information(model, batch.rows(chosen), pieces)
    return found


def _contender(model: DynamicalVAE, seeds: Sequence[Mapping[str, Any]], config: dict[str, Any]) -> Contender:
    """A row from what was measured of the models of its seeds, of which one is given."""
    said = {"frames", "notes"}
    scores = _stack([{key: value for key, value in seed.items() if key not in said} for seed in seeds])
    equations = {"generative": model.generative.text, "inference": model.inference.text}
    return Contender(equations, config, **{**scores, "estimates": scores["estimates"].mean(0)}, notes=seeds[0]["notes"])


def _contenders(models: Mapping[str, Any]) -> dict[str, list[DynamicalVAE]]:
    """Name to the models of every seed."""
    if not isinstance(models, Mapping):
        raise TypeError(f"models are a mapping such as {{'srnn': model}}, not {type(models).__name__}")
    for name, value in models.items():
        if not isinstance(value, nn.Module | Iterable):
            raise TypeError(
                f"{name!r} is a {type(value).__name__}; expected a DynamicalVAE, or a list of them, one for each seed"
            )
    found: dict[str, list[Any]] = {
        name: [value] if isinstance(value, nn.Module) else list(value) for name, value in models.items()
    }
    if not found or not all(found.values()):
        empty = next((name for name, versions in found.items() if not versions), None)
        raise ValueError("there is nothing to compare: " + (f"{empty!r} has no model" if found else "no models"))
    for name, versions in found.items():
        for version in versions:
            if not isinstance(version, DynamicalVAE):
                raise TypeError(f"{name!r} holds a {type(version).__name__}; expected a DynamicalVAE for each seed")
            require_likelihood(version)
        first = versions[0]
        for other in versions[1:]:
            ours, theirs = ((m.generative.text, m.inference.text, dict(m.sizes)) for m in (first, other))
            if ours != theirs:
                raise ValueError(
                    f"the models of {name!r} must differ in their seed only, but one is {ours} and another {theirs}; "
                    "give them names of their own"
                )
    return found


def _each(contenders: Mapping[str, list[Any]]) -> Iterator[tuple[str, str, Any]]:
    """Label, name and model of every seed."""
    for name, versions in contenders.items():
        for place, model in enumerate(versions):
            yield (name if len(versions) == 1 else f"{name}, model {place + 1}"), name, model


def _fingerprint(batch: Batch) -> str:
    """SHA-256 of every tensor of the batch: its name, shape, type and values."""
    digest = hashlib.sha256()
    for name, value in sorted(batch.leaves().items()):
        values = np.ascontiguousarray(value.cpu().numpy())
        digest.update(f"{name} {values.shape} {values.dtype}".encode() + values.tobytes())
    return digest.hexdigest()


def _stack(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The seeds' arrays, stacked under their names."""
    columns = {key: [one[key] for one in found] for key in found[0]}
    return {key: _stack(own) if isinstance(own[0], Mapping) else np.stack(own) for key, own in columns.items()}
