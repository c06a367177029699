"""One factor of a factorization as a module: a network that reads the parents, and a distribution.

The features that the network returns are the parameters of the distribution, or are mapped to them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor, nn

from ..constants import constant
from ..data.units import Units
from ..distributions.base import DistributionSpec, Parameters, Shape, is_real
from ..distributions.chain import DERIVATIVES, gaussian_chain
from ..distributions.families import NormalModule
from ..distributions.precise import OffsetDistribution
from ..factorization.notation import Factor
from ..factorization.relations import ALL, NOW, PAST, Relation
from ..networks.base import Input, Network, NetworkSpec, indicator, presence
from ..networks.loop import Rows, at, extend_features, memoize, memoize_valid, select, shift, stack_steps, valid_steps
from .groups import Groups

CONSTANT = "1"
"""Name of the constant input to the network of a guide's factor without parents."""


@dataclass
class Standardised:
    """The state of a network's loop, with the standardised draws so far, and known factors (B, T, R) of the child."""

    network: Any
    kept: dict[str, Rows]
    lengths: Tensor | None
    factors: Tensor | None = None


@contextmanager
def evaluating(*modules: nn.Module) -> Iterator[None]:
    """Switch modules to eval mode for the length of a block."""
    training = [part for module in modules for part in module.modules() if part.training]
    for module in modules:
        module.eval()
    try:
        yield
    finally:
        for part in training:
            part.training = True


def like(module: nn.Module) -> Tensor:
    """Return any parameter or buffer of the module, which shows its dtype and device."""
    parts = [module]
    while parts:  # `parameters` visits all names, and a filter calls this function at each step
        part = parts.pop()
        if tensors := [tensor for tensor in part._parameters.values() if tensor is not None]:
            return tensors[0]
        parts += filter(None, part._modules.values())
    return next(module.buffers())


def joint_relation(factor: Factor) -> Relation:
    """Return the steps of the child that its value at t may depend on, if a factor draws all steps jointly.

    These are all steps s whose parents are parents at t too, so that the masks of the parents hold.

    Raises:
        ValueError: the factor is not p(x_{1:T} | ...), or it reads a parent at other steps than {1:T}, {<=t} or {<t}.
    """
    own, up_to_now = factor.parent(factor.child), PAST | NOW
    relations = {p.relation for p in factor.parents if p.local and p.name != factor.child}
    if own is None or own.relation != PAST or relations - {ALL, PAST, up_to_now}:
        raise ValueError(
            f"a distribution of all steps needs a factor such as {factor.kind}({factor.child}_{{1:T}} | h_{{1:T}}), or "
            f"{factor.kind}({factor.child}_t | {factor.child}_{{<t}}, h_{{<=t}}), with parents that are static or read "
            f"at {{1:T}}, {{<=t}} or {{<t}}; got {factor}"
        )
    return ALL if relations <= {ALL} else up_to_now


class Conditional(nn.Module):
    """A conditional distribution p(child | parents) or q(child | parents).

    Args:
        factor: the factor. Without parents, a generative factor has no network and a guide's factor reads a constant.
        sizes: dimension of every variable.
        network: description of the network.
        distribution: description of the distribution.
        generative: True for p, False for q.
        data: names of the data variables.
        guide: q(w | ...) of the same static latent, which some priors evaluate, such as `distributions.Vamp`.
        indicators: names of data that the network reads together with indicators: 1 where an entry was observed, else
            0.

    Raises:
        ValueError: if the network and the distribution do not fit together.

    Attributes:
        discrete, reparameterised: as the distribution declares (`ConditionalDistribution`).
        whole: whether all coordinates form one event (`ConditionalDistribution.event_dim`).
        joint: whether all steps are drawn jointly instead of from their own past, which is then not a parent.
    """

    interior_point: Tensor | None

    def __init__(
        self,
        factor: Factor,
        sizes: Mapping[str, int],
        network: NetworkSpec,
        distribution: DistributionSpec,
        generative: bool,
        data: tuple[str, ...] = (),
        guide: Conditional | None = None,
        indicators: Collection[str] = (),
    ):
        super().__init__()
        self.factor = factor
        self.size = sizes[factor.child]
        self.joint = getattr(distribution, "joint", False)
        read = [parent for parent in factor.parents if not (self.joint and parent.name == factor.child)]
        self.sizes = {parent.name: sizes[parent.name] for parent in read}
        self.indicators = [name for name in self.sizes if name in indicators]
        self.network: Network | None = None
        wide = {name: size * (1 + (name in self.indicators)) for name, size in self.sizes.items()}
        inputs = [Input(p.name, wide[p.name], p.relation if p.local else None) for p in read]
        if inputs or not generative:
            self.network = network.build(inputs or [Input(CONSTANT, 1)], factor.local, self.size)
            if self.network.head and not isinstance(distribution, self.network.head):
                expected = f"distributions.{self.network.head.__name__}"
                raise ValueError(
                    f"the network {network} of {factor} returns parameters of a {expected}, but the distribution is "
                    f"{distribution}; give the factor {expected}()"
                )
        features = 0 if self.network is None else self.network.features
        relation = joint_relation(factor) if self.joint else None
        self.head = distribution.build(Shape(self.size, features, factor.local, factor.child, data, guide, relation))
        self.parents = [parent.name for parent in read]
        self.units: dict[str, Units] = {}  # the model registers them
        self.exposure: tuple[str, Sequence[int]] | None = None
        self.discrete = self.head.discrete
        self.reparameterised = self.head.reparameterised and not self.head.discrete
        self.whole = self.head.event_dim == 1
        self.support = None if self.head.support is None or is_real(self.head.support) else self.head.support
        """Support of the values; None if it is the real line or depends on the parents."""
        self.events = [range(self.size)] if self.whole else self.head.events
        """Groups of coordinates; each group is one event and is observed as a whole."""
        self.register_buffer("interior_point", self.head.interior_point(self.size), persistent=False)
        self._is_checked = False  # whether a distribution was compared with its declaration
        for length in range(2, 9):
            self.check(length)

    def _check_declaration(self, distribution: TorchDistribution) -> None:
        """Check that a distribution matches the declaration of its `ConditionalDistribution`.

        Raises:
            ValueError: if its event shape or support differs.
        """
        event = (self.size,) if self.whole else ()
        if tuple(distribution.event_shape) != event or not (
            self.whole or distribution.batch_shape[-1:] == (self.size,)
        ):
            raise ValueError(
                f"the distribution of {self.factor} returns a {type(distribution).__name__} with batch shape "
                f"{tuple(distribution.batch_shape)} and event shape {tuple(distribution.event_shape)}; its event_dim = "
                f"{self.head.event_dim} requires the event shape {event}"
                + ("" if self.whole else f" and a batch shape that ends with {self.size}")
            )
        support: Any = None
        with suppress(NotImplementedError):  # some distributions have no support
            support = distribution.support
        if support is not None and not is_real(support):
            declared = self.head.support is None or not is_real(self.head.support)
            if not declared or support.is_discrete != self.discrete:
                raise ValueError(
                    f"the distribution of {self.factor} returns a {type(distribution).__name__} with the undeclared "
                    f"support {support}; declare it in the class of the distribution: support (of "
                    f"torch.distributions.constraints), and discrete = {support.is_discrete}"
                )
        self._is_checked = True

    def check(self, length: int) -> None:
        """Check that a residual distribution reads the child's previous value, at sequences of this length.

        Raises:
            ValueError: if the factor does not read the child's own value one step before.
        """
        previous = self.factor.parent(self.factor.child)
        if self.head.residual and not (previous and previous.relation and previous.relation.reads(-1, length)):
            raise ValueError(
                f"{self.factor} has a residual distribution, which adds {self.factor.child}_{{t-1}}, but it does not "
                f"read that at {length} steps; add {self.factor.child}_{{t-1}} or {self.factor.child}_{{<t}} to its "
                "parents, or use residual=0"
            )

    def scored(self, value: Tensor, counted: Tensor | None) -> Tensor:
        """Return the value (..., D) with a valid placeholder at entries that do not count.

        An uncounted entry may have no density, such as 0 for a positive variable, and its gradient would be NaN.

        Args:
            value: value of the child.
            counted: mask of the shape of `value`, or (...) for whole events.
        """
        if self.interior_point is None or counted is None:
            return value
        return torch.where(counted if counted.dim() == value.dim() else counted[..., None], value, self.interior_point)

    def forward(
        self,
        parents: Mapping[str, Tensor],
        batch: int,
        length: int,
        lengths: Tensor | None = None,
        groups: Groups | None = None,
    ) -> Parameters:
        """Return the parameters of the distribution at all steps, (B, T, D), or (B, D) for a static child.

        Args:
            parents: values of the parents by name, (B, T, D) or (B, D), with presence masks and indicators if any.
            batch: B.
            length: T.
            lengths: (B,) valid steps of a ragged batch.
            groups: groups of sequences that share the child; features are averaged over each group.
        """
        if self.joint:
            observed = self._observed_entries(parents.get(indicator(self.factor.child)), batch, length, lengths)
            return *self._forward(parents, batch, length, lengths, groups), observed
        return self._forward(parents, batch, length, lengths, groups)

    def _observed_entries(self, mask: Tensor | None, batch: int, length: int, lengths: Tensor | None) -> Tensor:
        """Return 1 at observed entries, 0 at missing ones and -1 at padding, (B, T, D)."""
        ones = like(self).new_ones(batch, length, self.size)
        observed = ones if mask is None else mask.to(ones)
        return observed if lengths is None else observed.where(valid_steps(lengths, length)[..., None], -ones)

    def _forward(
        self,
        parents: Mapping[str, Tensor],
        batch: int,
        length: int,
        lengths: Tensor | None,
        groups: Groups | None,
    ) -> Parameters:
        if self.network is None:
            shape = (batch, length, 0) if self.factor.local else (batch, 0)
            return self._rescale(self.head(like(self.head).new_empty(shape)))
        inputs = self._read(parents, batch, lengths)
        features = self.network(inputs, length, lengths)
        features = features if groups is None else groups.pool(features)
        previous = None
        if self.head.residual:
            previous = shift((parents if self._output_units is None else inputs)[self.factor.child], -1)
        return self._rescale(self.head(features, previous), self._factors(parents))

    def _factors(self, parents: Mapping[str, Tensor]) -> Tensor | None:
        """Return the known factors (B, T, R) of the child's scale or rate; None for none."""
        return None if self.exposure is None else parents[self.exposure[0]].exp()

    def _read(self, values: Mapping[str, Tensor], batch: int, lengths: Tensor | None) -> dict[str, Tensor]:
        """Return the parents, standardised and with their indicators; a constant if the factor has none."""
        if not self.parents:
            return {CONSTANT: next(self.parameters()).new_ones(batch, 1)}
        names = [*self.parents, *map(presence, self.parents)]
        inputs = {name: values[name] for name in names if name in values}
        inputs |= {n: memoize_valid(self.units[n], v, lengths) for n, v in inputs.items() if n in self.units}
        indicated = {
            n: self._append_indicators(inputs[n], values.get(indicator(n)), lengths)
            for n in self.indicators
            if n in inputs
        }
        return inputs | indicated

    def _append_indicators(self, value: Tensor, mask: Tensor | None, lengths: Tensor | None) -> Tensor:
        """Return the value, (B, T, D) or (B, D), with its indicators appended; these are 0 at padding."""

        def compute() -> Tensor:
            indicators = torch.ones_like(value) if mask is None else mask.to(value)
            if lengths is not None and value.dim() == 3:
                indicators = indicators * valid_steps(lengths, value.shape[1])[..., None]
            return torch.cat([value, indicators], -1)

        return memoize(self, [value, mask, lengths], compute)

    @property
    def _output_units(self) -> Units | None:
        """Units of the child, if the parameters of its distribution can be transformed to them."""
        units = self.units.get(self.factor.child)
        return None if units is None or not self.head.location_scale else units

    def _rescale(self, parameters: Parameters, factors: Tensor | None = None) -> Parameters:
        if parameters and torch.is_autocast_enabled(parameters[0].device.type):
            # networks may compute in half precision, but densities, divergences and draws must not
            parameters = tuple(parameter.to(like(self).dtype) for parameter in parameters)
        units = self._output_units
        if units is None:
            return parameters
        offset = self.offset
        mean = units.mean if offset is None else units.mean - offset
        scale = units.scale
        if self.exposure is not None and factors is not None:
            scale = scale.expand(*factors.shape[:-1], self.size).clone()
            scale[..., list(self.exposure[1])] *= factors.to(scale.dtype)
        return self.head.rescale(parameters, mean.to(units.scale.dtype), scale)

    @property
    def offset(self) -> Tensor | None:
        """Mean (D,) in float64 that is not part of the parameters; None if values are in the model's precision."""
        units = self._output_units
        if units is None or not units.wide or not self.head.centred:
            return None
        return units.mean if self.head.centred is True else units.mean * constant(self.head.centred, units.mean)

    def centred(self, value: Tensor) -> Tensor:
        """Return the value (..., D) of the child minus the offset, to match the parameters."""
        offset = self.offset
        return value if offset is None else (value - offset).to(like(self).dtype)

    def distribution(self, parameters: Parameters) -> TorchDistribution:
        """Return the distribution of the child for these parameters (`ConditionalDistribution.distribution`)."""
        distribution, offset = self.head.distribution(parameters), self.offset
        if not self._is_checked:
            self._check_declaration(distribution)
        return distribution if offset is None else OffsetDistribution(distribution, offset, parameters[0].dtype)

    def mean(self, parameters: Parameters) -> Tensor:
        """Return the mean of the child, (..., D)."""
        return self._add_offset(self.head.mean(parameters))

    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        """Return values (..., D) of the child computed from noise, as in `ConditionalDistribution.draw`."""
        return self._add_offset(self.head.draw(parameters, noise))

    @property
    def drawing(self) -> Callable[[Parameters, Tensor], Tensor]:
        """`draw` for use in a loop: the method of the distribution itself if values have no offset."""
        return self.head.draw if self.offset is None else self.draw

    def _add_offset(self, value: Tensor) -> Tensor:
        offset = self.offset
        return value if offset is None else value + offset

    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        """Return the initial state of a loop over time that draws the parents that `parents` omits.

        Args:
            parents: values of the other parents by name, (B, T, D) or (B, D).
            batch: B.
            length: T.
            lengths: (B,) valid steps of a ragged batch.
        """
        if self.joint:
            raise ValueError(
                f"{self.factor} draws all steps of {self.factor.child} jointly, but here they are drawn step by step; "
                "use a distribution of single steps, such as Diffusion(denoiser=None)"
            )
        if self.network is None:
            return tuple(p.unbind(1) for p in self(parents, batch, length))
        state = self.network.start(self._read(parents, batch, lengths), batch, length, lengths)
        # these are read from the draws, even if given
        child = self.factor.child if self.head.residual and self._output_units is not None else None
        live = [name for name in self.units if name in self.parents and (name not in parents or name == child)]
        factors = self._factors(parents) if self.exposure is None or self.exposure[0] in parents else None
        if not live and factors is None:
            return state
        return Standardised(state, {name: Rows([None] * length) for name in live}, lengths, factors)

    def step(
        self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]], count: int = 1
    ) -> tuple[Parameters, Any]:
        """Return the parameters (B, D) at step t and the next state of a loop over time.

        Args:
            state: result of `start` or of the previous step.
            t: index of the step, from 0.
            samples: {name: list with the values (B, D) of each step} of the variables that the loop draws.
            count: number of steps that the network evaluates at once, of which t is the last.
        """
        if self.network is None:
            return tuple(p[t] for p in state), state
        inner, inputs = self._standardise_draws(state, samples)
        if count > 1:
            features, inner = self.network.forward_last(inner, t + 1 - count, count, inputs)
        else:
            features, inner = self.network.step(inner, t, inputs)
        previous = None
        if self.head.residual:
            previous = at(
                (samples if self._output_units is None else inputs)[self.factor.child], t - 1, features, self.size
            )
        factors = state.factors[:, t] if isinstance(state, Standardised) and state.factors is not None else None
        if factors is None and self.exposure is not None:
            factors = samples[self.exposure[0]][t].exp()
        return self._rescale(self.head(features, previous, t), factors), self._with_network_state(state, inner)

    def forward_chunk(
        self, state: Any, t: int, count: int, samples: Mapping[str, Sequence[Tensor]]
    ) -> tuple[Parameters, Any]:
        """Return the parameters (B, N, D) at N steps whose inputs are all known, and the next state.

        Args:
            state: result of `start` or of the previous step.
            t: index of the first of these steps, from 0.
            count: N.
            samples: values (B, D) by step of the variables that the loop draws, by name.
        """
        if self.network is None:
            return tuple(torch.stack(p[t : t + count], dim=1) for p in state), state
        inner, inputs = self._standardise_draws(state, samples)
        features, inner = self.network.forward_chunk(inner, t, count, inputs)
        previous = None
        if self.head.residual:
            values = (samples if self._output_units is None else inputs)[self.factor.child]
            previous = stack_steps(values, t - 1, count, features, self.size)
        factors = state.factors if isinstance(state, Standardised) else None
        factors = None if factors is None else factors[:, t : t + count]
        return self._rescale(self.head(features, previous, t), factors), self._with_network_state(state, inner)

    def _standardise_draws(self, state: Any, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Any, Mapping[str, Any]]:
        """Return the state of the network, and the draws standardised as the network reads them."""
        if isinstance(state, Standardised):
            standardised = {
                n: extend_features(rows, samples[n], self.units[n], state.lengths) for n, rows in state.kept.items()
            }
            state, samples = state.network, {**samples, **standardised}
        indicated = {n: self._indicated(samples, n) for n in self.indicators if n in samples}
        return state, {**samples, **indicated} if indicated else samples

    @staticmethod
    def _indicated(samples: Mapping[str, Sequence[Tensor]], name: str) -> list[Any]:
        """Return draws with indicators of observed entries appended; a complete step has no mask."""
        masks, steps = samples[indicator(name)], list(samples[name])
        for s, value in enumerate(steps):
            if value is not None:
                steps[s] = torch.cat([value, torch.ones_like(value) if masks[s] is None else masks[s].to(value)], -1)
        return steps

    def select(self, state: Any, rows: Tensor | None) -> Any:
        """Return the state of a loop for the given rows (N,) of the batch, or a copy for None (`loop.select`)."""
        if self.network is None:
            return select(state, rows)
        if not isinstance(state, Standardised):
            return self.network.select(state, rows)
        kept, lengths, factors = select([state.kept, state.lengths, state.factors], rows)
        return Standardised(self.network.select(state.network, rows), kept, lengths, factors)

    @staticmethod
    def _with_network_state(state: Any, inner: Any) -> Any:
        """Return the state with the next state of the network."""
        if not isinstance(state, Standardised):
            return inner
        state.network = inner
        return state

    def chain(self, state: Any, direction: int, noise: Tensor) -> tuple[Tensor, Parameters] | None:
        """Return draws (B, T, D) and their parameters, computed by one fused loop for all steps.

        Args:
            state: result of `start`.
            direction: 1 if the loop runs forward in time, -1 if it runs backward.
            noise: standard normal noise (B, T, D) of the draws.

        Returns:
            Draws and parameters, or None if the factor is not a Gaussian chain.
        """
        if self.factor.child in self.units:
            return None
        form = None if self.network is None else self.network.chain(state)
        if form is None or form.lag != -direction or form.join.kind not in DERIVATIVES:
            return None
        if not isinstance(self.head, NormalModule) or self.head.residual:
            return None
        join, out = form.join, self.head.out
        batch, length, _ = noise.shape
        hoisted = form.hoisted if join.first else join.hoist(form.hoisted.known, batch, length, out)
        linear = [layer for layer in join.rest if isinstance(layer, nn.Linear)]
        following = [(layer.weight, layer.bias) for layer in ([*linear, out] if join.first else [])]

        def into(values: Tensor) -> Tensor:
            values = values.to(noise.dtype)  # under autocast, known terms have half precision, but the loop does not
            return values.transpose(0, 1) if direction > 0 else values.transpose(0, 1).flip(0)

        def back(values: Tensor) -> Tensor:
            return values.transpose(0, 1) if direction > 0 else values.flip(0).transpose(0, 1)

        with torch.autocast(noise.device.type, enabled=False):
            *results, states = gaussian_chain(
                into(hoisted.base),
                into(noise),
                [(hoisted.weights[0], None), *following],
                before=form.before,
                cell=None if form.cell is None else (into(form.cell[0]), form.cell[1]),
                min_scale=self.head.min_scale,
                activation=join.kind,
            )
        # elementwise operations on transposed tensors of few coordinates are not vectorised
        value, *parameters = (back(each).contiguous() for each in results)
        if form.keep is not None and states is not None:
            form.keep(value, back(states))
        return value, tuple(parameters)
