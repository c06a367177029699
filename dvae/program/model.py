"""DynamicalVAE: two factorizations and their networks as a Pyro model and guide.

There is one sample site per variable, whatever the number of steps: `w` with event (D,), `z` and `x` with event (T, D),
inside the plate "sequences". Everything else (free running, forecasts, reconstruction, scoring) is this one program
with different things known.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from itertools import accumulate
from operator import mul
from typing import Annotated, Any, ClassVar

import pyro
import pyro.distributions as dist
import torch
from pyro import poutine
from torch import Tensor, nn

from ..data.batch import Batch
from ..data.units import Coordinate, Units, exceeds_float32
from ..data.views import View
from ..distributions.base import LawSpec
from ..distributions.families import Normal, StandardNormal
from ..distributions.family import FAMILIES
from ..distributions.subset import Subset
from ..factorization.inversion import guide
from ..factorization.notation import Factor, Factorization, check_pair
from ..factorization.relations import MaskFunction
from ..networks import NetworkSpec, Recurrent
from ..networks.loop import once
from ..options import Range, kind_of, problem
from ..turns import alone
from .batch import CHUNK, AnyBatch, Reader
from .conditional import Conditional, evaluating, like
from .forecast import forecast, impute, reconstruct, states
from .rollout import InputNoise, Rollout, SelfFeeding
from .summed import Discrete, Sums

_COUNT = itertools.count()
SHARED: Any = {"shared": True}
"""What the site of a variable says that all sequences share."""


class DynamicalVAE(nn.Module):
    """A generative model and a guide from their equations.

    Args:
        generative: such as "p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)", as text or a `Factorization`.
        inference: such as "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, w)"; "" where nothing is latent. "faithful" for the
            smallest guide that misses nothing of what the posterior depends on (`faithful`). None for no inference
            network: the guide is the prior, so that every KL term is exactly zero.
        sizes: dimension of every variable, context included; `Discrete` of a latent that is categorical and summed out.
        network: description of the networks, or a mapping from factors to descriptions. Its keys are "p(x)" for one
            factor, "p" for all generative ones, "q" for the guide's, and "default".
        laws: the same for the laws; `distributions.Normal()` where nothing is said. A generative factor without parents
            is N(0, I) unless "p(w)" itself is a key, such as of `distributions.Mixture()`.
        observed: names of the data variables; every other variable with a generative factor is a latent.
        masks: relations of one's own, name to function of T (see `Factorization.parse`).
        view: what the model sees of the data, such as their parts; as it is where nothing is said (see
        `dvae.data.views`). shared: static context that the programs draw themselves, once for all sequences of a batch,
            where it does not hold it: name to law. A forecast draws it once for each sample.
        grouped: static latents that the sequences of a group share, of which a batch says "group" (B,); see
            `dvae.program.groups`. Without that every sequence is a group.
        indicators: data variables of which the guide reads which entries were observed, beside their values: each
            coordinate has one of 0 and 1, all 1 without a mask (Collier et al., 2020, arXiv 2006.05301). Without
            them the guide cannot tell a missing entry from one that was observed at 0, or at the mean of a variable
            with units.

    Raises:
        TypeError: a size that is no whole number, or a class in place of a view.
        ValueError: equations that cannot be read or do not fit together; sizes missing, unknown or out of range; a
            class in place of a network or law.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})", {"z": 2, "x": 3})
        >>> model.sample(5, length=10)["x"].shape
        torch.Size([5, 10, 3])
    """

    extras: ClassVar[tuple[str, ...]] = ()
    """What a batch may hold that is no variable, for `penalties`."""
    forks: ClassVar[bool] = True
    """Whether `draws` are continuations of a row; a program may mean something else by them."""
    per: str = "frame"
    """What there is one log-likelihood of."""

    @alone
    @torch.inference_mode(False)  # so that the parameters can be trained, wherever the model is built
    def __init__(
        self,
        generative: str | Factorization,
        inference: str | Factorization | None,
        sizes: Mapping[str, int],
        network: NetworkSpec | Mapping[str, NetworkSpec] | None = None,
        laws: LawSpec | Mapping[str, LawSpec] | None = None,
        observed: tuple[str, ...] = ("x",),
        masks: Mapping[str, MaskFunction] | None = None,
        *,
        view: View | None = None,
        shared: Mapping[str, Subset] | None = None,
        grouped: Collection[str] = (),
        indicators: Collection[str] = (),
    ):
        super().__init__()
        self._name = f"dvae{next(_COUNT)}"  # each model its own: Pyro's store is global
        self.generative = Factorization.parse(generative, masks)
        self.feeding: SelfFeeding | InputNoise = SelfFeeding(0.0)
        if not isinstance(view, View | None):
            raise TypeError(f"the view is {kind_of(view)}; expected an instance such as dvae.data.views.View()")
        self.view = view or View()
        observed = tuple(self.view.parts or observed)
        self.sizes = _checked_sizes(sizes)
        self.summed = tuple(n for n, size in self.sizes.items() if isinstance(size, Discrete) and n not in observed)
        self.inference = guide(self.generative, inference, observed, masks, self.summed)
        self.latents, self.observed, self.context = check_pair(
            self.generative, self.inference, observed, sizes, self.summed
        )
        self.sums = Sums(self.generative, {name: self.sizes[name] for name in self.summed}) if self.summed else None
        for name in self.sizes:
            if hasattr(nn.ModuleDict, name):
                raise ValueError(f"a variable cannot be named {name!r}, which is an attribute of torch's modules")
        self.networks = _by_factor(network, Recurrent(), "network")
        self.laws = _by_factor(laws, Normal(), "law")
        keys = {f"{f.kind}({f.child})" for f in (*self.generative.factors, *self.inference.factors)}
        for key in {*self.networks, *self.laws} - keys - {"p", "q", "default"}:
            raise ValueError(f"no factor {key!r}; keys are {', '.join(sorted(keys))}, 'p', 'q' and 'default'")
        self.view.check(self.sizes, self.context, self.generative)
        self.shared = dict(shared or {})
        for name in self.shared:
            if name not in self.context or self.generative.local(name) or self.inference.local(name):
                raise ValueError(
                    f"{name} is to be drawn once for all sequences, so that it is static context: a parent without a "
                    f"factor of its own, such as in p(x_t | {name}); context is {', '.join(self.context) or 'nothing'}"
                )
        self.grouped = tuple(grouped)
        self._check_grouped()
        self.indicators = tuple(indicators)
        if unknown := [name for name in self.indicators if name not in observed]:
            raise ValueError(
                f"indicators tell which data were observed, but {', '.join(unknown)} is none of {', '.join(observed)}"
            )
        roots, rest = ([f for f in self.generative.factors if bool(f.parents) == more] for more in (False, True))
        self.generator: Any = self._conditionals(rest)
        guides = {} if inference is None else self._conditionals(self.inference.factors)
        self.generator.update(self._conditionals(roots, guides))  # last: priors may be made of the guide
        if inference is None:  # the very modules of the prior, which are not to be registered twice
            object.__setattr__(self, "encoder", {name: self.generator[name] for name in self.latents})
        else:
            self.encoder: Any = guides
        self._check_latents()
        if masses := [name for name in self.observed if self.generator[name].discrete and not self.view.keeps_volume]:
            raise ValueError(f"{self.view} changes volume, but {', '.join(masses)} is discrete and has none to change")
        self.reader = Reader(
            self.sizes,
            {**_locality(self.inference), **_locality(self.generative)},
            self.observed,
            self.context,
            self.view,
            self.extras,
            frozenset(name for name in self.view.parts or () if self.generator[name].law.deterministic),
            {name: self.generator[name] for name in self.observed},
            self.likelihood,
            self.grouped,
        )
        self.units: Any = nn.ModuleDict()

    def _conditionals(self, factors: Iterable[Factor], guides: Mapping[str, Conditional] | None = None) -> Any:
        def pick(table: Mapping[str, Any], factor: Factor) -> Any:
            own = f"{factor.kind}({factor.child})"
            if table is self.laws and isinstance(self.sizes[factor.child], Discrete):
                return table.get(own, FAMILIES["category"])
            if table is self.laws and factor.kind == "p" and not factor.parents:
                return table.get(own, StandardNormal())
            return table.get(own, table.get(factor.kind, table["default"]))

        return nn.ModuleDict(
            {
                factor.child: Conditional(
                    factor,
                    self.sizes,
                    pick(self.networks, factor),
                    pick(self.laws, factor),
                    generative=factor.kind == "p",
                    data=self.observed,
                    guide=guides[factor.child] if guides and factor.child in guides else None,
                    indicators=self.indicators if factor.kind == "q" else (),
                )
                for factor in factors
            }
        )

    def _check_grouped(self) -> None:
        for name in self.grouped:
            if name not in self.latents or self.generative.local(name):
                raise ValueError(f"groups share static latents, and {name!r} is none of {self.generative.text!r}")
            others = [p.name for p in self.generative.factor(name).parents if p.name not in self.grouped]
            if others:
                raise ValueError(
                    f"{self.generative.factor(name)} reads {', '.join(others)}, which sequences of a group have each "
                    "their own; what a group shares is made of what groups share"
                )

    def _check_latents(self) -> None:
        for name in self.latents:
            for conditional in (self.generator[name], self.encoder[name]):
                if conditional.discrete or (conditional is self.encoder[name] and not conditional.reparameterised):
                    what = "are discrete" if conditional.discrete else "are not reparameterised"
                    raise ValueError(
                        f"the draws of the latent {name} {what} by the law of {conditional.factor}, so that no "
                        f"gradient would reach the guide through them; give it a continuous law such as "
                        f"distributions.Normal(), name {name} as observed where it is data, or have a categorical one "
                        f"summed out: sizes={{{name!r}: dvae.Discrete(states)}}"
                    )
        for name in self.summed:
            if (law := self.generator[name].law.called) != "OneHotCategorical":
                raise ValueError(
                    f"{name} is summed out over its {self.sizes[name]} states, but the law of "
                    f"{self.generator[name].factor} is {law}; leave it to be that of categories"
                )

    @torch.inference_mode(False)
    def standardise(self, name: str, coordinates: Sequence[Coordinate] = ()) -> Units:
        """Has networks read a variable without unit, by a mean and a scale that `fit` of the result takes.

        They make it without unit too where its law is a location and a scale (`Law.location_scale`); probabilities
        and rates are made as they are. Densities and values stay in the variable's own unit; call it before the model
        is fitted.

        Args:
            name: of the variable.
            coordinates: how each is read and made, as of columns of a table, in place of what is fitted.

        Raises:
            ValueError: an unknown variable.
        """
        if name not in self.sizes:
            raise ValueError(f"no variable {name!r}; there are {', '.join(self.sizes)}")
        units = Units(self.sizes[name], coordinates, exact=name not in self.latents)
        self.units[name] = units.to(like(self))
        for conditional in (*self.generator.values(), *self.encoder.values()):
            conditional.units[name] = self.units[name]
        return self.units[name]

    @property
    def wide(self) -> frozenset[str]:
        """Names of the variables whose values are in float64 whatever the precision of the model."""
        read = (name for name, units in self.units.items() if units.wide)
        return frozenset(n for n in read if n not in self.observed or self.generator[n].offset is not None)

    @property
    def likelihood(self) -> bool:
        """Whether the data have a density given the latents; without one there is no bound (`distributions.Delta`)."""
        return not any(self.generator[name].law.deterministic for name in self.observed)

    @property
    def gradual(self) -> bool:
        """Whether a curriculum changes what its programs do: draws of what sequences share."""
        return bool(self.shared)

    def is_drawn(self, means: bool = False) -> bool:
        """Whether forecasts draw the data unless `draw_emission` is given.

        They do, unless the emission's scale is the weight of a squared error (`Law.error_weight`).

        Args:
            means: means are preferred, as by scores that are published for means. Data are drawn nevertheless where
                they are discrete and a mean is no value, and where nothing is latent and all samples would be the same
                mean.
        """
        laws = [self.generator[name] for name in self.observed]
        if means and (self.latents or self.summed) and not any(each.discrete for each in laws):
            return False
        return not any(each.law.error_weight for each in laws)

    def rollout(
        self, batch: AnyBatch | None, length: int | None = None, size: int = 1, *, guide: bool = False
    ) -> Rollout:
        """Return a run over a batch in which nothing has been drawn yet; it draws on demand.

        `model` and `guide` turn such a run into sample sites. Use it to evaluate conditional distributions step by
        step, as the oracle and the particle filter do.

        Args:
            batch: see `model`; None for a free run.
            length: T, if it differs from that of the data.
            size: B, if there is no batch.
            guide: run the guide instead of the model.

        Raises:
            ValueError: a batch that cannot be read.
        """
        if guide:
            return self.reader.rollout(self.inference, self.encoder, self.read(batch), length, size)
        found = self.reader.rollout(self.generative, self.generator, self.read(batch), length, size)
        found.sums = self.sums
        return found

    # The Pyro program ----------------------------------------------------------------------------------------------

    def model(
        self,
        batch: AnyBatch | None = None,
        *,
        length: int | None = None,
        size: int = 1,
        prefix: Mapping[str, Tensor] | None = None,
        mean_emission: bool | Collection[str] = False,
        self_feeding: SelfFeeding | InputNoise | float | None = None,
        draws: Mapping[str, int] | None = None,
        curriculum: float = 1.0,
    ) -> dict[str, Tensor]:
        """The generative program p. Teacher-forced where the data are given, free where they are not.

        Args:
            batch: the data (B, T, D), or a mapping from variable names to tensors (context too), with optional
                "lengths" (B,) of a ragged batch and "mask", True where an entry of the data was observed: (B, T, D),
                or a mapping of these by name. At a missing entry the model reads its own mean, the guide 0, or the
                mean of a variable with units. Arrays are taken as tensors, in the model's precision.
            length: T. Beyond the length of the data, the data are a prefix from which the program continues.
            size: B, where the batch does not tell.
            prefix: name to the first values (B, O, D) of a latent, or the value (B, C) of a static one that is summed
                out.
            mean_emission: a free run sets the data variables, or those named, to their means and does not draw them.
            self_feeding: what stands in for the data's history: a `SelfFeeding` (scheduled sampling), an `InputNoise`,
                or a number, the probability or the share of the noise, in the way of the model's attribute `feeding`.
            draws: latent to a number n: from there on the program goes on n times for each sequence, with a draw
                of this variable each. Later variables have n times as many rows, draw by draw.
            curriculum: how far the draws of what sequences share have come, see `distributions.Subset`.

        Returns:
            Name to value of every variable.
        """
        self._register()
        self._check_draws(draws or {})
        data = self.read(batch, size=size, curriculum=curriculum)
        rollout = self.rollout(data, length, size)
        prefixed = dict(rollout.prefix)
        for name, value in (prefix or {}).items():
            told = name in self.summed and not self.generative.local(name)
            if not told and (
                name not in (*self.latents, *self.summed) or value.dim() != 3 or value.shape[1] > rollout.length
            ):
                raise ValueError(
                    f"the prefix of {name} has shape {tuple(value.shape)}; expected the first values (B, O, D) of one "
                    f"of the latents {', '.join(self.latents)}, O at most {rollout.length}"
                )
            self.reader.check(name, value)
            (rollout.states if told else prefixed)[name] = value
        rollout.prefix = prefixed
        names = self.observed if mean_emission else ()
        rollout.mean_emission = names if isinstance(mean_emission, bool) else mean_emission
        if isinstance(self_feeding, int | float):
            self_feeding = self.feeding.at(self_feeding)
        rollout.feeding = self_feeding
        for block in self.generative.blocks:
            for name in block.names:
                if name in self.summed:
                    continue
                rollout = rollout.fork((draws or {}).get(name, 1))
                with rollout.plate:
                    rollout.know(name, self._site(name, rollout))
        precision = like(self).dtype  # whatever autocast computes in
        factors = {name: -e.to(precision) for name, e in self.penalties(rollout, data, draws or {}).items()}
        if data.log_det is not None and self.likelihood:
            factors["log_det"] = data.volume
        with pyro.plate("windows", rollout.batch // rollout.draws, dim=-1) if factors else nullcontext():
            for name, value in factors.items():
                unit = dist.Unit(value, validate_args=False)  # a loss that is not finite is told by the step
                pyro.sample(name, unit, obs=value.new_empty((*value.shape, 0)), infer={"is_auxiliary": True})
        return rollout.states | rollout.values

    def penalties(self, rollout: Rollout, data: Batch, draws: Mapping[str, int]) -> Mapping[str, Tensor]:
        """Energies that the program adds at its end as `pyro.factor` sites; none, unless a subclass has some.

        Args:
            rollout: the run, with the value of every variable, and `evaluate` for the conditionals.
            data: the batch, as `read` gives it.
            draws: as the program was given them.

        Returns:
            Name to (B,), positive where it costs.
        """
        return {}

    def _site(self, name: str, rollout: Rollout) -> Tensor:
        data = rollout.values.get(name)
        if self.generator[name].law.deterministic:  # a deterministic site in Pyro's sense, with no density to score
            value = rollout.draw(name) if data is None else data
            infer: Any = {**_note(self.generative, rollout), "_deterministic": True}
            law = dist.Delta(value, event_dim=value.dim() - 1, validate_args=False).mask(False)
            return pyro.sample(name, law, obs=value, infer=infer)
        return pyro.sample(name, rollout.law(name), obs=data, infer=_note(self.generative, rollout))

    def guide(
        self, batch: AnyBatch, *, draws: Mapping[str, int] | None = None, curriculum: float = 1.0, **_: Any
    ) -> dict[str, Tensor]:
        """The inference program q, with the arguments of `model`.

        Returns:
            Name to value of every latent.
        """
        self._register()
        self._check_draws(draws or {})
        rollout = self.rollout(self.read(batch, curriculum=curriculum), guide=True)
        for name in self.observed:
            if name not in rollout.values and any(name in c.parents for c in self.encoder.values()):
                raise ValueError(f"the guide reads {name}, the batch holds {', '.join(rollout.values) or 'nothing'}")
        values = {}
        for name in self.latents:
            n = (draws or {}).get(name, 1)
            one, rollout = rollout, rollout.fork(n)
            with rollout.plate:
                law = rollout.law(name) if self.inference.local(name) else one.law(name, n)
                values[name] = pyro.sample(name, law, infer=_note(self.inference, rollout))
                rollout.know(name, values[name])
        return values

    def forward(self, batch: AnyBatch | None = None, **options: Any) -> dict[str, Tensor]:
        """`model`, so that the module itself is the Pyro model of `elbo(model, model.guide)`."""
        return self.model(batch, **options)

    @property
    def prior_order(self) -> tuple[str, ...]:
        """The latents in the order in which the model draws them; `latents` is that of the guide."""
        return tuple(name for block in self.generative.blocks for name in block.names if name in self.latents)

    def _check_draws(self, draws: Mapping[str, int]) -> None:
        ours, orders = self.prior_order, (self.prior_order, self.latents)
        rows = [dict(zip(o, accumulate((draws.get(n, 1) for n in o), mul), strict=True)) for o in orders]
        if set(draws) - set(self.latents) or rows[0] != rows[1]:
            raise ValueError(
                f"draws are of latents, in one order for model and guide; got {', '.join(draws)}, where the model "
                f"draws {', '.join(ours) or 'nothing'} and the guide {', '.join(self.latents) or 'nothing'}"
            )
        if any(count < 1 for count in draws.values()):
            raise ValueError(f"draws are numbers from 1, got {dict(draws)}")

    # What is done with it ------------------------------------------------------------------------------------------

    @torch.no_grad()
    def sample(self, n: int = 1, length: int | None = None, batch: AnyBatch | None = None) -> dict[str, Tensor]:
        """Free runs from the prior.

        Args:
            n: how many; ignored where the batch (of context) tells.
            length: T.
            batch: context.

        Returns:
            Name to draws (n, T, D), or (n, D) of a static latent.
        """
        with self.running():
            data = self.read(batch, size=n)
            return self.shown(self.model(data, length=length, size=n), data)

    @torch.no_grad()
    def forecast(
        self,
        batch: AnyBatch,
        horizon: int,
        samples: int = 1,
        *,
        draw_emission: bool | None = None,
        fix: Mapping[str, Tensor] | None = None,
        chunk: int = CHUNK,
    ) -> dict[str, Tensor]:
        """Continues observed sequences: latents of the past from the guide, then the model runs free.

        Args:
            batch: the observed data (B, O, D), or a mapping; local context must reach over O + horizon steps.
            horizon: H, the number of steps to continue.
            samples: S, continuations of each sequence.
            draw_emission: draw the data from their distribution; False for its means. Means lack the emission's
                noise: they vary by the latents alone, and their quantiles are no prediction intervals. None for
                draws, unless the emission's scale is the weight of a squared error.
            fix: what is the same in all samples: the future (B, H, D) of a data variable, or the value (B, D) of a
                static latent, such as one sample of an earlier forecast. Later variables read it; latents are not
                inferred from it.
            chunk: sequences times samples to hold at once, beside the result; draws come chunk by chunk.

        Returns:
            Name to (S, B, H, D) for the data, (S, B, O + H, D) for local and (S, B, D) for static latents; with parts,
            the whole too.

        Raises:
            ValueError: a ragged batch, a local context that ends before the horizon, or a fixed value that cannot be.
        """
        with self.running():
            return forecast(self, batch, horizon, samples, draw_emission, fix, chunk)

    @torch.no_grad()
    def reconstruct(self, batch: AnyBatch, samples: int = 1, *, chunk: int = CHUNK) -> dict[str, Tensor]:
        """Means of the data given latents from the guide, teacher-forced; missing entries are filled in so.

        Args:
            batch: see `model`.
            samples: S, draws of the latents for each sequence.
            chunk: sequences times samples to hold at once, beside the result.

        Returns:
            Name to (S, B, T, D) for every data variable, and the whole where these are parts.
        """
        with self.running():
            return reconstruct(self, batch, samples, chunk)

    @torch.no_grad()
    def impute(
        self, batch: AnyBatch, samples: int = 1, *, draw: bool | None = None, particles: int = 1, chunk: int = CHUNK
    ) -> dict[str, Tensor]:
        """Fill in missing entries S times; observed entries stay as they are.

        The guide reads all observed entries, before and after a gap. Means of missing entries differ only as far as the
        draws of the latents do. Draws also have the noise of the emission, and later entries read the earlier ones.

        With one particle, only the guide uses what was observed after a gap. More particles correct the guide: the
        method draws S K latents and missing entries, and resamples S of them with the weights
        p(z, x observed) / q(z) (Mattei and Frellsen, 2019, arXiv 1812.02633). As K grows, these become draws given all
        observed entries. Longer sequences require more particles.

        Some models do not generate the first frames, which are context. Missing entries
        there repeat the first frame that the model generates.

        Args:
            batch: with a "mask", see `model`.
            samples: S, draws of the latents for each sequence.
            draw: draw the missing entries, or (False) take their means; None for what `is_drawn` returns.
            particles: K, draws for each sample, of which it is chosen.
            chunk: sequences times samples to hold at once, beside the result.

        Returns:
            Name to (S, B, T, D) for the variables that have a mask.

        Raises:
            ValueError: a batch without a mask, or particles where there is nothing to choose or to choose by.
        """
        with self.running():
            return impute(self, batch, samples, chunk, draw, particles)

    @torch.no_grad()
    def states(self, batch: AnyBatch, samples: int = 1, *, chunk: int = CHUNK) -> dict[str, Tensor]:
        """Probabilities of the states that are summed out, given the whole data and draws of the latents.

        Their mean over draws is the posterior's as far as the guide is; without other latents they are exact.

        Args:
            batch: see `model`.
            samples: S, draws of the latents for each sequence.
            chunk: sequences times samples to hold at once, beside the result.

        Returns:
            Name to (S, B, T, C), or (S, B, C) of a static one.

        Raises:
            ValueError: a model that sums nothing out.
        """
        with self.running():
            return states(self, batch, samples, chunk)

    @torch.no_grad()
    def log_joint(self, batch: AnyBatch, latents: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """log p of every variable given its parents, (B,) each, teacher-forced; their sum is the log joint.

        The log-determinant of a view that changes volume is one of them: the joint is that of the data as given.

        Raises:
            ValueError: a latent without a value, or with one of another shape.
        """
        if missing := [name for name in self.latents if name not in latents]:
            raise ValueError(f"the log joint needs a value of every latent; missing are {', '.join(missing)}")
        for name, value in latents.items():
            self.reader.check(name, value)
        with self.running():
            trace = poutine.trace(poutine.condition(self.model, data=dict(latents))).get_trace(batch)
            names = [name for name in (*self.generative.variables, "log_det") if name in trace]
            trace.compute_log_prob(site_filter=lambda name, site: name in names)
        return {name: trace.nodes[name]["log_prob"] for name in names}

    def _register(self) -> None:
        """Names the parameters in Pyro's store while `pyro.infer.SVI` looks for them, and else costs nothing."""
        if any(getattr(handler, "param_only", False) for handler in poutine.runtime._PYRO_STACK):
            pyro.module(self._name, self)

    # What is read, and what is handed out --------------------------------------------------------------------------

    @contextmanager
    def running(self) -> Iterator[None]:
        """Evaluation mode for a block that runs programs of the model, during which other threads wait."""
        with alone, evaluating(self) if self.training else nullcontext():
            yield

    def read(self, batch: AnyBatch | None, *, size: int = 1, curriculum: float = 1.0, precise: bool = False) -> Batch:
        """Return a batch by name, in the model's precision and the view's form, with missing entries filled.

        A batch that was read before stays as it is. Variables that sequences share are drawn if the batch does not
        give them, at a Pyro site outside the plate. Model and guide use the same draw, so it adds nothing to a bound.
        A shared variable may be given once, (D,), or for each sequence, (B, D).

        Args:
            batch: see `model`.
            size: B, where the batch does not tell.
            curriculum: see `model`.
            precise: read the variables that have units in float64 where they are so, as to fit these.

        Raises:
            ValueError: names that the model does not have, a mask of nothing, or data that the view cannot show.
        """
        if like(self).is_meta:
            raise ValueError(
                "the model's parameters are on the meta device and have no values; build the model outside of "
                "`torch.device('meta')`, or call `to_empty(device='cpu')` and load weights"
            )
        reader = self.reader, like(self).dtype
        if isinstance(batch, Batch) and batch.reader == reader and not precise:
            return batch
        means = {name: units.filling for name, units in self.units.items()}
        # by guide and model both, but for what they share
        wide = {name for name in self.units if name in self.wide or (precise and _is_wide(batch, name))}
        data = Batch(once(self, [batch], lambda: self.reader.read(batch, reader[1], means, wide)))
        one = {name: data.pop(name) for name in self.shared if name in data and data[name].dim() == 1}
        size = next((len(value) for value in data.values() if isinstance(value, Tensor)), size)
        for name, spec in self.shared.items():
            if name not in data:
                law = spec.distribution(self.sizes[name], curriculum)
                value = one[name] if name in one else pyro.sample(name, law, infer=SHARED)
                data[name] = once(self, [value, size], partial(self._of_each, value, size))  # by guide and model both
        data.reader = None if precise else reader
        return data

    def _of_each(self, value: Tensor, size: int) -> Tensor:
        return value.to(like(self)).expand(size, -1)

    def shown(self, values: Mapping[str, Tensor], data: Batch | None = None) -> dict[str, Tensor]:
        """Values that the model made, with those of the data as the data are: back through the view.

        Args:
            values: name to (..., B, T, D), as the model sees them.
            data: the batch that they belong to, as `read` gives it; without it they stay as they were turned.

        Returns:
            The same with the whole, where the view makes parts of it.
        """
        added = {name: data[name] for name in self.view.names if name in data} if data else {}
        return {**values, **self.view.inverse(Batch(added | {n: v for n, v in values.items() if n in self.observed}))}


def _is_wide(batch: Any, name: str) -> bool:
    """Whether float32 may not resolve a variable of a batch."""
    value = batch.get(name) if isinstance(batch, Mapping) else batch
    return value is not None and exceeds_float32(value.dtype)


def _locality(factorization: Factorization) -> dict[str, bool]:
    return {n: factorization.local(n) for n in (*factorization.variables, *factorization.context)}


def _note(factorization: Factorization, rollout: Rollout) -> Any:
    """What a site says of its program: bounds decide from it where a KL term may be analytic, and average draws."""
    return {"program": factorization, "run": rollout}


def _checked_sizes(sizes: Mapping[str, int]) -> dict[str, int]:
    if not isinstance(sizes, Mapping):
        raise TypeError(f'sizes is {sizes!r}; expected the size of every variable by name, such as {{"z": 2, "x": 3}}')
    for name, size in sizes.items():
        if error := problem(f"the size of {name}", size, Annotated[int, Range(1, 2**20)]):
            raise error
    return dict(sizes)


def _by_factor(given: Any, default: Any, what: str) -> dict[str, Any]:
    table = dict(given) if isinstance(given, Mapping) else {} if given is None else {"default": given}
    for key, spec in table.items():
        if isinstance(spec, type) or not hasattr(spec, "build"):
            said = kind_of(spec) if isinstance(spec, type) else repr(spec)
            raise ValueError(f"the {what} of {key!r} is {said}; expected a description such as {default!r}")
    return {"default": default, **table}
