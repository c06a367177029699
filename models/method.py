"""What a method is: two equations, a model built for data, and a recipe of how that is trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from typing_extensions import override

from ..data.batch import WHOLE
from ..data.schema import Schema
from ..data.sequences import Hiding, bridged
from ..data.views import View
from ..distributions import FixedNormal, Flow, LawSpec, Mixture, Normal, StudentT, Vamp
from ..distributions.priors import VampLaw
from ..factorization.inversion import guide
from ..factorization.notation import Factorization
from ..inference.training.objectives import Evidence, Objective
from ..inference.training.options import Stage
from ..inference.training.recipe import Recipe, Trainable
from ..inference.training.schedules import Cosine, Logistic, Ramp, Schedule
from ..networks import NetworkSpec
from ..options import Amount, Delay, Range, Share, Size
from ..program.model import DynamicalVAE
from ..program.rollout import SelfFeeding

SHAPES: dict[str, type[Ramp | Cosine | Logistic]] = {"linear": Ramp, "cosine": Cosine, "logistic": Logistic}


@dataclass(frozen=True)
class Method(Trainable):
    """A method of the literature; a subclass is one file of this package, and its fields are its options.

    It has four hooks: `equations`, `suited` (options that are left open, chosen for the data), `build` (the model) and
    `train` (the recipe). Most models follow from their equations, `sizes`, `networks` and `laws`.

    Args:
        latent: size of z.
    """

    generative: ClassVar[str]
    inference: ClassVar[str]

    latent: Size | None = 16

    def equations(self) -> tuple[Factorization, Factorization]:
        """The generative model and the guide, which has no factor where there are no latents."""
        generative = Factorization.parse(self.generative)
        return generative, guide(generative, self.inference)

    def sizes(self) -> dict[str, int]:
        """Sizes of the latents."""
        return {"z": self.latent or 0}

    def networks(self) -> Mapping[str, NetworkSpec]:
        """Networks by factor."""
        raise NotImplementedError(
            f"{type(self).__name__} says nothing of its networks; give it `def networks(self)` that returns them by "
            'factor, such as {"default": Recurrent(64)}, or a `build` of its own'
        )

    def laws(self) -> Mapping[str, LawSpec]:
        """Laws by factor; normal where nothing is said."""
        return {}

    def described(self, sizes: Mapping[str, int]) -> dict[str, Any]:
        """What a `DynamicalVAE` is built from, for data of these sizes."""
        generative, inference = self.equations()
        given = {"generative": generative, "inference": inference, "sizes": {**self.sizes(), **sizes}}
        return {**given, "network": self.networks(), "laws": dict(self.laws())}


@dataclass(frozen=True)
class LikelihoodMethod(Method):
    """A method with a likelihood whose model follows from its networks and laws, and is trained on the evidence.

    A subclass gives `networks`, and `sizes` and `laws` where these are other ones.

    Args:
        emission: distribution of x: "fixed" (normal, one learned scale per coordinate), "unit" (normal, variance 1),
            "normal" (scale read from the parents) or "student" (Student t). Where it is left open, what the columns of
            a table say, or "fixed".
        residual: share of x_{t-1} that the mean of x_t keeps; the factor must read x_{t-1}. With 1, an offset, one step
            ahead is sharp, but a free run can drift without bound; somewhat less forgets where it was.
        self_feeding: scheduled sampling: final probability that a frame of x's history is the model's own mean. It
            rises from 0 over a third of training, after the first tenth, and carries no gradient. Nothing is fed to a
            model that reads no x. Where it is left open, 1 for data with a horizon and 0 for others
            (docs/results/tuning.md).
    """

    apart: ClassVar[tuple[str, ...]] = ()
    """Factors that read no covariates, such as "p(z)"."""

    emission: Literal["fixed", "unit", "normal", "student"] | None = None
    residual: Share = 0.0
    self_feeding: Share | None = 0.0

    @override
    def suited(self, data: Any) -> Self:
        """With the scheduled sampling chosen for these data, where it is left open."""
        if self.self_feeding is not None:
            return self
        return replace(self, self_feeding=float(Schema.of(data).observed is not None))

    @override
    def laws(self) -> Mapping[str, LawSpec]:
        """Laws by factor: that of x, where the data say none."""
        emissions: dict[str, LawSpec] = {
            "normal": Normal(residual=self.residual),
            "fixed": FixedNormal(scale=0.1, learned=True, residual=self.residual),
            "unit": FixedNormal(residual=self.residual),
            "student": StudentT(residual=self.residual),
        }
        return {"p(x)": emissions[self.emission or "fixed"]}

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """The model of these equations, whose factors read the covariates of the data too."""
        model = self.suited_to(Schema.of(data), extended=True)
        model.feeding = SelfFeeding(0.0, gradient=False)
        return model

    def suited_to(
        self, schema: Schema, extended: bool, kind: type[DynamicalVAE] = DynamicalVAE, view: View | None = None
    ) -> DynamicalVAE:
        """The model for data, with their law and their units.

        Args:
            schema: of the data.
            extended: whether factors read the covariates of the data too, whatever the equations say.
            kind: of the model.
            view: of the model, in place of the data's own.
        """
        generative, inference = self.equations()
        names = {name for part in (generative, inference) for name in (*part.variables, *part.context)}
        if extended:
            generative, inference = (part.given(*schema.covariates, self.apart) for part in (generative, inference))
            names |= {name for part in schema.covariates for name in part}
        described = self.described({name: size for name, size in schema.sizes.items() if name in names})
        described |= {"generative": generative, "inference": inference}
        if schema.emission is not None and self.emission is None:
            described["laws"]["p(x)"] = self.of_columns(schema.emission)
        model = kind(**{"indicators": schema.indicators, **described}, view=view or schema.view)
        model.per = schema.per
        for name, coordinates in schema.units.items():
            model.standardise(name, coordinates)
        return model

    def of_columns(self, law: LawSpec) -> LawSpec:
        """The law of x where the columns of a table say one: theirs.

        Raises:
            ValueError: a residual, which theirs have not.
        """
        if self.residual:
            raise ValueError(
                f"residual is {self.residual}, but the law of x is that of its columns, which adds no previous "
                'value; leave residual at 0, or give all columns one law that does, by emission="normal"'
            )
        return law

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """One stage that minimises the negative evidence, with self-feeding as the options say."""
        return Recipe(train, validation, [Stage(steps, self.objective())], self._feeding(steps))

    def objective(self) -> Objective:
        """What training minimises."""
        return Evidence()

    def _feeding(self, steps: int) -> Schedule | float:
        """Probability of self-feeding over a run of `steps`; 0 for a model that reads no data, where nothing is fed."""
        p, q = self.equations()
        reads = {parent.name for factor in p.factors for parent in factor.parents}
        if not self.self_feeding or not reads & (set(p.variables) - set(q.variables)):
            return 0.0
        return rising(self.self_feeding, steps)


@dataclass(frozen=True)
class LatentMethod(LikelihoodMethod):
    """A method with latents and a likelihood; see `LikelihoodMethod`.

    Args:
        prior: distribution of the static latents without parents: "standard" (normal, nothing learned), "mixture" (of
            normals), "vamp" (of the guide's posteriors of learned pseudo-sequences) or "flow".
        prior_components: of "mixture" and "vamp".
        prior_steps: length of the pseudo-sequences of "vamp"; at most that of the training windows.
        warm_up: steps over which the KL weight rises from 0 to 1.
        warm_up_shape: form of that rise.
        free_bits: nats per frame below which the KL of a latent, averaged over the batch, costs nothing more.
        hide: share of the entries of training windows that are hidden from the guide and the likelihood, anew in every
            batch, so that the guide learns to do without them; it then reads indicators of what was observed.
    """

    latent: Size = 16
    prior: Literal["standard", "mixture", "vamp", "flow"] = "standard"
    prior_components: Annotated[int, Range(1, 1024)] = 16
    prior_steps: Annotated[int, Range(1, 1024)] = 16
    warm_up: Delay | None = 500
    warm_up_shape: Literal["linear", "cosine", "logistic"] = "linear"
    free_bits: Amount = 0.0
    hide: Annotated[float, Range(0, 1, below=True)] = 0.0

    @override
    def described(self, sizes: Mapping[str, int]) -> dict[str, Any]:
        """With indicators of x, where entries of it are hidden."""
        return {**super().described(sizes), **({"indicators": ("x",)} if self.hide else {})}

    @override
    def laws(self) -> Mapping[str, LawSpec]:
        """Laws by factor: that of x, and of static latents without parents, where `prior` is not "standard".

        Raises:
            ValueError: a prior without such a latent.
        """
        laws = super().laws()
        if self.prior == "standard":
            return laws
        priors: dict[str, LawSpec] = {
            "mixture": Mixture(self.prior_components),
            "vamp": Vamp(self.prior_components, self.prior_steps),
            "flow": Flow(),
        }
        p, q = self.equations()
        latents = [f.child for f in p.factors if f.child in q.variables and not (f.local or f.parents)]
        if not latents:
            raise ValueError(
                f"prior={self.prior!r} is for a static latent without parents, such as p(w), which {p.text} does not "
                'have; use prior="standard"'
            )
        return {**laws, **{f"p({name})": priors[self.prior] for name in latents}}

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """One stage that minimises the negative evidence, with warm-up, free bits and self-feeding as the options say.

        Raises:
            ValueError: on preparing the model, the pseudo-sequences of a prior are longer than the windows.
            SchemaError: entries are to be hidden of data of which nobody knows which are observed together.
        """
        batches = Hiding(train, self.hide, Schema.of(train, self.name).together) if self.hide else train
        return replace(super().train(batches, validation, steps), prepare=partial(start_priors, train=train))

    @override
    def objective(self) -> Objective:
        """What training minimises."""
        weight = SHAPES[self.warm_up_shape](0.0, 1.0, steps=self.warm_up) if self.warm_up else 1.0
        return Evidence(kl_weight=weight, free_bits=self.free_bits)


def rising(level: float, steps: int) -> Ramp:
    """From 0 to a level over a third of a run of `steps`, after its first tenth."""
    return Ramp(0.0, level, steps=max(steps // 3, 1), delay=steps // 10)


def fit_units(model: DynamicalVAE, train: Any) -> None:
    """Takes the units of x from 1024 windows of the training data, as the model sees them."""
    seen = model.read(train.sample(1024, torch.default_generator), precise=True)
    model.units[WHOLE].fit(bridged(seen[WHOLE], seen.mask()))


def start_priors(model: DynamicalVAE, train: Any) -> None:
    """Has the pseudo-sequences of Vamp priors start at windows of the training data, as the model sees them."""
    for law in model.modules():
        if isinstance(law, VampLaw):
            law.start_at(model.read(train.sample(law.components, torch.default_generator)))
