"""A pair of factorizations and their networks, as a Pyro model and guide.

The programs have one sample site per variable, whatever the number of steps. A static `w` has the event shape (D,),
local `z` and `x` have (T, D), all inside the plate "sequences". Free runs, forecasts, reconstructions and scores use
the same program with different given values.
"""

from __future__ import annotations

import copy
import itertools
import os
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
from ..distributions.base import DistributionSpec
from ..distributions.families import Normal, StandardNormal
from ..distributions.family import FAMILIES
from ..distributions.subset import Subset
from ..factorization.inversion import guide
from ..factorization.notation import Factor, Factorization, check_pair
from ..factorization.relations import MaskFunction
from ..locking import serialized
from ..networks import NetworkSpec, Recurrent
from ..networks.loop import memoize
from ..options import Count, Range, kind_of, problem, require
from .batch import CHUNK, AnyBatch, Reader
from .conditional import Conditional, evaluating, like
from .enumeration import Discrete, EnumerationPlan
from .filtering import Filter
from .forecast import forecast, impute, reconstruct, states
from .rollout import InputNoise, Rollout, ScheduledSampling

_COUNT = itertools.count()
SHARED: Any = {"shared": True}
"""The `infer` entry that marks the site of a variable shared by all sequences."""


class DynamicalVAE(nn.Module):
    """A generative model and its guide, built from their equations.

    Args:
        generative: text such as "p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)", or a `Factorization`.
        inference: text such as "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{1:T}, w)"; "" for a model without latents.
            "faithful" is the smallest guide that keeps every dependency of the posterior (`faithful_inverse`). None
            uses the prior as the guide, and every KL term is exactly zero.
        sizes: dimension of every variable, context included. A `Discrete` size makes a latent categorical, and the
            model sums it out.
        network: description of the networks, or a mapping from factors to descriptions. Its keys are "p(x)" for one
            factor, "p" for all generative factors, "q" for all factors of the guide, and "default".
        distributions: distributions of the factors, with the same keys; the default is `distributions.Normal()`. A
            generative factor without parents is N(0, I), unless "p(w)" itself is a key, for example with
            `distributions.Mixture()`.
        observed: names of the data variables; every other variable with a generative factor is a latent.
        masks: custom relations, as a dictionary from name to a function of T (`Factorization.parse`).
        view: transformation of the data that the model sees, such as a split into parts (`dvae.data.views`); none by
            default.
        shared: dictionary from static context variable to its distribution. If a batch does not give such a variable,
            the programs draw it once for all sequences of the batch. A forecast draws it once for each sample.
        grouped: static latents that the sequences of a group share. A batch gives the groups as "group" (B,); without
            it, every sequence is its own group (`dvae.program.groups`).
        indicators: data variables whose pattern of missing entries the guide also reads. Each coordinate has an
            indicator of 0 or 1, all 1 without a mask (Collier et al., 2020, arXiv 2006.05301). Without indicators, the
            guide cannot distinguish a missing entry from one observed at 0, or at the mean of a variable with units.

    Raises:
        TypeError: if a size is not an integer, or `view` is a class instead of an instance.
        ValueError: if the equations are invalid or do not fit together, a size is missing, unknown or out of range, or
            a network or distribution is a class.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})", {"z": 2, "x": 3})
        >>> model.sample(5, length=10)["x"].shape
        torch.Size([5, 10, 3])
    """

    extras: ClassVar[tuple[str, ...]] = ()
    """Names of batch entries that are not variables, but that `penalties` reads."""
    forks: ClassVar[bool] = True
    """Whether `draws` repeats the rows of a forecast; False in a subclass that uses `draws` differently."""
    per: str = "step"
    """Unit of one log-likelihood: "step", "frame" or "window"."""

    @serialized
    @torch.inference_mode(False)  # keeps parameters trainable if the model is built in inference mode
    def __init__(
        self,
        generative: str | Factorization,
        inference: str | Factorization | None,
        sizes: Mapping[str, int],
        network: NetworkSpec | Mapping[str, NetworkSpec] | None = None,
        distributions: DistributionSpec | Mapping[str, DistributionSpec] | None = None,
        observed: tuple[str, ...] = ("x",),
        masks: Mapping[str, MaskFunction] | None = None,
        *,
        view: View | None = None,
        shared: Mapping[str, Subset] | None = None,
        grouped: Collection[str] = (),
        indicators: Collection[str] = (),
    ):
        super().__init__()
        self._name = f"dvae{next(_COUNT)}"  # unique: Pyro's store is global
        self.generative = Factorization.parse(generative, masks)
        self.feeding: ScheduledSampling | InputNoise = ScheduledSampling(0.0)
        if not isinstance(view, View | None):
            raise TypeError(f"the view is {kind_of(view)}; expected an instance such as dvae.data.views.View()")
        self.view = view or View()
        observed = tuple(self.view.parts or observed)
        self.sizes = _check_sizes(sizes)
        self.summed = tuple(n for n, size in self.sizes.items() if isinstance(size, Discrete) and n not in observed)
        self.inference = guide(self.generative, inference, observed, masks, self.summed)
        self.latents, self.observed, self.context = check_pair(
            self.generative, self.inference, observed, sizes, self.summed
        )
        self.sums = (
            EnumerationPlan(self.generative, {name: self.sizes[name] for name in self.summed}) if self.summed else None
        )
        for name in self.sizes:
            if hasattr(nn.ModuleDict, name):
                raise ValueError(f"a variable cannot be named {name!r}, which is an attribute of torch's modules")
        self.networks = _by_factor(network, Recurrent(), "network")
        self.distributions = _by_factor(distributions, Normal(), "distribution")
        keys = {f"{f.kind}({f.child})" for f in (*self.generative.factors, *self.inference.factors)}
        for key in {*self.networks, *self.distributions} - keys - {"p", "q", "default"}:
            raise ValueError(f"no factor {key!r}; keys are {', '.join(sorted(keys))}, 'p', 'q' and 'default'")
        self.view.check(self.sizes, self.context, self.generative)
        self.shared = dict(shared or {})
        for name in self.shared:
            if name not in self.context or self.generative.local(name) or self.inference.local(name):
                raise ValueError(
                    f"only static context can be drawn once for all sequences, and {name} is not: it must be a parent "
                    f"without a factor, such as in p(x_t | {name}); context is {', '.join(self.context) or 'nothing'}"
                )
        self.grouped = tuple(grouped)
        self._check_grouped()
        self.indicators = tuple(indicators)
        if unknown := [name for name in self.indicators if name not in observed]:
            raise ValueError(
                f"indicators mark observed data, but {', '.join(unknown)} is not one of {', '.join(observed)}"
            )
        roots, rest = ([f for f in self.generative.factors if bool(f.parents) == more] for more in (False, True))
        self.generator: Any = self._conditionals(rest)
        guides = {} if inference is None else self._conditionals(self.inference.factors)
        self.generator.update(self._conditionals(roots, guides))  # last: a prior may contain the guide
        if inference is None:  # the same modules as the prior, which must not be registered twice
            object.__setattr__(self, "encoder", {name: self.generator[name] for name in self.latents})
        else:
            self.encoder: Any = guides
        self._check_latents()
        changes_all = not (self.view.keeps_volume or self.view.by_coordinate)
        if masses := [name for name in self.observed if changes_all and self.generator[name].discrete]:
            raise ValueError(
                f"{self.view} changes volume, but {', '.join(masses)} is discrete; use a view that does not"
            )
        self.reader = Reader(
            self.sizes,
            {**_locality(self.inference), **_locality(self.generative)},
            self.observed,
            self.context,
            self.view,
            self.extras,
            frozenset(name for name in self.view.parts or () if self.generator[name].head.deterministic),
            {name: self.generator[name] for name in self.observed},
            self.likelihood,
            self.grouped,
        )
        self.units: Any = nn.ModuleDict()

    def _conditionals(self, factors: Iterable[Factor], guides: Mapping[str, Conditional] | None = None) -> Any:
        def pick(table: Mapping[str, Any], factor: Factor) -> Any:
            key = f"{factor.kind}({factor.child})"
            if table is self.distributions and isinstance(self.sizes[factor.child], Discrete):
                return table.get(key, FAMILIES["category"])
            if table is self.distributions and factor.kind == "p" and not factor.parents:
                return table.get(key, StandardNormal())
            return table.get(key, table.get(factor.kind, table["default"]))

        return nn.ModuleDict(
            {
                factor.child: Conditional(
                    factor,
                    self.sizes,
                    pick(self.networks, factor),
                    pick(self.distributions, factor),
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
                raise ValueError(
                    f"`grouped` must name static latents, but {name!r} is not one of {self.generative.text!r}"
                )
            others = [p.name for p in self.generative.factor(name).parents if p.name not in self.grouped]
            if others:
                raise ValueError(
                    f"{self.generative.factor(name)} reads {', '.join(others)}, which differs between sequences of a "
                    "group; a grouped latent can read only variables that a group shares"
                )

    def _check_latents(self) -> None:
        for name in self.latents:
            # minus a lower bound of the guide's density is an upper bound, so the ELBO would not be a bound
            for conditional, allowed in ((self.generator[name], ("exact", "bound")), (self.encoder[name], ("exact",))):
                if (density := _density(conditional)) not in allowed:
                    raise ValueError(
                        f"{conditional.factor} has a {density} in place of a density, but the "
                        f"distribution of a latent needs a density{' or a bound' * ('bound' in allowed)}; use another "
                        "one, such as distributions.Normal()"
                    )
                if conditional.discrete or (conditional is self.encoder[name] and not conditional.reparameterised):
                    problem = "are discrete" if conditional.discrete else "are not reparameterised"
                    raise ValueError(
                        f"draws of the latent {name} from the distribution of {conditional.factor} {problem}, so no "
                        f"gradient would reach the guide through them; give it a continuous distribution such as "
                        f"distributions.Normal(), name {name} as observed if it is data, or sum out a categorical "
                        f"one: sizes={{{name!r}: dvae.Discrete(states)}}"
                    )
        for name in self.summed:
            if (distribution := self.generator[name].head.label) != "OneHotCategorical":
                raise ValueError(
                    f"{name} is summed out over its {self.sizes[name]} states, but the distribution of "
                    f"{self.generator[name].factor} is {distribution}; use the default, a categorical distribution"
                )
            for conditional in self.generator.values():  # a sum of random bounds over states is above their bound
                read = name in [parent.name for parent in conditional.factor.parents]
                if read and (density := _density(conditional)) != "exact":
                    raise ValueError(
                        f"{conditional.factor} has a {density} in place of a density, so {name} cannot be summed out; "
                        "use a distribution with a density, such as distributions.Normal()"
                    )

    @torch.inference_mode(False)
    def standardise(
        self,
        name: str,
        coordinates: Sequence[Coordinate] = (),
        exposure: tuple[str, Sequence[int]] | None = None,
    ) -> Units:
        """Make the networks read a standardised variable; call `fit` on the result to set mean and scale.

        If the distribution of the variable has a location and a scale (`ConditionalDistribution.location_scale`),
        networks also produce its parameters standardised. Probabilities and rates are produced unchanged. Densities and
        values stay in the variable's own unit. Call this method before the model is fitted.

        Args:
            name: name of the variable.
            coordinates: units of each coordinate, such as a column of a table; they replace the mean and scale that
                `fit` would set.
            exposure: name of a context variable r_t of the generative factor, and the coordinates of the variable whose
                scale or rate is multiplied by exp(r_t).

        Returns:
            Units of the variable; their `fit` sets mean and scale from data.

        Raises:
            ValueError: if the variable is unknown, or its generative factor does not read the exposure.
        """
        if name not in self.sizes:
            raise ValueError(f"no variable {name!r}; there are {', '.join(self.sizes)}")
        if exposure is not None:
            factor = self.generator[name].factor
            if exposure[0] not in self.context or factor.parent(exposure[0]) is None:
                raise ValueError(
                    f"{factor} does not read the exposure {exposure[0]}, which must be context; add {exposure[0]}_t to "
                    "its parents"
                )
            self.generator[name].exposure = exposure
        units = Units(self.sizes[name], coordinates, exact=name not in self.latents, variable=name)
        self.units[name] = units.to(like(self))
        for conditional in (*self.generator.values(), *self.encoder.values()):
            conditional.units[name] = self.units[name]
        return self.units[name]

    @serialized
    @torch.inference_mode(False)
    def with_prior(self, distributions: Mapping[str, DistributionSpec]) -> DynamicalVAE:
        """Return a copy with new distributions of latents and all other parameters frozen, for a second stage.

        Fitting the copy trains the new distributions on draws of the guide. With a `Diffusion`, the copy is a latent
        diffusion model (Rombach et al., 2022, arXiv 2112.10752). The frozen parameters have `requires_grad` False.

        Args:
            distributions: dictionary from generative factor of a latent to its new distribution. A short key, such as
                "p(w)", keeps the parents. A whole factor, such as "p(z_{1:T})", replaces the old one, with parents
                among the variables of the model. If the factor has a network, it has the same description as before
                and new weights.

        Raises:
            ValueError: if a key is not a factor of a latent, the guide is the prior, or a factor or a distribution does
                not fit.

        Example:
            >>> model = dvae.DynamicalVAE("p(w) p(x_t | w)", "q(w | x_{1:T})", {"w": 2, "x": 3})
            >>> x = torch.randn(8, 5, 3)
            >>> first = dvae.fit(model, x, steps=3, progress=False)
            >>> second = model.with_prior({"p(w)": dvae.distributions.Diffusion()})
            >>> dvae.fit(second, x, steps=3, progress=False).status
            'finished'
        """
        old = {name: self.generative.factor(name) for name in self.latents}
        new: dict[str, Factor] = {}
        for key in distributions:
            short = [factor for name, factor in old.items() if key == f"p({name})"]
            factor, *others = short or Factorization.parse(key).factors
            replaced = None if others or factor.kind != "p" else old.get(factor.child)
            if replaced and replaced.local == factor.local:
                new[factor.child] = factor
        if len(new) != len(distributions) or not new:
            names = ", ".join(map(str, old.values()))
            raise ValueError(
                f"got distributions of {', '.join(distributions) or 'nothing'}; expected factors of latents, which are "
                f"{names or 'missing in this model'}"
            )
        _by_factor(distributions, Normal(), "distribution")
        if "encoder" not in self._modules:
            raise ValueError("the guide is the prior, so a new prior would replace both; give the model a guide")
        model = copy.deepcopy(self).requires_grad_(False)
        model._name = f"dvae{next(_COUNT)}"
        model.generative = Factorization("p", tuple(new.get(each.child, each) for each in self.generative.factors))
        check_pair(model.generative, model.inference, model.observed, model.sizes, model.summed)
        model._check_grouped()
        by_factor = zip((f"p({name})" for name in new), distributions.values(), strict=True)
        model.distributions = {**self.distributions, **dict(by_factor)}
        added = model._conditionals(new.values(), model.encoder)
        for conditional in added.values():
            conditional.units.update(model.units.items())
        model.generator.update(added.to(like(self)))
        model._check_latents()
        return model.train(self.training)

    def extra_repr(self) -> str:
        """Return the two equations, for the text of the model."""
        return "\n".join(str(equation) for equation in (self.generative, self.inference) if equation.factors)

    @property
    def wide(self) -> frozenset[str]:
        """Names of the variables whose values are in float64 whatever the precision of the model."""
        names = (name for name, units in self.units.items() if units.wide)
        return frozenset(n for n in names if n not in self.observed or self.generator[n].offset is not None)

    @property
    def likelihood(self) -> bool:
        """Whether the data have a density given the latents.

        Models without one (`distributions.Delta`, `distributions.FlowMatching`) have no bound.
        """
        heads = [self.generator[name].head for name in self.observed]
        return not any(head.deterministic or head.density == "loss" for head in heads)

    @property
    def can_forecast(self) -> bool:
        """Whether the model continues sequences; a joint distribution of all steps needs their past as context."""
        return bool(self.view.past or self.view.given) or not any(each.joint for each in self.generator.values())

    @property
    def bounded(self) -> tuple[str, ...]:
        """Names of the variables with a stochastic lower bound in place of a density (`distributions.Diffusion`).

        Bounds on the evidence remain bounds. Importance weights are not available.
        """
        return tuple(name for name, each in self.generator.items() if each.head.density == "bound")

    @property
    def has_curriculum(self) -> bool:
        """Whether a curriculum affects the programs, through the draws of shared context."""
        return bool(self.shared)

    def is_drawn(self, means: bool = False) -> bool:
        """Return whether forecasts draw the data if `draw_emission` is not given.

        They do, unless the emission's scale is the weight of a squared error (`ConditionalDistribution.error_weight`).

        Args:
            means: prefer means, for scores that are published for means. Data are drawn anyway if they are discrete,
                since a mean is then not a possible value. They are also drawn if the model has no latents, since all
                samples would be equal.
        """
        distributions = [self.generator[name] for name in self.observed]
        if means and (self.latents or self.summed) and not any(each.discrete for each in distributions):
            return False
        return not any(each.head.error_weight for each in distributions)

    def rollout(
        self, batch: AnyBatch | None, length: int | None = None, size: int = 1, *, guide: bool = False
    ) -> Rollout:
        """Return a `Rollout` over a batch, which draws variables on demand.

        `model` and `guide` turn such a run into sample sites. Use it to evaluate conditional distributions step by
        step, as the oracle and the particle filter do.

        Args:
            batch: as in `model`; None for a free run.
            length: T, if it differs from the length of the data.
            size: B, without a batch.
            guide: run the guide instead of the model.

        Raises:
            ValueError: if the batch is invalid.
        """
        if guide:
            return self.reader.rollout(self.inference, self.encoder, self.read(batch), length, size)
        run = self.reader.rollout(self.generative, self.generator, self.read(batch), length, size)
        run.sums = self.sums
        return run

    # The Pyro program ----------------------------------------------------------------------------------------------

    def model(
        self,
        batch: AnyBatch | None = None,
        *,
        length: int | None = None,
        size: int = 1,
        prefix: Mapping[str, Tensor] | None = None,
        mean_emission: bool | Collection[str] = False,
        scheduled_sampling: ScheduledSampling | InputNoise | float | Tensor | None = None,
        draws: Mapping[str, int] | None = None,
        curriculum: float = 1.0,
    ) -> dict[str, Tensor]:
        """Run the generative program p: teacher-forced where data are given, free where they are not.

        Args:
            batch: data (B, T, D), or a mapping from variable names to tensors, context included. Optional entries:
                "lengths" (B,) of a ragged batch, and "mask", True where an entry of the data was observed, (B, T, D) or
                a mapping by name. At a missing entry, the model reads its own mean and the guide reads 0 (the mean, for
                a variable with units). Arrays become tensors in the model's precision.
            length: T. If it exceeds the length of the data, the program continues the data.
            size: B, if the batch does not determine it.
            prefix: dictionary from latent to its first values (B, O, D), or to the value (B, C) of a static latent that
                is summed out.
            mean_emission: in a free run, set the data variables, or the named ones, to their means instead of drawing
                them.
            scheduled_sampling: replacement for the data's history: a `ScheduledSampling`, an
                `InputNoise`, or a number. A number sets the probability or the share of the noise of the model's
                attribute `feeding`.
            draws: dictionary from latent to a number n. The program draws the latent n times for each sequence and
                continues each draw, so later variables have n times as many rows, ordered draw by draw.
            curriculum: progress of the curriculum for the draws of shared context, from 0 to 1
                (`distributions.Subset`).

        Returns:
            Dictionary from variable name to value.

        Raises:
            ValueError: the batch, `draws` or the prefix has an unknown name or a wrong shape, or the length is not
                known.
        """
        self._register()
        self._check_draws(draws or {})
        data = self.read(batch, size=size, curriculum=curriculum)
        rollout = self.rollout(data, length, size)
        prefixed = dict(rollout.prefix)
        for name, value in (prefix or {}).items():
            is_state = name in self.summed and not self.generative.local(name)
            if not is_state and (
                name not in (*self.latents, *self.summed) or value.dim() != 3 or value.shape[1] > rollout.length
            ):
                raise ValueError(
                    f"the prefix of {name} has shape {tuple(value.shape)}; expected the first values (B, O, D) of one "
                    f"of the latents {', '.join(self.latents)}, O at most {rollout.length}"
                )
            self.reader.check(name, value)
            (rollout.states if is_state else prefixed)[name] = value
        rollout.prefix = prefixed
        names = self.observed if mean_emission else ()
        rollout.mean_emission = names if isinstance(mean_emission, bool) else mean_emission
        if isinstance(scheduled_sampling, int | float | Tensor):
            scheduled_sampling = self.feeding.at(scheduled_sampling)
        rollout.feeding = scheduled_sampling
        for block in self.generative.blocks:
            for name in block.names:
                if name in self.summed:
                    continue
                rollout = rollout.fork((draws or {}).get(name, 1))
                with rollout.plate:
                    rollout.know(name, self._site(name, rollout))
        precision = like(self).dtype  # autocast may compute in another
        factors = {name: -e.to(precision) for name, e in self.penalties(rollout, data, draws or {}).items()}
        if data.log_det is not None and self.likelihood:
            factors["log_det"] = data.volume
        with pyro.plate("windows", rollout.batch // rollout.draws, dim=-1) if factors else nullcontext():
            for name, value in factors.items():
                unit = dist.Unit(value, validate_args=False)  # the training step reports a loss that is not finite
                pyro.sample(name, unit, obs=value.new_empty((*value.shape, 0)), infer={"is_auxiliary": True})
        return rollout.states | rollout.values

    def penalties(self, rollout: Rollout, data: Batch, draws: Mapping[str, int]) -> Mapping[str, Tensor]:
        """Return the energies that the program adds as `pyro.factor` sites; none, unless a subclass overrides this.

        Args:
            rollout: the run, with the value of every variable and `evaluate` for its conditional distributions.
            data: the batch that `read` returned.
            draws: numbers of draws, as given to the program.

        Returns:
            Dictionary from site name to energies (B,), which are subtracted from the log joint.
        """
        return {}

    def _site(self, name: str, rollout: Rollout) -> Tensor:
        data = rollout.values.get(name)
        if self.generator[name].head.deterministic:  # a deterministic site in Pyro's sense, with no density to score
            value = rollout.draw(name) if data is None else data
            infer: Any = {**_note(self.generative, rollout), "_deterministic": True}
            distribution = dist.Delta(value, event_dim=value.dim() - 1, validate_args=False).mask(False)
            return pyro.sample(name, distribution, obs=value, infer=infer)
        return pyro.sample(name, rollout.distribution(name), obs=data, infer=_note(self.generative, rollout))

    def guide(
        self, batch: AnyBatch, *, draws: Mapping[str, int] | None = None, curriculum: float = 1.0, **_: Any
    ) -> dict[str, Tensor]:
        """Run the inference program q.

        Args:
            batch: data, as in `model`; it must include every data variable that the guide reads.
            draws: dictionary from latent to a number of draws for each sequence, as in `model`.
            curriculum: progress of the curriculum, from 0 to 1, as in `model`.
            _: further arguments of `model`, which are ignored.

        Returns:
            Dictionary from latent to value.

        Raises:
            ValueError: the guide reads a variable that the batch does not contain, or the batch or `draws` is invalid.
        """
        self._register()
        self._check_draws(draws or {})
        rollout = self.rollout(self.read(batch, curriculum=curriculum), guide=True)
        for name in self.observed:
            if name not in rollout.values and any(name in c.parents for c in self.encoder.values()):
                raise ValueError(
                    f"the guide reads {name}; give it in the batch, which has {', '.join(rollout.values) or 'nothing'}"
                )
        values = {}
        for name in self.latents:
            n = (draws or {}).get(name, 1)
            one, rollout = rollout, rollout.fork(n)
            with rollout.plate:
                distribution = rollout.distribution(name) if self.inference.local(name) else one.distribution(name, n)
                values[name] = pyro.sample(name, distribution, infer=_note(self.inference, rollout))
                rollout.know(name, values[name])
        return values

    def forward(self, batch: AnyBatch | None = None, **options: Any) -> dict[str, Tensor]:
        """Run `model`, which makes the module itself the Pyro model of `elbo(model, model.guide)`.

        Args:
            batch: batch, as in `model`.
            options: further arguments of `model`.

        Returns:
            Dictionary from variable to value, as from `model`.
        """
        return self.model(batch, **options)

    @property
    def prior_order(self) -> tuple[str, ...]:
        """The latents in the model's sampling order; `latents` follows the order of the guide."""
        return tuple(name for block in self.generative.blocks for name in block.names if name in self.latents)

    def _check_draws(self, draws: Mapping[str, int]) -> None:
        prior, orders = self.prior_order, (self.prior_order, self.latents)
        rows = [dict(zip(o, accumulate((draws.get(n, 1) for n in o), mul), strict=True)) for o in orders]
        if set(draws) - set(self.latents) or rows[0] != rows[1]:
            raise ValueError(
                f"draws must name latents, in one order for model and guide; got {', '.join(draws)}, where the model "
                f"draws {', '.join(prior) or 'nothing'} and the guide {', '.join(self.latents) or 'nothing'}"
            )
        if any(count < 1 for count in draws.values()):
            raise ValueError(f"draws must be at least 1 for each latent, got {dict(draws)}")

    # Uses of a model -----------------------------------------------------------------------------------------------

    @torch.no_grad()
    def sample(self, n: int = 1, length: int | None = None, batch: AnyBatch | None = None) -> dict[str, Tensor]:
        """Draw sequences from the prior.

        Args:
            n: number of sequences; ignored if the batch (of context) determines it.
            length: T.
            batch: context.

        Returns:
            Dictionary from variable name to draws (n, T, D), or (n, D) for a static latent.

        Raises:
            ValueError: the batch is invalid, the length is not known, or `n` is below 1.
        """
        require(Count, n=n)
        with self.running():
            data = self.read(batch, size=n)
            return self.to_data_space(self.model(data, length=length, size=n), data)

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
        """Continue observed sequences: the guide infers the latents of the past, then the model runs free.

        Args:
            batch: observed data (B, O, D), or a mapping; local context must cover O + horizon steps.
            horizon: H, the number of steps to continue.
            samples: S, continuations of each sequence.
            draw_emission: draw the data from their distribution (True) or use its means (False). Means have no emission
                noise: they vary by the latents alone, and their quantiles are not prediction intervals. None draws,
                unless the emission's scale is the weight of a squared error.
            fix: values that all samples share: futures (B, H, D) of data variables, or values (B, D) of static latents,
                such as a sample of an earlier forecast. Later variables read them; latents are not inferred from them.
            chunk: maximum of sequences times samples in memory, in addition to the result. Random draws follow the
                chunks.

        Returns:
            Dictionary from variable name to values: (S, B, H, D) for data, (S, B, O + H, D) for local latents and
            (S, B, D) for static ones; if the view splits the data into parts, also the whole array.

        Raises:
            ValueError: if the batch is ragged, local context ends before the horizon, or a value cannot be fixed.
        """
        with self.running():
            return forecast(self, batch, horizon, samples, draw_emission, fix, chunk)

    def filter(
        self,
        batch: AnyBatch | None = None,
        particles: int | None = None,
        *,
        lag: int = 0,
        resample_below: float = 0.5,
        seed: int | None = None,
        resume: str | os.PathLike[str] | None = None,
    ) -> Filter:
        """Filter sequences online: distributions of latents given the data so far, and of each step given earlier ones.

        The result has the results of all given steps, `filtered`; `update` continues with new steps, and `predict`
        returns the distribution of the next one. Discrete latents are summed out exactly. Other latents have weighted
        particles, which are resampled as in `fivo_bound`: the sum of the log evidences is that bound. The guide
        proposes the particles unless it reads later data; then the generative distribution does
        (`Filtered.proposal`).

        Args:
            batch: first steps, as in `model`, complete, ragged or with a mask.
            particles: K, number of particles; None for the exact filter of a linear-Gaussian model, and 100 particles
                for other models with continuous latents.
            lag: L of fixed-lag smoothing, the distribution of z_{t-L} given the data up to t.
            resample_below: share of K; particles are resampled before a step if the effective sample size is below it.
            seed: seed of all random numbers of the filter.
            resume: file of `Filter.save`, which replaces all other arguments.

        Raises:
            ValueError: the batch or an argument is invalid, or the model cannot be filtered, such as one whose
                likelihood reads latents after t.

        Example:
            >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 1, "x": 2})
            >>> stream = model.filter(torch.randn(3, 4, 2), particles=16)
            >>> stream.update(torch.randn(3, 2)).log_evidence.shape
            torch.Size([3, 1])
        """
        if resume is None:
            if batch is None:
                raise ValueError("filter needs the first steps of the data, or resume= with the file of a filter")
            return Filter(self, batch, particles, lag, resample_below, seed)
        if any(each is not None for each in (batch, particles, seed)) or (lag, resample_below) != (0, 0.5):
            raise ValueError("resume= restores a filter with all its settings; leave out the other arguments")
        return Filter.load(self, resume)

    @torch.no_grad()
    def reconstruct(self, batch: AnyBatch, samples: int = 1, *, chunk: int = CHUNK) -> dict[str, Tensor]:
        """Return means of the data given latents from the guide, teacher-forced; missing entries are filled in.

        Args:
            batch: as in `model`.
            samples: S, draws of the latents for each sequence.
            chunk: maximum of sequences times samples in memory, in addition to the result.

        Returns:
            Dictionary from data variable to means (S, B, T, D); if the view splits the data into parts, also the whole
            array.
        """
        with self.running():
            return reconstruct(self, batch, samples, chunk)

    @torch.no_grad()
    def impute(
        self, batch: AnyBatch, samples: int = 1, *, draw: bool | None = None, particles: int = 1, chunk: int = CHUNK
    ) -> dict[str, Tensor]:
        """Fill in missing entries S times; observed entries keep their values.

        The guide reads all observed entries, before and after the missing ones. Means of missing entries vary only
        because the latents vary. Draws also have the noise of the emission, and later entries read the earlier ones.

        With one particle, only the guide uses observations after a missing entry. More particles correct the guide
        (Mattei and Frellsen, 2019, arXiv 1812.02633). The method draws S K latents and missing entries, and keeps S
        of them, sampled with the weights p(z, x observed) / q(z). As K grows, these become draws given all observed
        entries. Longer sequences require more particles.

        Some models do not generate the first frames, which are context. Missing entries there repeat the first frame
        that the model generates.

        Args:
            batch: batch with a "mask", as in `model`.
            samples: S, draws of the latents for each sequence.
            draw: draw the missing entries (True) or use their means (False); None uses `is_drawn`.
            particles: K, number of candidates for each sample.
            chunk: maximum of sequences times samples in memory, in addition to the result.

        Returns:
            Dictionary from the variables with a mask to their values (S, B, T, D).

        Raises:
            ValueError: if the batch has no mask, or `particles` is below 1, or above 1 for means or a model without a
                likelihood.
        """
        with self.running():
            return impute(self, batch, samples, chunk, draw, particles)

    @torch.no_grad()
    def states(self, batch: AnyBatch, samples: int = 1, *, chunk: int = CHUNK) -> dict[str, Tensor]:
        """Return probabilities of the states that are summed out, given all data and draws of the latents.

        Without other latents, the probabilities are exact. With other latents, their mean over draws is exact only if
        the guide is the posterior of these latents.

        Args:
            batch: as in `model`.
            samples: S, draws of the latents for each sequence.
            chunk: maximum of sequences times samples in memory, in addition to the result.

        Returns:
            Dictionary from summed-out latent to probabilities (S, B, T, C), or (S, B, C) if it is static.

        Raises:
            ValueError: if the model sums nothing out.
        """
        with self.running():
            return states(self, batch, samples, chunk)

    @torch.no_grad()
    def log_joint(self, batch: AnyBatch, latents: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return log p of every variable given its parents, (B,) each, teacher-forced; their sum is the log joint.

        A view that changes volume adds its log-determinant as one entry: the joint is a density of the data as given.

        Args:
            batch: batch, as in `model`.
            latents: value of every latent by name, (B, T, D), or (B, D) for a static latent.

        Raises:
            ValueError: if a latent is missing or has the wrong shape, or a variable has a loss instead of a density.
        """
        if losses := [name for name in self.observed if self.generator[name].head.density == "loss"]:
            raise ValueError(f"{', '.join(losses)} has a loss instead of a density, so the model has no log joint")
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
        """Register the parameters in Pyro's store while `pyro.infer.SVI` collects them; otherwise do nothing."""
        if any(getattr(handler, "param_only", False) for handler in poutine.runtime._PYRO_STACK):
            pyro.module(self._name, self)

    # Reading batches and returning data ----------------------------------------------------------------------------

    @contextmanager
    def running(self) -> Iterator[None]:
        """Switch to evaluation mode for a block that runs programs of the model; other threads wait."""
        with serialized, evaluating(self) if self.training else nullcontext():
            yield

    def read(self, batch: AnyBatch | None, *, size: int = 1, curriculum: float = 1.0, precise: bool = False) -> Batch:
        """Return a batch in the model's precision and representation, on its device, with missing entries filled in.

        A batch that was read before is returned unchanged. Shared variables are drawn if the batch does not give them,
        at a Pyro site outside the plate. Model and guide use the same draw, which therefore adds nothing to a bound. A
        shared variable may be given once, (D,), or for each sequence, (B, D).

        Args:
            batch: as in `model`.
            size: B, if the batch does not determine it.
            curriculum: as in `model`.
            precise: whether variables with units stay in float64 if the batch has them in float64, to fit the units.

        Raises:
            ValueError: if the batch has names that the model does not know, a mask without its variable, or data that
                the view rejects.
        """
        parameter = like(self)
        if parameter.is_meta:
            raise ValueError(
                "the model's parameters are on the meta device and have no values; build the model outside of "
                "`torch.device('meta')`, or call `to_empty(device='cpu')` and load weights"
            )
        reader = self.reader, parameter.dtype, parameter.device
        if isinstance(batch, Batch) and batch.reader == reader and not precise:
            return batch
        means = {name: units.filling for name, units in self.units.items()}
        # guide and model both read the batch
        wide = {name for name in self.units if name in self.wide or (precise and _is_wide(batch, name))}
        data = Batch(memoize(self, [batch], lambda: self.reader.read(batch, parameter, means, wide)))
        one = {name: data.pop(name) for name in self.shared if name in data and data[name].dim() == 1}
        size = next((len(value) for value in data.values() if isinstance(value, Tensor)), size)
        for name, spec in self.shared.items():
            if name not in data:
                distribution = spec.distribution(self.sizes[name], curriculum, like(self).device)
                value = one[name] if name in one else pyro.sample(name, distribution, infer=SHARED)
                data[name] = memoize(
                    self, [value, size], partial(self._expand_shared, value, size)
                )  # memoized for both
        data.reader = None if precise else reader
        return data

    def _expand_shared(self, value: Tensor, size: int) -> Tensor:
        return value.to(like(self)).expand(size, -1)

    def to_data_space(self, values: Mapping[str, Tensor], data: Batch | None = None) -> dict[str, Tensor]:
        """Map data variables that the model produced back to data space, through the inverse of the view.

        Args:
            values: dictionary from data variable to values (..., B, T, D) in the model's representation.
            data: the batch of these values, as returned by `read`. It contains inputs of the inverse, such as headings;
                without them, this part of the transformation is not inverted.

        Returns:
            The values in data space; if the view splits the data into parts, also the whole array.
        """
        added = {name: data[name] for name in self.view.names if name in data} if data else {}
        return {**values, **self.view.inverse(Batch(added | {n: v for n, v in values.items() if n in self.observed}))}


def _is_wide(batch: Any, name: str) -> bool:
    """Return whether float32 may not resolve a variable of a batch."""
    value = batch.get(name) if isinstance(batch, Mapping) else batch
    return value is not None and exceeds_float32(value.dtype)


def _locality(factorization: Factorization) -> dict[str, bool]:
    return {n: factorization.local(n) for n in (*factorization.variables, *factorization.context)}


def _note(factorization: Factorization, rollout: Rollout) -> Any:
    """Return the factorization and the run for a site's `infer` entry.

    Bounds read them to choose analytic KL terms and to average over draws.
    """
    return {"program": factorization, "run": rollout}


def _check_sizes(sizes: Mapping[str, int]) -> dict[str, int]:
    if not isinstance(sizes, Mapping):
        raise TypeError(f'sizes is {sizes!r}; expected the size of every variable by name, such as {{"z": 2, "x": 3}}')
    for name, size in sizes.items():
        if error := problem(f"the size of {name}", size, Annotated[int, Range(1, 2**20)]):
            raise error
    return dict(sizes)


def _density(conditional: Any) -> str:
    """Return the kind of log density of a factor in training: "exact", "bound" or "loss"."""
    head = conditional.head
    return "loss" if head.trained_as_loss else str(head.density)


def _by_factor(specs: Any, default: Any, label: str) -> dict[str, Any]:
    table = dict(specs) if isinstance(specs, Mapping) else {} if specs is None else {"default": specs}
    for key, spec in table.items():
        if isinstance(spec, type) or not hasattr(spec, "build"):
            text = kind_of(spec) if isinstance(spec, type) else repr(spec)
            raise ValueError(f"the {label} of {key!r} is {text}; expected a description such as {default!r}")
    return {"default": default, **table}
