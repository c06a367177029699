"""Ensembles: equal-weight mixtures of models that differ only in their weights.

    p(x) = 1/S sum over s of p(x | weights_s)

The weights are of several training seeds, or draws from a posterior of the weights (`weight_posterior`).
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ...program.model import DynamicalVAE


class Ensemble(nn.Module):
    """Equal-weight mixture of models, for `evaluate` and `compare`; it is not a model and cannot be fitted.

    `evaluate` scores its forecasts. `compare` also reports its bounds: the log mean over models of the density of a
    whole sequence. A leave-future-out density is then conditional: models that explain the past better weigh more.
    Forecasts weigh all models equally. Name the row so that a reader sees that it is a mixture.

    Args:
        models: models with the same equations and sizes.

    Raises:
        TypeError: when one of `models` is not a `DynamicalVAE`.
        ValueError: when there are none, or they differ in more than their weights.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})"
        >>> models = [dvae.DynamicalVAE(*pair, {"z": 1, "x": 2}) for seed in range(3)]
        >>> dvae.Ensemble(models).forecast(torch.randn(4, 5, 2), horizon=6, samples=10)["x"].shape
        torch.Size([10, 4, 6, 2])
    """

    likelihood = False  # for `evaluate`; `compare` computes the bounds

    def __init__(self, models: Sequence[DynamicalVAE]):
        super().__init__()
        require_same("an ensemble", models)
        self.models = nn.ModuleList(models)
        self.generative, self.inference, self.is_drawn = models[0].generative, models[0].inference, models[0].is_drawn

    def forecast(self, batch: Any, horizon: int, samples: int = 1, **options: Any) -> dict[str, Tensor]:
        """Return forecasts by name, (K, B, ...), of which each model draws K / S, in random order.

        If S does not divide K, the models that draw one more are chosen at random.

        Args:
            batch, horizon, options: as in `DynamicalVAE.forecast`.
            samples: K, number of forecasts of all models together.
        """
        counts = torch.full((len(self.models),), samples // len(self.models))
        counts[torch.randperm(len(self.models))[: samples % len(self.models)]] += 1
        draws = [
            model.forecast(batch, horizon, count, **options)  # type: ignore[operator, union-attr]
            for model, count in zip(self.models, counts.tolist(), strict=True)
            if count or samples < 1  # the model refuses too few
        ]
        order = torch.randperm(samples)
        return {name: torch.cat([each[name] for each in draws])[order] for name in draws[0]}


def require_same(label: str, models: Sequence[Any]) -> None:
    """Check that models differ only in their weights.

    Raises:
        TypeError, ValueError: as in `Ensemble`.
    """
    if not models:
        raise ValueError(f"expected at least one model in {label}, got none")
    if wrong := next((model for model in models if not isinstance(model, DynamicalVAE)), None):
        raise TypeError(f"{label} has a {type(wrong).__name__}; expected a DynamicalVAE for each seed")
    specs = [(model.generative.text, model.inference.text, dict(model.sizes)) for model in models]
    if other := next((spec for spec in specs if spec != specs[0]), None):
        raise ValueError(
            f"the models of {label} must differ only in their seed, but one is {specs[0]} and another {other}; give "
            "them different names"
        )
