"""Base of the deterministic predictors: LSTMs of the past, squared errors and a single future.

    p(x_t | x_{<t})        no guide, because there are no latents

A forecast continues from its own means. All K futures are therefore equal, and their diversity is 0.

Our additions: networks read and predict poses that are standardised by the mean pose and one scale. Windows may be
rotated so that the last observed pose faces one way, which helps on small data sets. For skeletons that the papers do
not use, networks are small.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import sqrt
from typing import Any, ClassVar, Self

from typing_extensions import override

from ...data.batch import WHOLE
from ...data.schema import Schema
from ...distributions import DistributionSpec, FixedNormal
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...motion import Heading
from ...motion.data.protocols import Poses
from ...options import Layers, Size
from ...program.model import DynamicalVAE
from ...program.rollout import InputNoise, ScheduledSampling
from ..method import LikelihoodMethod, fit_units
from ..motion.poses import PoseMethod


@dataclass(frozen=True)
class DeterministicMethod(PoseMethod, LikelihoodMethod):
    """A method without latents whose forecasts have no noise.

    Args:
        latent: always None; the method has no latents.
        emission: distribution of x. By default the distributions of a table's columns, or a normal with variance 1/2,
            whose negative log-density is the squared error. With any other emission, forecasts are draws.
        width: width of the LSTMs' states; by default the paper's value for Human3.6M and HumanEva, and 256 for other
            skeletons.
        layers: number of LSTMs, each on the states of the previous one.
        standardise: whether networks read and predict standardised x, by its mean and one scale (`dvae.data.units`).
        heading: whether to rotate every window so that its last observed pose faces one way, and rotate the futures
            back. Bounds are comparable only among models that rotate windows. By default off for Human3.6M, HumanEva
            and data other than joint positions, and on for other skeletons with known left and right.
    """

    generative = "p(x_t | x_{<t})"
    inference = ""

    trainings: ClassVar[Mapping[str, Training]] = {
        **dict.fromkeys(("human36m", "humaneva"), Training(batch_size=32, learning_rate=1e-4)),
        "": Training(learning_rate=3e-3, decay=0.5),
    }

    latent: None = None
    width: Size | None = None
    layers: Layers = 1
    standardise: bool = True
    heading: bool | None = None

    @override
    def sizes(self) -> dict[str, int]:
        """Return no sizes: the method has no latents."""
        return {}

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return the distribution of `emission`, by default the one of the squared error."""
        if self.emission is not None:
            return super().distributions()
        return {"p(x)": FixedNormal(scale=sqrt(0.5), residual=self.residual, error_weight=True)}

    @override
    def resolve_defaults(self, data: Any) -> Self:
        """Return the method with unset options chosen for the skeleton, or for data other than joint positions."""
        schema = Schema.of(data)
        if isinstance(schema, Poses) and schema.representation == self.representation:
            return super().resolve_defaults(schema)
        return self.with_presets({**self.presets[""], "heading": False})

    def fed(self) -> ScheduledSampling | InputNoise:
        """Return the replacement for the true past in training: the own output of the network, or noisy data.

        A schedule sets the probability of its own output, or the scale of the noise.
        """
        raise NotImplementedError

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model, whose networks also read the covariates of the data.

        Raises:
            SchemaError: if `heading` is set and the data are not joint positions.
        """
        schema, method = Schema.of(data), self.resolve_defaults(data)
        view = None
        if method.heading:
            poses = Poses.of(schema, self.name, self.representation)
            view = Heading(poses.skeleton, poses.protocol.observed)
        model = method.build_for_data(schema, True, view=view)
        if method.standardise and not schema.units:
            model.standardise(WHOLE)
        model.feeding = method.fed()
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return one stage that minimises squared errors, with the history that `fed` returns."""
        stages = [Stage(steps, self.objective())]
        return Recipe(train, validation, stages, self._feeding(steps), partial(self._start, train=train))

    def _start(self, model: DynamicalVAE, train: Any) -> None:
        if WHOLE in model.units and not model.units[WHOLE].scale.dim():  # units of columns are known
            fit_units(model, train)
