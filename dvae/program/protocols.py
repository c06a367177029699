"""What inference needs of a model beyond torch's modules, as protocols.

`DynamicalVAE` has it all. A density or a classifier, which forecasts nothing, is a `Program`; a forecaster of one's
own, whatever it is made of, is `Forecasting`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor
from typing_extensions import Protocol, runtime_checkable

from ..factorization.notation import Factorization


@runtime_checkable
class Program(Protocol):
    """A Pyro model and its guide, for bounds and the loop."""

    @property
    def likelihood(self) -> bool:
        """Whether the data have a density given the latents; without it there is no bound."""

    @property
    def per(self) -> str:
        """What there is one log-likelihood of: "frame" or "window"."""

    def model(self, batch: Any, **options: Any) -> Any:
        """The generative program of a batch."""

    def guide(self, batch: Any, **options: Any) -> Any:
        """The inference program of a batch, with the options of `model`."""


@runtime_checkable
class Emitting(Protocol):
    """A forecaster that decides whether it draws the data."""

    def is_drawn(self, means: bool = False) -> bool:
        """Whether forecasts draw the data by default; see `DynamicalVAE.is_drawn`."""


@runtime_checkable
class Forecasting(Protocol):
    """A model that forecasts, for evaluation; with a likelihood it is a `Program` too, and has a bound."""

    @property
    def likelihood(self) -> bool:
        """Whether there is a bound to score."""

    @property
    def generative(self) -> Factorization:
        """Its equations, for the record."""

    @property
    def inference(self) -> Factorization:
        """Those of its guide."""

    def forecast(self, batch: Any, horizon: int, samples: int = 1, **options: Any) -> Mapping[str, Tensor]:
        """{"x": (S, B, H, D)}, futures of observed frames (B, O, D); options with `draw_emission`."""
