"""Tables of the content of the static latent of runs: linear probes, interpolations, and swaps of w.

A probe is fitted to the windows of every other clip of each class, and evaluated on the windows of the other clips:
multinomial logistic regression to a label, and ridge regression to bone lengths if they differ between people. The
posterior mean of w is compared with other features: the mean of z's posterior means over time, and two features without
a model, the mean and the spread of every coordinate over time.

A swap decodes a window with one latent of another window with another label; x runs free from its own past. The effect
is measured separately on the mean pose over time, and on the motion about it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor
from torch.nn import functional

from dvae.inference.diagnostics.checks import decode
from dvae.inference.evaluation.estimates import TwoWayErrors
from dvae.inference.evaluation.evaluation_windows import cluster_index, on_device_of, seeded_evaluation
from dvae.motion import Windows
from dvae.program.batch import rows

from .results import Table, loaded, write

DRAWS, PENALTY, CHUNK = 8, 1e-3, 128
ONE_BODY = 0.01
"""Relative spread of bone lengths below which all windows have one body."""
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)


def posterior_means(model: Any, batch: Mapping[str, Any], seed: int) -> dict[str, Tensor]:
    """Return means of the guide's draws: (N, D) for a static latent, (N, T, D) for a local one."""
    means: dict[str, list[Tensor]] = {}
    with seeded_evaluation(model, seed):
        for start in range(0, len(batch["x"]), CHUNK):
            data = on_device_of(model, model.read(rows(batch, slice(start, start + CHUNK))))
            draws = [model.guide(data) for _ in range(DRAWS)]
            for name in model.latents:
                means.setdefault(name, []).append(torch.stack([each[name] for each in draws]).mean(0).cpu())
    return {name: torch.cat(values) for name, values in means.items()}


def halves(labels: Sequence[str], places: Tensor) -> Tensor:
    """Return a mask (N,) of the windows of every other clip of each label, to fit probes."""
    counts: dict[str, int] = {}
    in_first_half: dict[int, bool] = {}
    for label, place in zip(labels, places.tolist(), strict=True):
        if place not in in_first_half:
            in_first_half[place] = counts.setdefault(label, 0) % 2 == 0
            counts[label] += 1
    return torch.tensor([in_first_half[place] for place in places.tolist()])


def read_label(features: Tensor, labels: Sequence[str], fitted: Tensor) -> Tensor:
    """Return whether a logistic probe of features (N, F) is right, for each window outside its fit."""
    names = sorted({*labels})
    truth = torch.tensor([names.index(label) for label in labels])
    x = standardised(features, fitted)
    weights = torch.zeros(x.shape[1], len(names), dtype=x.dtype, requires_grad=True)
    bias = torch.zeros(len(names), dtype=x.dtype, requires_grad=True)
    search = torch.optim.LBFGS([weights, bias], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        search.zero_grad()
        value = functional.cross_entropy(x[fitted] @ weights + bias, truth[fitted]) + PENALTY * weights.square().sum()
        value.backward()
        return value

    search.step(loss)
    return ((x @ weights + bias).argmax(1) == truth)[~fitted].double()


def read_lengths(features: Tensor, lengths: Tensor, fitted: Tensor) -> float:
    """Return the R² of a ridge probe of lengths (N, B), over the windows outside its fit."""
    x = standardised(features, fitted)
    mean = lengths[fitted].mean(0)
    gram = x[fitted].mT @ x[fitted] + PENALTY * len(x) * torch.eye(x.shape[1], dtype=x.dtype)
    weights = torch.linalg.solve(gram, x[fitted].mT @ (lengths[fitted] - mean))
    residual = (lengths - mean - x @ weights)[~fitted].square().sum()
    return float(1 - residual / (lengths - lengths[~fitted].mean(0))[~fitted].square().sum())


def standardised(features: Tensor, fitted: Tensor) -> Tensor:
    """Standardize features by the rows that a probe is fitted to; constant features become 0."""
    x = features.double()
    spread, mean = torch.std_mean(x[fitted], 0)
    return (x - mean) / spread.clamp(min=1e-6)


def probes(model: Any, windows: Windows, labels: Sequence[str], seed: int) -> list[list[str]]:
    """Return a row for each feature: the accuracy of probes by label, then the R² of bone lengths."""
    batch = windows.all()
    inferred, x = posterior_means(model, batch, seed), batch["x"]
    features = {name: value if value.dim() == 2 else value.mean(1) for name, value in inferred.items()}
    features["mean and spread of poses"] = torch.cat([x.mean(1), x.std(1)], 1)
    places = cluster_index(windows.keys)
    lengths = windows.skeleton.bone_lengths(windows.positions(x)).mean(1).double()
    values_by_label = {label: windows.labels(label) for label in labels}
    lines = []
    for name, values in features.items():
        cells = []
        for label in labels:
            fitted = halves(values_by_label[label], places)
            cells.append(format_accuracy(read_label(values, values_by_label[label], fitted), places[~fitted]))
        varied = float((lengths.std(0) / lengths.mean(0)).mean())
        fitted = halves([""] * len(x), places)
        cells.append(f"{read_lengths(values, lengths, fitted):.2f}" if varied > ONE_BODY else "–")
        lines.append([name, *cells])
    return lines


def format_accuracy(right: Tensor, places: Tensor) -> str:
    """Format the mean over windows with its standard error, clustered by clip."""
    _, clips = np.unique(places.numpy(), return_inverse=True)
    estimate = TwoWayErrors.by_cluster(right.numpy()[None], np.ones(len(clips)), clips).estimate()
    return f"{estimate.mean:.3f} ± {estimate.sequences:.3f}"


def swaps(model: Any, windows: Windows, label: str, count: int, seed: int) -> list[list[str]]:
    """Return a row for each latent and amount of interpolation: changes of the mean pose and of the motion, in mm."""
    batch, label_values = windows.all(), np.array(windows.labels(label))
    draw = np.random.default_rng(seed)
    first = draw.permutation(len(label_values))[:count]
    second = np.array([draw.choice(np.flatnonzero(label_values != label_values[place])) for place in first])
    first_batch, second_batch = (rows(batch, torch.from_numpy(places)) for places in (first, second))
    goal = windows.positions(second_batch["x"]).mean(1)
    lines = []
    with seeded_evaluation(model, seed):
        first_latents, second_latents = (
            model.guide(on_device_of(model, model.read(each))) for each in (first_batch, second_batch)
        )

        def decoded(latents: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
            joints = windows.positions(decode(model, first_batch, {**first_latents, **latents}, True).cpu())
            mean = joints.mean(1)
            return mean, joints - mean[:, None]

        pose, motion = decoded({})
        for latent in model.latents:
            for amount in SHARES if first_latents[latent].dim() == 2 else (1.0,):
                mean, deviations = decoded({latent: torch.lerp(first_latents[latent], second_latents[latent], amount)})
                changes = (mean - pose, deviations - motion, mean - goal)
                lines.append([latent, f"{amount:g}", *(f"{1000 * each.norm(dim=-1).mean():.0f}" for each in changes)])
    return lines


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    results: Path | None = None,
    labels: tuple[str, ...] = ("style", "content"),
    splits: tuple[str, ...] = ("train", "test"),
    count: int = 200,
    seed: int = 0,
) -> None:
    """Write the tables.

    Args:
        runs: run directories.
        results: folder of the tables, such as benchmarks/results; None prints them.
        labels: labels that probes predict.
        splits: splits of the windows; each has its own probes.
        count: number of windows to decode with a latent of another window.
        seed: seed of all draws.
    """
    probe_rows, swap_rows = [], []
    for path in runs:
        run = loaded(path)
        for split in splits:
            windows = run.data.windows(split)
            probe_rows += [[path.name, split, *line] for line in probes(run.model, windows, labels, seed)]
        windows = run.data.windows("test")
        swap_rows += [[path.name, *line] for line in swaps(run.model, windows, labels[0], count, seed)]
    probe_table = Table(["", "windows", "probe of", *labels, "bone lengths, R²"], probe_rows)
    columns = ["mean pose moved, mm", "motion about it moved, mm", "mean pose from theirs, mm"]
    header = ["", "latent", "share of another's", *columns]
    write(results, {"hit_dvae/probes": probe_table, "hit_dvae/exchanged-latents": Table(header, swap_rows)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
