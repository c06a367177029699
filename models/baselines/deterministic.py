"""What deterministic predictors share: LSTMs of the past, squared errors, and one future.

    p(x_t | x_{<t})        no guide, as nothing is latent

A forecast goes on from its own means, so that all of K futures are one and their diversity is 0.

Ours: networks read and make poses without unit, by the mean pose and one spread; windows may be turned so that the last
observed pose faces one way, which helps on small sets. Off the skeletons of the papers' data, networks are small.
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
from ...distributions import FixedNormal, LawSpec
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...motion import Heading, Skeleton
from ...motion.data.protocols import Poses
from ...options import Layers, Size
from ...program.model import DynamicalVAE
from ...program.rollout import InputNoise, SelfFeeding
from ..method import LikelihoodMethod, fit_units
from ..motion.poses import PoseMethod


@dataclass(frozen=True)
class DeterministicMethod(PoseMethod, LikelihoodMethod):
    """A method without latents whose forecasts have no noise.

    Args:
        latent: there is none.
        emission: as everywhere; where it is left open, what the columns of a table say, or else variance 1/2, minus
            whose log-density is the squared error. Any other is the density of a model whose forecasts are draws.
        width: of the LSTMs' states; None for the paper's with the skeletons of Human3.6M and HumanEva, 256 with others.
        layers: LSTMs, each on the states of the one before.
        standardise: networks read and make x without unit, by its mean and one spread (`dvae.data.units`).
        heading: turn every window so that its last observed pose faces one way, and the futures back: bounds compare
            with those of models that turn windows too. None for not with the skeletons of Human3.6M and HumanEva, nor
            with data that are no positions of joints, and for so with others whose left and right are known.
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
        """No latents."""
        return {}

    @override
    def laws(self) -> Mapping[str, LawSpec]:
        """The squared error, where no other law is asked for."""
        if self.emission is not None:
            return super().laws()
        return {"p(x)": FixedNormal(scale=sqrt(0.5), residual=self.residual, error_weight=True)}

    @override
    def preset(self, skeleton: Skeleton) -> Mapping[str, Any]:
        """Where left and right are unknown, so are headings."""
        found = super().preset(skeleton)
        return found if skeleton.left and skeleton.right else {**found, "heading": False}

    @override
    def suited(self, data: Any) -> Self:
        """With the options that are left open chosen for the skeleton, or for data that are no positions of joints."""
        schema = Schema.of(data)
        if isinstance(schema, Poses) and schema.protocol.representation == self.representation:
            return super().suited(schema)
        return self.filled({**self.presets[""], "heading": False})

    def fed(self) -> SelfFeeding | InputNoise:
        """What stands in for the data's history in training, of which a schedule tells the level."""
        raise NotImplementedError

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """The model, whose networks read the covariates of the data too.

        Raises:
            SchemaError: data to be turned that are no positions of joints.
        """
        schema, method = Schema.of(data), self.suited(data)
        view = None
        if method.heading:
            poses = Poses.of(schema, self.name, self.representation)
            view = Heading(poses.skeleton, poses.protocol.observed)
        model = method.suited_to(schema, True, view=view)
        if method.standardise and not schema.units:
            model.standardise(WHOLE)
        model.feeding = method.fed()
        return model

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """One stage that minimises squared errors, on a history as the method feeds it."""
        stages = [Stage(steps, self.objective())]
        return Recipe(train, validation, stages, self._feeding(steps), partial(self._start, train=train))

    def _start(self, model: DynamicalVAE, train: Any) -> None:
        if WHOLE in model.units and not model.units[WHOLE].scale.dim():  # those of columns are known
            fit_units(model, train)
