"""The probe: futures from latents that are drawn from elsewhere, to see whether a model listens to them at all.

Where a model has learned to ignore a latent, it makes the same future whatever that latent is: drawn from N(50, 50) in
place of its prior N(0, I), futures are as good and as much alike as ever (Aliakbarian, Saleh, Salzmann, Petersson and
Gould, 2020, arXiv 1908.00733, section 4.1). A model that listens goes astray. So its diversities are to be compared:

    models = {"as it is": model, "probed": Redrawn(model, {"z": Normal(50.0, 50**0.5)})}
    found = dvae.evaluate(models, windows, scores=scores)
    found.ratio("probed", "as it is", "APD")

The paper does not say whether the second 50 is a variance, as the I beside it is, or a standard deviation; both are far
beyond the prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pyro.poutine.messenger import Messenger
from torch import Tensor, nn
from torch.distributions import Distribution

from ...program.batch import AnyBatch
from ...program.conditional import like


class Redrawn(nn.Module):
    """A model whose forecasts draw some latents from other laws, for `evaluate` and whatever else forecasts.

    Args:
        model: a `DynamicalVAE`.
        laws: latent to the distribution of each of its numbers, or one that broadcasts to them. Wherever the latent is
            drawn it is from this, also where it would be inferred from the past.

    Raises:
        ValueError: no latent of the model, or one that follows from others.
    """

    likelihood = False  # what is scored is not the model's own

    def __init__(self, model: Any, laws: Mapping[str, Distribution]) -> None:
        super().__init__()
        for name, law in laws.items():
            if not isinstance(law, Distribution) or law.event_shape:
                raise ValueError(f"the law of {name} is {law!r}; expected that of one number, such as Normal(50., 7.)")
        if not laws or not laws.keys() <= {*model.latents}:
            raise ValueError(
                f"latents to draw from elsewhere are some of {', '.join(model.latents)}; got "
                f"{', '.join(laws) or 'none'}"
            )
        for name in laws:
            if parents := model.generative.factor(name).parents:
                raise ValueError(
                    f"{name} follows from {', '.join(parent.name for parent in parents)}, so that there is no one law "
                    "to replace; this is for latents that are drawn by themselves, as in p(z)"
                )
        self.model, self.laws = model, dict(laws)
        self.generative, self.inference = model.generative, model.inference

    def is_drawn(self, means: bool = False) -> bool:
        """As the model decides."""
        return bool(self.model.is_drawn(means))

    def forecast(self, batch: AnyBatch, horizon: int, samples: int = 1, **options: Any) -> Mapping[str, Tensor]:
        """As the model's, with latents from the other laws."""
        with self.model.running(), _Redrawing(self.laws, like(self.model)):
            found: Mapping[str, Tensor] = self.model.forecast(batch, horizon, samples, **options)
            return found


class _Redrawing(Messenger):
    """Has sites of these names drawn from these laws, as tensors of one kind."""

    def __init__(self, laws: Mapping[str, Distribution], kind: Tensor) -> None:
        super().__init__()
        self.laws, self.kind = laws, kind

    def _pyro_sample(self, msg: Any) -> None:
        if msg["name"] in self.laws and msg["value"] is None:
            shape = msg["fn"].batch_shape + msg["fn"].event_shape
            msg["value"] = self.laws[msg["name"]].expand(shape).sample().to(self.kind)
