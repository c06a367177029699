"""Test whether a model uses a latent, by forecasts with this latent drawn from another distribution.

If a model has learned to ignore a latent, its futures do not depend on it. With draws from N(50, 50) instead of the
prior N(0, I), they remain as accurate and as similar to one another (Aliakbarian, Saleh, Salzmann, Petersson and Gould,
2020, arXiv 1908.00733, section 4.1). The futures of a model that uses the latent become wrong. Compare the diversities:

    models = {"as it is": model, "probed": RedrawnModel(model, {"z": Normal(50.0, 50**0.5)})}
    evaluation = dvae.evaluate(models, windows, scores=scores)
    evaluation.ratio("probed", "as it is", "APD")

The paper does not state whether the second 50 is a variance, as I in the prior suggests, or a standard deviation; both
are far outside the prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pyro.poutine.messenger import Messenger
from torch import Tensor, nn
from torch.distributions import Distribution

from ...program.batch import AnyBatch
from ...program.conditional import like


class RedrawnModel(nn.Module):
    """Model whose forecasts draw some latents from other distributions, for use with `evaluate`.

    Args:
        model: a `DynamicalVAE`.
        distributions: distribution of each coordinate of a latent, by name; it broadcasts to the latent. Every draw of
            the latent is from it, even where the guide would infer it from the past.

    Raises:
        ValueError: when a name is not a latent of the model, or the latent has parents.
    """

    likelihood = False  # no bounds: they would be the original model's

    def __init__(self, model: Any, distributions: Mapping[str, Distribution]) -> None:
        super().__init__()
        for name, distribution in distributions.items():
            if not isinstance(distribution, Distribution) or distribution.event_shape:
                raise ValueError(
                    f"the distribution of {name} is {distribution!r}; expected a distribution of one number, such as "
                    "Normal(50., 7.)"
                )
        if not distributions or not distributions.keys() <= {*model.latents}:
            raise ValueError(
                f"latents with another distribution must be some of {', '.join(model.latents)}; got "
                f"{', '.join(distributions) or 'none'}"
            )
        for name in distributions:
            if parents := model.generative.factor(name).parents:
                raise ValueError(
                    f"{name} depends on {', '.join(parent.name for parent in parents)}, so it has no single "
                    "distribution to replace; use a latent without parents, as in p(z)"
                )
        self.model, self.distributions = model, dict(distributions)
        self.generative, self.inference = model.generative, model.inference

    def is_drawn(self, means: bool = False) -> bool:
        """Return `is_drawn` of the model."""
        return bool(self.model.is_drawn(means))

    def forecast(self, batch: AnyBatch, horizon: int, samples: int = 1, **options: Any) -> Mapping[str, Tensor]:
        """Return the model's forecast, with latents from the other distributions."""
        with self.model.running(), _Redrawing(self.distributions, like(self.model)):
            forecast: Mapping[str, Tensor] = self.model.forecast(batch, horizon, samples, **options)
            return forecast


class _Redrawing(Messenger):
    """Handler that draws the named sites from the given distributions, in the dtype and on the device of `kind`."""

    def __init__(self, distributions: Mapping[str, Distribution], kind: Tensor) -> None:
        super().__init__()
        self.distributions, self.kind = distributions, kind

    def _pyro_sample(self, msg: Any) -> None:
        if msg["name"] in self.distributions and msg["value"] is None:
            shape = msg["fn"].batch_shape + msg["fn"].event_shape
            msg["value"] = self.distributions[msg["name"]].expand(shape).sample().to(self.kind)
