"""What a method is: two equations, its networks and heads, and how it is trained. And the registry of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from importlib.metadata import entry_points
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from torch import nn

from ..inference.batches import Source
from ..inference.fit import Stage
from ..inference.objectives import Evidence, Objective
from ..inference.schedules import Cosine, Linear, Logistic, Schedule
from ..laws.families import FixedNormal, HeadSpec, Normal, StudentT
from ..laws.priors import FlowPrior, MixturePrior, Prior, VampPrior
from ..motion import Skeleton, Windows
from ..networks import NetworkSpec
from ..notation import Factor, Factorization
from ..options import Amount, Delay, Range, Share, Size, check, nearest
from ..program.model import DynamicalVAE
from ..program.rollout import SelfFeeding

SHAPES: dict[str, type[Linear | Cosine | Logistic]] = {"linear": Linear, "cosine": Cosine, "logistic": Logistic}


@dataclass(frozen=True)
class Method:
    """A method of the literature. A subclass is one file of this package: its equations, networks and sizes.

    Args:
        latent: size of z.
        emission: distribution of x: "fixed" (normal, one learned scale per coordinate), "unit" (normal, variance 1),
            "normal" (scale read from the parents) or "student" (Student t).
        residual: share of x_{t-1} that the mean of x_t keeps; the factor must read x_{t-1}. With 1, an offset, one step
            ahead is sharp, but a free run can drift without bound; somewhat less forgets where it was.
        prior: distribution of the static latents without parents: "standard" (normal, nothing learned), "mixture" (of
            normals), "vamp" (of the guide's posteriors of learned pseudo-sequences) or "flow".
        prior_components: of "mixture" and "vamp".
        prior_steps: length of the pseudo-sequences of "vamp"; at most that of the training windows.
        warm_up: steps over which the KL weight rises from 0 to 1.
        warm_up_shape: form of that rise.
        free_bits: nats per frame below which the KL of a latent, averaged over the batch, costs nothing more.
        self_feeding: final probability that a frame of x's history is the model's own mean. It rises from 0 over a
            third of training, after the first tenth, and carries no gradient. Nothing is fed to a model that reads no
            x.

    Raises:
        ValueError: when an option is out of range.
    """

    name: ClassVar[str]
    source: ClassVar[str]
    generative: ClassVar[str]
    inference: ClassVar[str]
    unused: ClassVar[frozenset[str]] = frozenset()  # options that do not apply; the command line does not show them
    likelihood: ClassVar[bool] = True  # without it, the best weights are by the objective in place of a bound
    forecasts: ClassVar[bool] = True  # whether its models forecast motion, which evaluation and comparison ask for
    control: ClassVar[bool] = False  # whether its models make motion from a pose along given paths
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"": {}}  # by the skeleton's name, and "" for any other
    use: ClassVar[str] = "score it with: dvae evaluate {run}"  # what to do with a fitted run

    latent: Size = 16
    emission: Literal["fixed", "unit", "normal", "student"] = "fixed"
    residual: Share = 0.0
    prior: Literal["standard", "mixture", "vamp", "flow"] = "standard"
    prior_components: Annotated[int, Range(1, 1024)] = 16
    prior_steps: Annotated[int, Range(1, 1024)] = 16
    warm_up: Delay | None = 500
    warm_up_shape: Literal["linear", "cosine", "logistic"] = "linear"
    free_bits: Amount = 0.0
    self_feeding: Share = 0.0

    def __post_init__(self) -> None:
        check(self)

    @property
    def selects(self) -> Literal["bound", "loss"]:
        """What tells the best weights (see `Evidence`)."""
        return "bound" if self.likelihood else "loss"

    def equations(self) -> tuple[Factorization, Factorization]:
        """The generative model and the guide."""
        return Factorization.parse(self.generative), Factorization.parse(self.inference)

    def sizes(self) -> dict[str, int]:
        """Sizes of the latents."""
        return {"z": self.latent}

    def networks(self) -> Mapping[str, NetworkSpec]:
        """Networks by factor."""
        raise NotImplementedError(
            f"{type(self).__name__} says nothing of its networks; give it `def networks(self)` that returns them by "
            'factor, such as {"default": Recurrent(64)}, or a `build` of its own'
        )

    def heads(self) -> Mapping[str, HeadSpec]:
        """Heads by factor."""
        kinds: dict[str, HeadSpec] = {
            "normal": Normal(residual=self.residual),
            "fixed": FixedNormal(scale=0.1, learned=True, residual=self.residual),
            "unit": FixedNormal(residual=self.residual),
            "student": StudentT(residual=self.residual),
        }
        return {"p(x)": kinds[self.emission]}

    def priors(self, sizes: Mapping[str, int]) -> Mapping[str, Prior]:
        """Priors of the static latents without parents, where `prior` is not "standard".

        Args:
            sizes: dimension of every variable.

        Raises:
            ValueError: a prior without such a latent.
        """
        if self.prior == "standard":
            return {}
        p, q = self.equations()
        guides = {
            f.child: q.factor(f.child) for f in p.factors if f.child in q.variables and not (f.local or f.parents)
        }
        if not guides:
            raise ValueError(
                f"prior={self.prior!r} is for a static latent without parents, such as p(w), which {p.text} does not "
                'have; use prior="standard"'
            )
        kinds: dict[str, Callable[[Factor], Prior]] = {
            "mixture": lambda guide: MixturePrior(sizes[guide.child], self.prior_components),
            "vamp": lambda guide: VampPrior(
                sizes[guide.child],
                {parent.name: sizes[parent.name] for parent in guide.parents},
                self.prior_components,
                self.prior_steps,
            ),
            "flow": lambda guide: FlowPrior(sizes[guide.child]),
        }
        return {name: kinds[self.prior](guide) for name, guide in guides.items()}

    def build(self, data: Mapping[str, int]) -> DynamicalVAE:
        """The model for data of these sizes, such as {"x": 60}.

        Raises:
            ValueError: a method that needs to know more, which says so and points to `build_for`.
        """
        sizes = {**self.sizes(), **data}
        model = DynamicalVAE(*self.equations(), sizes, self.networks(), self.heads(), self.priors(sizes))
        model.feeding = SelfFeeding(0.0, gradient=False)
        return model

    def needs(self, what: str) -> ValueError:
        """The error of a method that cannot be built from sizes alone, for lack of this."""
        return ValueError(
            f"{what}; use build_for(windows), with windows = dvae.motion.windows(motion, protocol, 'train')"
        )

    def preset(self, skeleton: Skeleton | None = None) -> Mapping[str, Any]:
        """What options that are None stand for, with poses of this skeleton; see `presets`."""
        return self.presets.get("" if skeleton is None else skeleton.name, self.presets[""])

    def filled(self, preset: Mapping[str, Any]) -> Self:
        """The method with options that are None taken from a preset."""
        return replace(self, **{name: value for name, value in preset.items() if getattr(self, name) is None})

    def suited(self, windows: Windows) -> Self:
        """The method with what its options leave open chosen for these windows; itself, where nothing is open."""
        return self.filled(self.preset(windows.skeleton))

    def check(self) -> None:
        """Refuses options that do not fit together, before any data are read.

        Raises:
            ValueError: saying which.
        """
        self.build({"x": 1})

    def build_for(self, windows: Windows) -> nn.Module:
        """The model for these windows; `build`, where it needs to know no more than their size."""
        return self.build({"x": windows.size})

    def prepare(self, model: nn.Module, windows: Windows) -> None:
        """What a model takes from the training windows before it is fitted; its weights keep it.

        Raises:
            ValueError: the pseudo-sequences of a prior are longer than the windows.
        """
        for prior in getattr(model, "priors", {}).values():
            if isinstance(prior, VampPrior):
                prior.start_at(windows.sample(prior.components, torch.default_generator))

    def batches(self, windows: Windows) -> Source:
        """Where training draws its batches from: the windows, and what the objective needs beside them."""
        return windows

    def validation(self, windows: Windows) -> Windows:
        """What the weights are judged by: the windows, with what the model needs beside them."""
        return windows

    def objective(self) -> Objective:
        """What training minimises."""
        weight = SHAPES[self.warm_up_shape](0.0, 1.0, steps=self.warm_up) if self.warm_up else 1.0
        return Evidence(kl_weight=weight, free_bits=self.free_bits)

    def stages(self, steps: int) -> Sequence[Stage]:
        """The stages of a run of `steps`; one, if the method does not train in phases."""
        return [Stage(steps, self.objective())]

    def feeding(self, steps: int) -> Schedule | float:
        """Probability of self-feeding over a run of `steps`; 0 for a model that reads no data, where nothing is fed."""
        p, q = self.equations()
        reads = {parent.name for factor in p.factors for parent in factor.parents}
        if not self.self_feeding or not reads & (set(p.variables) - set(q.variables)):
            return 0.0
        return Linear(0.0, self.self_feeding, steps=max(steps // 3, 1), delay=steps // 10)

    def config(self) -> dict[str, Any]:
        """The method in JSON's types; `from_config` reads it."""
        return {"method": self.name, **asdict(self)}


@cache
def methods() -> dict[str, type[Method]]:
    """Every known method by name: those of this package and of installed packages (entry points "dvae.methods")."""
    from . import (
        action_classifier,
        cvae_rnn,
        dkf,
        dsae,
        equations,
        gsps,
        hit_dvae,
        kvae,
        pose_prior,
        rvae,
        srnn,
        storn,
        trajevae,
        vae,
        vrnn,
    )

    own: list[type[Method]] = [
        vae.VAE,
        dkf.DKF,
        storn.STORN,
        vrnn.VRNN,
        srnn.SRNN,
        rvae.CausalRVAE,
        rvae.NonCausalRVAE,
        dsae.DSAE,
        kvae.KVAE,
        hit_dvae.HiTDVAE,
        gsps.GSPS,
        trajevae.TrajeVAE,
        cvae_rnn.CVAERNN,
        pose_prior.PosePrior,
        action_classifier.ActionClassifier,
        equations.Equations,
    ]
    table = {method.name: method for method in own}
    for entry in entry_points(group="dvae.methods"):
        if entry.name in table:
            raise ValueError(f"the entry point {entry.value} has the name of a method that exists: {entry.name}")
        table[entry.name] = entry.load()
    return table


def method(name: str, **options: Any) -> Method:
    """A method by its name, with options in place of its defaults.

    Raises:
        ValueError: an unknown name or option, with the nearest known one.
    """
    table = methods()
    if name not in table:
        raise ValueError(f"unknown method {name!r}{nearest(name, table)}; known: {', '.join(table)}")
    known = {field.name for field in fields(table[name])}
    for option in options:
        if option not in known:
            raise ValueError(
                f"{name} has no option {option!r}{nearest(option, known)}; it has {', '.join(sorted(known))}"
            )
    return table[name](**options)


def from_config(config: Mapping[str, Any]) -> Method:
    """The method that `Method.config` wrote."""
    options = {key: tuple(v) if isinstance(v, list) else v for key, v in config.items() if key != "method"}
    if "method" not in config:
        raise ValueError(f"the configuration names no method: it holds {', '.join(config) or 'nothing'}")
    return method(config["method"], **options)
