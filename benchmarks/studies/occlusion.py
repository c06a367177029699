"""Write tables of a comparison of methods and baselines that fill gaps in motion.

Joints of the recordings are hidden in bursts (`dvae.motion.occlude`), in training and in test. Methods are fitted to
the observed entries. They fill the gaps of whole test windows with means given latents of their guide.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

import dvae
from dvae import motion
from dvae.data import Batch
from dvae.data.sequences import interpolate_missing
from dvae.inference.evaluation.estimates import clustered_variance, linearised
from dvae.inference.evaluation.evaluation_windows import cluster_index
from dvae.inference.evaluation.references import distances

from .results import Table, write

METHODS: dict[str, dict[str, Any]] = {
    "srnn": {"residual": 0.9, "scheduled_sampling": 0.0},
    "hit-dvae": {"loss": "evidence", "heading": True, "scheduled_sampling": 0.0},
}
"""Options for teacher-forced imputation; the others are the presets."""
STEPS = {"srnn": 1500, "hit-dvae": 250}
NEIGHBOURS = 10
LENGTHS = ((1, 10), (11, 30), (31, None))
"""Ranges of the length of gaps inside the window, in frames."""


def bursts(mask: Tensor) -> Tensor:
    """Return the length of the gap around each entry, (N, T, D); 0 for observed entries."""
    step = torch.arange(1, mask.shape[1] + 1)[:, None]
    before = torch.where(mask, step, 0).cummax(1).values
    after = torch.where(mask, step, mask.shape[1] + 1).flip(1).cummin(1).values.flip(1)
    return torch.where(mask, 0, after - before - 1)


def neighbours(windows: motion.Windows, training: motion.Windows, batch: Mapping[str, Tensor]) -> Tensor:
    """Return the mean of the nearest training windows, by their common entries and at one heading."""
    view = motion.Heading(windows.skeleton, windows.protocol.observed)

    def aligned(each: Mapping[str, Tensor]) -> dict[str, Any]:
        return view(Batch({**each, "mask": {"x": each["mask"]}}))

    queries, candidates = aligned(batch), aligned(training.all())
    gaps = [each["mask"]["x"].flatten(1) for each in (queries, candidates)]
    nearest = (
        distances(queries["x"].flatten(1), candidates["x"].flatten(1), *gaps).topk(NEIGHBOURS, largest=False).indices
    )
    interpolated = interpolate_missing(candidates["x"], candidates["mask"]["x"])
    means = torch.stack([interpolated[some].mean(0) for some in nearest])
    return view.inverse({"x": means, "heading": queries["heading"]})["x"]


def imputed(model: Any, batch: Mapping[str, Tensor], samples: int, seed: int) -> tuple[Tensor, Tensor]:
    """Return the mean over draws (N, T, D) and the spread of each joint (N, T, J)."""
    means, spreads = [], []
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for rows in torch.arange(len(batch["x"])).split(64):
            filled = model.impute({name: value[rows] for name, value in batch.items()}, samples, draw=False)["x"]
            means.append(filled.mean(0))
            spreads.append(filled.var(0).unflatten(-1, (-1, 3)).sum(-1).sqrt())
    return torch.cat(means), torch.cat(spreads)


def sums(values: Tensor, gaps: Tensor, places: np.ndarray) -> np.ndarray:
    """Return sums by clip of values (N, T, J) over all gaps, and over each range of gap lengths, as (4, C)."""
    ranges = [(gaps >= low) & (gaps <= (high or gaps.shape[1])) for low, high in ((1, None), *LENGTHS)]
    by_window = [torch.where(counted, values.double(), 0.0).sum((1, 2)).numpy() for counted in ranges]
    return np.stack([np.bincount(places, weights=each) for each in by_window])


def cells(means: np.ndarray, weights: np.ndarray) -> list[str]:
    """Return means over hidden entries with their standard errors, clustered by clip."""
    formatted = []
    for values, weight in zip(means, weights, strict=True):
        mean, deviations = linearised(values, np.maximum(weight, 1e-9))
        formatted.append(f"{mean:.1f} ± {clustered_variance(deviations) ** 0.5:.1f}" if weight.any() else "–")
    return formatted


def fit_method(name: str, data: motion.MotionData, steps: int, seed: int) -> Any:
    """Fit a method to the observed entries."""
    train = data.windows("train")
    torch.manual_seed(seed)
    method = dvae.method(name, **METHODS[name], warm_up=steps // 3).resolve_defaults(train)
    model = method.build(data.schema)
    recipe = method.train(train, None, steps)
    dvae.fit(model, recipe, batch_size=32, learning_rate=2e-3, decay=0.5, seed=seed, progress=False)
    return model.eval()


def main(
    data: Path,
    results: Path | None = None,
    protocol: str = "bandai2-tuning",
    share: float = 0.2,
    length: float = 15.0,
    stride: int = 30,
    seeds: int = 2,
    samples: int = 5,
    steps: float = 1.0,
) -> None:
    """Write the table.

    Args:
        data: motion file.
        results: folder of the tables, such as benchmarks/results; None prints them.
        protocol: name of the protocol that cuts and splits windows.
        share: hidden fraction of the joints.
        length: mean length of a burst, in frames.
        stride: frames between test windows.
        seeds: number of fits of each method.
        samples: number of draws of the latents to average.
        steps: fraction of the training steps.
    """
    recording = motion.read_motion(data)
    dataset = motion.MotionData(str(data), motion.occlude(recording, share, length), motion.PROTOCOLS[protocol])
    test, training = dataset.windows("test"), dataset.windows("train+validation")
    batch, truth = test.all(stride), motion.windows(recording, dataset.protocol, "test").all(stride)["x"]
    places = cluster_index(test.index(stride)).numpy()
    gaps = bursts(batch["mask"]).unflatten(-1, (-1, 3))[..., 0]

    weights = sums(torch.ones_like(gaps), gaps, places)

    def means(values: Tensor) -> np.ndarray:
        return 1000 * sums(values, gaps, places) / np.maximum(weights, 1)

    def errors(x: Tensor) -> np.ndarray:
        return means((x - truth).unflatten(-1, (-1, 3)).norm(dim=-1))

    errors_by_method = {
        "straight line": [errors(interpolate_missing(batch["x"], batch["mask"]))],
        f"{NEIGHBOURS} neighbours": [errors(neighbours(test, training, batch))],
    }
    spreads: dict[str, list[np.ndarray]] = {}
    for name in METHODS:
        for seed in range(seeds):
            start = time.process_time()
            model = fit_method(name, dataset, max(round(steps * STEPS[name]), 1), seed)
            print(f"{name}, seed {seed}: fitted in {time.process_time() - start:.0f} s of processor time", flush=True)
            mean, spread = imputed(model, batch, samples, seed)
            errors_by_method.setdefault(name, []).append(errors(mean))
            spreads.setdefault(name, []).append(means(spread))

    def over(by_seed: list[np.ndarray]) -> list[str]:
        return [f"{np.average(each[0], weights=weights[0]):.1f}" for each in by_seed]

    ranges = ["all", *(f"{low} to {high}" if high else f"{low} or more" for low, high in LENGTHS)]
    rows, differences = [], []
    for name, by_seed in errors_by_method.items():
        average, spread = np.mean(by_seed, 0), over([np.mean(spreads[name], 0)]) if name in spreads else ["–"]
        rows.append([name, *cells(average, weights), *spread, ", ".join(over(by_seed)) if name in spreads else "–"])
        differences.append([name, *cells(average - errors_by_method["straight line"][0], weights)])
    note = f"{len(truth)} windows of {len(set(places))} clips, {int(weights[0].sum()):,} hidden joint positions."
    scores = Table(["", *ranges, "spread", "seeds"], rows, note)
    others = Table(["minus straight line", *ranges], differences[1:])
    write(results, {"occlusion/errors": scores, "occlusion/differences": others})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
