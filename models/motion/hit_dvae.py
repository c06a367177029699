"""HiT-DVAE, the hierarchical transformer dynamical VAE: a static latent per sequence and a local latent per step.

    p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)        q(w | x_{1:T}) q(z_t | x_{1:T}, w)

Graph convolutions over the joints turn poses into features, with separate weights for guide and model. For w, graph
convolutions over the frames summarise a short window. For z, the guide uses the encoder of a transformer. The two
generative factors attend to the past: z from x_{t-1} to z_{<t}, x from z_t to x_{<t}. The guide ignores z_{<t},
although the exact posterior depends on it (`guide_past` adds it).

The paper does not maximise the evidence. For each window it draws K motions from the guide and takes the best:

    L = lr min_k |x_k - x|^2 + lmm (the same to pseudo ground truths) + lz KL_z + lw KL_w + energies

KL_w is a sum, and the energies of GSPS (diversity, limbs, angles, pose prior) cover all frames. Early in training, the
model begins to read only its own output. The paper prints its squared errors as sums. We read them as means over time,
because its weights then agree with the weights of GSPS; the meaning of the weights depends on this choice. Both
objectives are available: loss="best-of-many" and loss="evidence".

K is the number of motions in the loss (sections 3.2.1 and 3.2.2, equations 11 and 15). Section 4.2 says "We generate
K = 50 samples for each observation", between the sizes of the networks and the training. With the same symbol, this is
the K of training. The sentence can also be read as the number of futures in the evaluation, which is the K of APD
(section 4.1.2) and 50 in GSPS; then the paper does not state the K of training. `published` takes the first reading. A
step with K = 50 takes 6.0 times the time and 4.9 times the memory of K = 10 (one core, 16 windows, true frames,
`python -m benchmarks.bench hit_dvae`).

Bie et al., 2022, arXiv 2204.01565. There is no public code. `published` is the model of the paper; ours differs because
some of its choices did not work in short runs on small data sets:

    option         published                          ours
    samples        50                                 10; 6 on skeletons other than the paper's
    residual       0                                  .5: the mean of x_t keeps half of x_{t-1}
    nearest        False: frames are keys only        True: the last frame also joins the query
    standardise    False: metres                      True
    start_token    False: x_1 is given                True: x_1 and z_1 are part of the model
    positions      sinusoids                          biases of distances
    emission       unit: the identity as covariance   fixed: one scale per coordinate, fitted to the errors
    feed_observed  True: all frames may be fed        False: observed frames stay true

On skeletons other than the paper's, `published` has the values of HumanEva-I, and ours has smaller networks, rotated
windows, KL weights of .03 for z and w, and 2,400 steps.

* Without a residual, the error of the first predicted frame doubles; with all of x_{t-1}, motions diverge. In metres,
  training takes several times as long to learn the features that all poses share. Biases of distances allow motions
  longer than in training. A forecast does not replace the observed frames either.
* With best-of-many, the scale of x is only fitted to the errors: its gradient does not reach the poses.
* With the paper's weight of .5, z collapses in short runs and motions lose their rhythm. With 7.5 (.1 T), w carries no
  information (docs/results/hit_dvae.md).

The paper does not determine the rest, which is our choice in both: one layer per factor, normalised before attention,
with GELU; positions (it cites the transformer, which has sinusoids); fed frames drawn one by one, without a gradient
(`feeding_gradient`; `feeding_passes` computes the means in parallel); one draw of w per motion. Our graph convolutions
have no batch normalisation, because features would depend on other sequences of the batch; the frames' have layer
normalisation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from typing_extensions import override

from ...constants import indices
from ...data.batch import WHOLE, Batch
from ...data.schema import Schema
from ...distributions import Directions, DistributionSpec
from ...factorization.notation import Factorization
from ...inference.bounds.elbo import Terms
from ...inference.training.objectives import Evidence, Objective
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...inference.training.schedules import Ramp, Schedule
from ...motion import Skeleton
from ...motion.data.protocols import Poses
from ...motion.geometry.parts import body_parts
from ...motion.scoring import energies
from ...networks import Attention, FrameGraph, NetworkSpec, NodeGraph, Recurrent, SelfAttention
from ...networks.extract import share
from ...options import Amount, Delay, Extra, Layers, Range, Share, Size
from ...program.model import DynamicalVAE
from ...program.rollout import Rollout, ScheduledSampling
from ..method import SHAPES, LatentMethod, fit_units, start_priors
from .energies import EnergyMethod, EnergyModel
from .poses import table

ENERGIES = table(
    "reconstruction multimodal diversity diversity_scale limb angles pose_prior kl_local kl_static pseudo_minimum",
    {
        "humaneva": (10.0, 5.0, (0.1, 0.2), (15.0, 50.0), 100.0, 1.0, 0.001, 0.5, 7.5, 0.01),
        "human36m": (20.0, 10.0, (0.1, 0.2), (100.0, 300.0), 100.0, 1.0, 0.01, 0.5, 12.5, 0.1),
        "": (10.0, 5.0, (0.1, 0.2), (15.0, 50.0), 100.0, 1.0, 0.001, 0.03, 0.03, 0.02),
    },
)
NETWORKS = table(
    "pose_width samples decoder pool_stride heading",
    {"humaneva": (8, 10, 256, 15, False), "human36m": (8, 10, 256, 20, False), "": (8, 6, 128, 10, True)},
)
OURS: dict[str, Any] = {
    "residual": 0.5,
    "nearest": True,
    "standardise": True,
    "start_token": True,
    "positions": "biases",
    "feed_observed": False,
}
PRESETS = {skeleton: options | NETWORKS[skeleton] | OURS for skeleton, options in ENERGIES.items()}
"""Options by skeleton, with the paper's weights; other skeletons: for 15 observed + 60 predicted frames, 30 Hz."""

PAPER: dict[str, Any] = {
    "residual": 0.0,
    "nearest": False,
    "standardise": False,
    "start_token": False,
    "positions": "sinusoids",
    "feed_observed": True,
    "emission": "unit",
}
PUBLISHED = {skeleton: PRESETS[skeleton] | PAPER | {"samples": 50} for skeleton in ("human36m", "humaneva")}
"""The published model by skeleton (`HiTDVAE.published`); other skeletons have the values of HumanEva-I."""
KL_STATIC = 0.1
"""The paper's weight of the KL of w, relative to means over T frames."""

PARTS = ("lower", "upper")
FRAMES = 15
"""Number of observed frames if no windows define it."""


@dataclass(frozen=True)
class HiTDVAE(EnergyMethod, LatentMethod):
    """A hierarchical transformer dynamical VAE. With loss="evidence" the energies do not apply.

    Args:
        emission: distribution of x. loss="best-of-many" does not support "normal" and "student". With `bones`, x is a
            point mass.
        loss: "best-of-many" (the paper's) or "evidence" (the plain bound).
        samples: K, number of motions drawn for each window in training; 1 with loss="evidence".
        kl_local: weight of the KL of z.
        kl_static: weight of the KL of w, in the unit of the bound; the paper's .1, which multiplies means over T
            frames, is .1 T.
        static: size of w; 0 for a model without w.
        attention: whether to use transformers; otherwise LSTMs, for which `heads_count` and `nearest` have no effect.
        width: width of the attention of guide and prior.
        heads_count: number of attention heads.
        decoder: width of the attention of x.
        layers: number of layers of each factor.
        nearest: whether the last frame that a generative factor may read joins its query; in the paper it is one of
            the keys.
        standardise: whether networks read and predict standardised poses, by the mean pose and one scale
            (`dvae.data.units`).
        start_token: whether all steps may attend to a learned token and x_1 is part of the loss. Otherwise, as in the
            paper, motions begin with the given x_1, and the loss of best-of-many begins at x_2 and z_2.
        positions: "biases" of distances, for motions longer than in training, or the transformer's "sinusoids".
        published: whether unset options and the training have the paper's values (`PUBLISHED`) instead of ours.
        pose_width: features of a joint, by graph convolutions; 0 for raw poses. By default 8 for windows of poses and
            0 for a model built from sizes alone.
        summary: network of w: "graph" (a graph of `frames` frames) or "attention" (over any length, ignoring the order:
            all frames of a window in training, and its past in a forecast).
        frames: length of the graph's window, by default the observed frames of the protocol. In training the window is
            the same for all draws; otherwise it is the first frames.
        guide_past: whether the guide of z also reads z_{<t}.
        feed_observed: whether scheduled sampling may also replace observed frames, so that motions depend only on their
            latents. The paper's proportion of generated frames rises to 100 % (section 3.3), without an exception.
        feeding_passes: number of parallel passes that approximate the means that are fed back; 0 for exact means, step
            by step.
        feeding_gradient: whether gradients flow through these means.
        warm_up: steps over which the KL weights rise from 0; by default the first 4 % of the run, the paper's 20 epochs
            of 500.
        scheduled_sampling: final probability that a frame of x's history is the model's own mean. It rises from 0 over
            16 % of training, after the first 4 %: the paper's 80 and 20 of 500 epochs.
    """

    name = "hit-dvae"
    source = "Bie et al., 2022, arXiv 2204.01565"
    generative = "p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)"
    inference = "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"
    presets = PRESETS
    trainings: ClassVar[Mapping[str, Training]] = {
        "human36m": Training(15_625, 32, 1e-3),
        "humaneva": Training(7813, 64, 1e-3),
        "": Training(2400, 16, 2e-3, 0.8),
    }
    residual: Share | None = None  # type: ignore[assignment]
    scheduled_sampling: Share = 1.0
    warm_up: Delay | None = None
    loss: Literal["best-of-many", "evidence"] = "best-of-many"
    samples: Annotated[int, Range(2, 4096)] | None = None
    kl_local: Amount | None = None
    kl_static: Amount | None = None
    static: Extra = 32
    attention: bool = True
    width: Size = 64
    heads_count: Size = 4
    decoder: Size | None = None
    layers: Layers = 1
    nearest: bool | None = None
    standardise: bool | None = None
    start_token: bool | None = None
    positions: Literal["biases", "sinusoids"] | None = None
    published: bool = False
    pose_width: Extra | None = None
    summary: Literal["graph", "attention"] = "graph"
    frames: Size | None = None
    guide_past: bool = False
    feed_observed: bool | None = None
    feeding_passes: Extra = 0
    feeding_gradient: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.loss == "best-of-many" and self.emission not in (None, "fixed", "unit"):
            raise ValueError(
                f"emission={self.emission!r} needs loss='evidence'; with best-of-many it is 'fixed' or 'unit'"
            )
        if self.hide:
            raise ValueError(
                f"hide is {self.hide}, but the guide of hit-dvae reads whole poses without indicators; leave hide at 0"
            )
        energy_options = (*EnergyMethod.weights, "kl_local", "kl_static", "samples", "pose_prior_run", "bones")
        if self.loss == "evidence" and (unsupported := [name for name in energy_options if getattr(self, name)]):
            raise ValueError(
                f"loss='evidence' does not use {', '.join(unsupported)}; leave them out, or use loss='best-of-many'"
            )
        for name in ("diversity", "diversity_scale"):
            values = getattr(self, name)
            if values is not None and len(values) != len(PARTS):
                raise ValueError(f"{name} is {values}; expected one number for each of {', '.join(PARTS)}")

    @override
    def equations(self) -> tuple[Factorization, Factorization]:
        """Return the generative model and the guide."""
        p, q = self.generative, self.inference
        if self.guide_past:
            q = q.replace("q(z_t | ", "q(z_t | z_{<t}, ")
        if not self.static:
            p, q = (text.replace(", w)", ")") for text in (p.replace("p(w) ", ""), q.replace("q(w | x_{1:T}) ", "")))
        return Factorization.parse(p), Factorization.parse(q)

    @override
    def sizes(self) -> dict[str, int]:
        """Return the sizes of w and z."""
        return {**({"w": self.static} if self.static else {}), **super().sizes()}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return the paper's networks, or LSTMs; `build` shares the features of poses."""
        poses = {"x": NodeGraph(self.pose_width, coordinates=3)} if self.pose_width else {}
        decoder = self.decoder or PRESETS[""]["decoder"]
        shape: dict[str, Any] = {"heads": self.heads_count, "layers": self.layers, "extract": poses}
        chosen = self.with_presets(self.unset)
        order: dict[str, Any] = {"nearest": chosen.nearest, "positions": chosen.positions, "start": chosen.start_token}
        networks: dict[str, NetworkSpec] = {}
        if self.attention:
            networks["p(z)"] = Attention(self.width, **order, **shape)
            networks["p(x)"] = Attention(decoder, **order, **shape)
            networks["q(z)"] = SelfAttention(self.width, **order, **shape)
        else:
            networks["p(z)"] = networks["q(z)"] = Recurrent(self.width, layers=self.layers, extract=poses)
            networks["p(x)"] = Recurrent(decoder, layers=self.layers, hidden=(decoder,), extract=poses)
        if self.static:
            pooled = Attention(self.width, **shape)
            graph = FrameGraph(self.frames or FRAMES, extract=poses)
            networks["q(w)"] = graph if self.summary == "graph" else pooled
        return networks

    @override
    def distributions(self) -> dict[str, DistributionSpec]:
        """Return the distributions of x and, unless `prior` is "standard", of w."""
        return dict(super(HiTDVAE, self.with_presets(self.unset)).distributions())

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model; without a skeleton it has no energies, and x are numbers, not poses (`pose_width`).

        Raises:
            ValueError: if the poses have a root and the method uses energies or headings.
        """
        schema = Schema.of(data)
        method, observed = self.with_presets(self.unset), self.frames or FRAMES
        if self.bones or isinstance(schema, Poses):
            schema = Poses.of(schema, self.name)
            method, observed = self.resolve_defaults(schema), schema.protocol.observed
        model_arguments = method.model_arguments(schema.sizes)
        if isinstance(schema, Poses) and (method.loss == "best-of-many" or method.heading):
            self.poses(schema)
            if method.loss == "best-of-many":
                distribution = model_arguments["distributions"]["p(x)"]
                distribution = replace(distribution, fitted="scale", error_weight=not distribution.learned)
                model_arguments["distributions"]["p(x)"] = (
                    Directions(residual=method.residual or 0.0) if method.bones else distribution
                )
            model: DynamicalVAE = HiTModel(method, schema.skeleton, observed, **model_arguments)
        else:
            model = method.build_for_data(schema, extended=True)
        if method.pose_width:
            for side in (model.generator, model.encoder):
                share("x", *(conditional.network for conditional in side.values() if conditional.network is not None))
        if method.standardise and not schema.units:
            model.standardise(WHOLE)
        protected = observed if not method.feed_observed else 0 if method.start_token else 1
        model.feeding = ScheduledSampling(0.0, self.feeding_passes or None, self.feeding_gradient, protected)
        return model

    @property
    def unset(self) -> Mapping[str, Any]:
        """Values of options that are None and do not depend on the skeleton."""
        return PAPER if self.published else OURS

    @override
    def preset(self, skeleton: Skeleton) -> Mapping[str, Any]:
        """Return the values of options that are None, for poses of this skeleton."""
        published = PUBLISHED.get(skeleton.name, PUBLISHED["humaneva"])
        return published if self.published else super().preset(skeleton)

    @override
    def training(self, data: Any) -> Training:
        """Return the default training options for these data."""
        return self.trainings.get(Schema.of(data).preset, self.trainings["humaneva" if self.published else ""])

    @override
    def resolve_defaults(self, data: Any) -> HiTDVAE:
        """Return the method with unset options chosen for the skeleton.

        With loss="evidence" windows are rotated only on request, because their bounds are not comparable with the
        bounds of other models.
        """
        schema = Poses.of(data, self.name)
        method = replace(self, frames=self.frames or schema.protocol.observed)
        if self.loss == "evidence":
            preset = self.preset(schema.skeleton)
            shapes = {name: preset[name] for name in ("decoder", "pose_width")}
            return replace(method, heading=bool(self.heading)).with_presets({**self.unset, **shapes})
        if self.published or schema.preset in PUBLISHED:
            method = method.with_presets({"kl_static": KL_STATIC * schema.frames})
        return super(HiTDVAE, method).resolve_defaults(schema)

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return one stage of the paper's objective, or of the evidence, with warm-up and scheduled sampling."""
        method = self.resolve_defaults(train) if self.loss == "best-of-many" else self.with_presets(self.unset)
        if self.warm_up is None:
            method = replace(method, warm_up=round(0.04 * steps))
        stages = [Stage(steps, method.objective())]
        return Recipe(
            method.scored(train), validation, stages, self._feeding(steps), partial(method.start, windows=train)
        )

    @override
    def _feeding(self, steps: int) -> Schedule | float:
        """Return the probability of scheduled sampling, which rises over the paper's shares of the run."""
        if not self.scheduled_sampling:
            return 0.0
        return Ramp(0.0, self.scheduled_sampling, steps=max(round(0.16 * steps), 1), delay=round(0.04 * steps))

    @override
    def start(self, model: Any, windows: Any) -> None:
        """Compute mean and scale of the poses for standardisation, and start a learned scale of x at that scale."""
        start_priors(model, windows)
        if isinstance(model, EnergyModel):
            super().start(model, windows)
        if self.standardise and not model.units[WHOLE].scale.dim():  # units of columns are known
            fit_units(model, windows)
            if self.emission in (None, "fixed") and not self.bones:
                nn.init.zeros_(model.generator[WHOLE].head.log_scale)

    @override
    def objective(self) -> Objective:
        """Return the paper's weighted energies, or the evidence.

        Raises:
            ValueError: if weights that depend on the skeleton are unset.
        """
        if self.loss == "evidence":
            return super().objective()
        if self.diversity is None or self.kl_local is None or self.kl_static is None or self.samples is None:
            raise ValueError(
                "the weights of the loss depend on the skeleton; call method.resolve_defaults(windows) first, or use "
                "loss='evidence' for data that are not poses"
            )
        weights = {"z": self.kl_local, **({"w": self.kl_static} if self.static else {})}
        ramp = SHAPES[self.warm_up_shape]
        diversity = {f"diversity_{part}": weight for part, weight in zip(PARTS, self.diversity, strict=True)}
        energy_weights = {name: getattr(self, name) for name in EnergyMethod.weights if name != "diversity"} | diversity
        return (Evidence if self.with_presets(self.unset).start_token else LaterEvidence)(
            kl_weight={n: ramp(0.0, w, steps=self.warm_up) if self.warm_up else w for n, w in weights.items()},
            free_bits=self.free_bits,
            energy_weights={name: weight for name, weight in energy_weights.items() if weight},
            likelihood_weight=1e-3,  # for the scale alone: Adam's steps do not depend on the weight
            draws={"w" if self.static else "z": self.samples},
            select="loss",
        )


class LaterEvidence(Evidence):
    """`Evidence` without the terms of the first step, which is given; still divided by all T steps, as the paper's."""

    @override
    def loss(self, terms: Terms, weights: Mapping[str, Any]) -> Tensor:
        later = {name: values[:, 1:].sum(-1) for name, values in terms.steps.items()}
        likelihood, kl = (
            {name: later.get(name, value) for name, value in table.items()}
            for table in (terms.log_likelihood, terms.kl)
        )
        return super().loss(replace(terms, log_likelihood=likelihood, kl=kl), weights)

    @override
    def to_config(self) -> dict[str, Any]:
        return {**super().to_config(), "objective": type(self).__name__}


class HiTModel(EnergyModel):
    """The model of HiT-DVAE for the poses of a skeleton.

    With several draws of a latent, the program scores the resulting motions, which are the means of x. The energies
    are sums over a sequence, T times the paper's means, so that `Evidence` weighs them as the paper does.
    """

    def __init__(self, method: HiTDVAE, skeleton: Skeleton, observed: int, **options: Any):
        super().__init__(method, skeleton, observed, **options)
        try:
            joints = body_parts(skeleton, PARTS) if any(method.diversity or ()) else {}
        except ValueError as error:
            raise ValueError(f"the diversity of parts needs {' and '.join(PARTS)}; use diversity=(0, 0)") from error
        self.coordinates = {
            part: [3 * j + axis for j in members for axis in range(3)] for part, members in joints.items()
        }

    @override
    def penalties(self, rollout: Rollout, data: Batch, draws: Mapping[str, int]) -> dict[str, Tensor]:
        if not draws or WHOLE not in rollout.values:
            return {}
        if rollout.lengths is not None:
            raise ValueError(
                "the energies need whole windows; leave 'lengths' out of the batch, or fit with loss='evidence'"
            )
        size = rollout.batch // rollout.draws
        x = rollout.values[WHOLE]
        predicted, seen = rollout.parameters(WHOLE, x)[0].unflatten(0, (-1, size)), self.seen(x[:size], data)
        if not self.method.start_token:  # motions begin with the given frame
            first = torch.where(seen[:, :1].isfinite(), seen[:, :1], predicted[:, :, :1])
            predicted = torch.cat([first, predicted[:, :, 1:]], 2)
        truth, motions = (self.positions({WHOLE: values}, data)[WHOLE] for values in (seen, predicted))
        means = self.realism(motions, truth, motions)
        method = self.method
        for part, weight, scale in zip(PARTS, method.diversity, method.diversity_scale, strict=True):
            if weight:
                part_motion = motions.index_select(-1, indices(self.coordinates[part], motions))
                means[f"diversity_{part}"] = energies.pairwise_diversity(part_motion, scale)
        return self.best(motions, truth, data) | {n: rollout.length * e for n, e in means.items()}
