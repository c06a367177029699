"""Diversity of a decoder's initial codes: how much the draws of a model change the code of one past.

A conditional model that predicts a future from a code of its past and noise may learn to ignore the noise. If h_1, ...,
h_K are the codes of K draws for one observation, their diversity is

    d = 2 / (K (K - 1)) sum_{j < k} ||h_j - h_k||

Figure 1 of Aliakbarian, Saleh, Salzmann, Petersson and Gould, 2020, arXiv 1908.00733, shows its mean and standard
deviation over 50 observations, for K = 50. The diversity has the unit of the code. Compare its values only within one
model; between models, compare whether it rises or falls.

If indices are drawn too, as in Mix-and-Match, each code has its own indices. They alone make codes differ, even if the
decoder ignores z. To measure the effect of z alone, draw the indices once for all K codes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import override

from ...data.batch import WHOLE
from ...inference.evaluation.evaluation_windows import on_device_of, seeded_evaluation
from ...inference.evaluation.metrics import average_pairwise_distance
from ...inference.evaluation.record import MODELS, Dims
from ...inference.evaluation.result import Result, Table
from ...inference.training.fit import Callback
from ...inference.training.svi import State
from ...program.batch import AnyBatch


@torch.no_grad()
def codes(model: Any, batch: AnyBatch, samples: int = 50) -> Tensor:
    """Return the initial codes of a forecast, with noise and other random variables drawn as in a forecast.

    If each step has its own latent, the first state depends on the past alone. The codes are then the features of the
    first pose, which combine this state with z_1.

    Args:
        model: model whose network of x has an `entrance`, the module through which the noise enters, such as models
            of "mix-and-match".
        batch: past (B, O, D), as in `forecast`. To share random variables such as indices among all codes, pass
            `model.read(batch)`, which draws them.
        samples: K, number of codes.

    Returns:
        Codes (K, B, L).

    Raises:
        ValueError: if the model has no such network.
    """
    network = model.generator[WHOLE].network if WHOLE in model.generator else None
    entrance = getattr(network, "entrance", None)
    if not isinstance(entrance, nn.Module):
        raise ValueError(
            "codes need a decoder with an `entrance`, the module through which noise enters, as mix-and-match has; "
            + (f"{type(network).__name__} has none" if network is not None else "this model has no single decoder of x")
        )
    outputs: list[Tensor] = []
    hook = entrance.register_forward_hook(lambda module, inputs, output: outputs.append(output))
    try:
        size = model.forecast(batch, 1, samples, chunk=2**62)[WHOLE].shape[1]  # in one chunk
    finally:
        hook.remove()
    return outputs[0].unflatten(0, (samples, size))


def code_diversity(model: Any, batch: AnyBatch, samples: int = 50) -> Tensor:
    """Return the mean distance (B,) between two of K `codes` of each observation, in the unit of the code.

    Args:
        model, batch: as in `codes`.
        samples: K, number of codes.

    Raises:
        ValueError: if `samples` is less than 2.
    """
    if samples < 2:
        raise ValueError(f"samples must be at least 2 to compare codes, got {samples}")
    diversity: Tensor = average_pairwise_distance(codes(model, batch, samples).movedim(0, 1)[:, :, None])
    return diversity


CODES, SAME, UNTRAINED = "codes", "same indices", "untrained"


@dataclass(frozen=True, repr=False, eq=False)
class CodeScores(Result):
    """The diversity of the codes of models, by observation.

    Attributes:
        rows: `{model: {score: values (N,)}}` for N observations: "codes"; "same indices", if the model draws random
            variables that all codes can share; and "untrained", of the model before training, if it was given.
        samples: K, number of codes of each observation.
        seed: seed of the draws.
    """

    rows: Annotated[dict[str, Annotated[dict[str, np.ndarray], Dims("observation", name="{}")]], MODELS]
    samples: int
    seed: int

    @override
    def table(self) -> Table:
        """Return means and standard deviations over observations, as in the paper's figure 1."""
        number = len(next(iter(self.rows.values()))[CODES])
        table = Table(
            title=f"diversity of codes · {number} observations, K = {self.samples}",
            caption="mean ± standard deviation over observations; compare values of one model only\n"
            "same indices: indices are drawn once for all codes, so that only z differs",
        )
        for header in ("", UNTRAINED, "trained", SAME):
            table.add_column(header, justify="right")
        for name, scores in self.rows.items():
            values = (scores.get(score) for score in (UNTRAINED, CODES, SAME))
            table.add_row(name, *("–" if x is None else f"{x.mean():.2f} ± {x.std(ddof=1):.2f}" for x in values))
        return table


def code_scores(
    models: Mapping[str, Any],
    batch: Mapping[str, Any],
    samples: int = 50,
    seed: int = 0,
    untrained: Mapping[str, Any] | None = None,
) -> CodeScores:
    """Measure the diversity of the codes of models on the same observations.

    Args:
        models: models by name, as in `codes`.
        batch: past of at least two test windows, as in `forecast`; 50 windows in the paper.
        samples: K, number of codes.
        seed: seed of the draws of every model.
        untrained: the same models before training, by name.

    Raises:
        ValueError: there are fewer than two observations or samples.
        ValueError: a model has no codes.
    """
    if len(batch[WHOLE]) < 2:
        raise ValueError(f"the diversity of codes needs at least two observations, got {len(batch[WHOLE])}")

    def measure(model: Any, same: bool = False) -> np.ndarray:
        pasts = on_device_of(model, batch)
        with seeded_evaluation(model, seed):
            diversity = code_diversity(model, model.read(pasts) if same else pasts, samples)
        return diversity.double().cpu().numpy()

    rows: dict[str, dict[str, np.ndarray]] = {}
    for name, model in models.items():
        rows[name] = {CODES: measure(model)}
        if getattr(model, "shared", None):
            rows[name][SAME] = measure(model, same=True)
        if name in (untrained or {}):
            rows[name][UNTRAINED] = measure((untrained or {})[name])
    return CodeScores(rows, samples, seed)


class CodeDiversity(Callback):
    """Log the diversity of codes during a fit: "codes/diversity" and "codes/deviation", every few steps.

    They are the mean and the standard deviation over the observations of a batch, with the same draws each time. If
    sequences share random variables of the model, "codes/latent" is the mean when these are drawn once. It shows the
    effect of the latents alone. The callback does not change the run.

    Args:
        batch: past of at least two held-out windows, as in `forecast`; 50 windows in the paper.
        every: number of steps between two measurements.
        samples: K, number of codes.
        seed: seed of the draws.
    """

    def __init__(self, batch: Mapping[str, Any], every: int = 100, samples: int = 50, seed: int = 0) -> None:
        if every < 1 or samples < 2 or len(batch[WHOLE]) < 2:
            raise ValueError(
                f"CodeDiversity got {len(batch[WHOLE])} pasts, samples={samples} and every={every}; give at least two "
                "pasts, two samples and one step"
            )
        self.batch, self.every, self.samples, self.seed = batch, every, samples, seed

    @override
    def on_step(self, state: State) -> Mapping[str, float] | None:
        if state.step % self.every:
            return None
        model: Any = state.model
        batch = on_device_of(model, self.batch)
        with seeded_evaluation(model, self.seed):
            diversity = code_diversity(model, batch, self.samples)
        row = {"codes/diversity": float(diversity.mean()), "codes/deviation": float(diversity.std())}
        if getattr(model, "shared", None):
            with seeded_evaluation(model, self.seed):
                row["codes/latent"] = float(code_diversity(model, model.read(batch), self.samples).mean())
        return row
