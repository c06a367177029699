"""Protocols of the models that inference requires, in addition to torch's modules.

`DynamicalVAE` implements all of them. A density or a classifier does not forecast and implements `Program` only. A
custom forecaster of any kind implements `Forecasting`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor
from typing_extensions import Protocol, runtime_checkable

from ..factorization.notation import Factorization


@runtime_checkable
class Program(Protocol):
    """A Pyro model and its guide, for bounds and training."""

    @property
    def likelihood(self) -> bool:
        """Whether the data have a density given the latents; bounds require it."""

    @property
    def per(self) -> str:
        """Unit of one log-likelihood: "step", "frame" or "window"."""

    def model(self, batch: Any, **options: Any) -> Any:
        """Run the generative program on a batch."""

    def guide(self, batch: Any, **options: Any) -> Any:
        """Run the inference program on a batch, with the options of `model`."""


@runtime_checkable
class Emitting(Protocol):
    """A forecaster with a default for whether its forecasts draw the data or use means."""

    def is_drawn(self, means: bool = False) -> bool:
        """Return whether forecasts draw the data by default, as in `DynamicalVAE.is_drawn`."""


@runtime_checkable
class Forecasting(Protocol):
    """A model that forecasts, for evaluation. With a likelihood it also implements `Program` and has a bound."""

    @property
    def likelihood(self) -> bool:
        """Whether the model has a bound, which evaluation then reports."""

    @property
    def generative(self) -> Factorization:
        """Generative factorization, stored with results."""

    @property
    def inference(self) -> Factorization:
        """Factorization of the guide."""

    def forecast(self, batch: Any, horizon: int, samples: int = 1, **options: Any) -> Mapping[str, Tensor]:
        """Return {"x": (S, B, H, D)}, futures of observed frames (B, O, D); options include `draw_emission`."""
