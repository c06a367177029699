"""One factor of a factorization as a module: a network on the parents, a law of its features."""

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
from ..distributions.base import LawSpec, Parameters, Shape, is_real
from ..distributions.chain import DERIVATIVES, gaussian_chain
from ..distributions.families import NormalLaw
from ..distributions.precise import Offset
from ..factorization.notation import Factor
from ..networks.base import Input, Network, NetworkSpec, indicator, presence
from ..networks.loop import Rows, at, follow, once, once_valid, over, select, shift, valid_steps
from .groups import Groups

CONSTANT = "1"
"""What the network of a guide's factor without parents reads."""


@dataclass
class Standardised:
    """The state of a network's loop, and the draws so far without unit."""

    network: Any
    kept: dict[str, Rows]
    lengths: Tensor | None


@contextmanager
def evaluating(*modules: nn.Module) -> Iterator[None]:
    """eval() for the length of a block."""
    training = [part for module in modules for part in module.modules() if part.training]
    for module in modules:
        module.eval()
    try:
        yield
    finally:
        for part in training:
            part.training = True


def like(module: nn.Module) -> Tensor:
    """A tensor of the module's type and device."""
    for tensor in module.parameters():
        return tensor
    return next(module.buffers())


class Conditional(nn.Module):
    """p(child | parents) or q(child | parents).

    Args:
        factor: the factor. Without parents a generative one has no network; a guide's reads a constant.
        sizes: dimension of every variable.
        network, law: descriptions of the two parts.
        generative: p rather than q.
        data: names of the data variables.
        guide: of a static latent without parents its q(w | ...), which some priors are made of.
        indicators: names of data that the network reads with their indicators beside them: 1 where an entry was
            observed, 0 where not.

    Raises:
        ValueError: a network and a law that do not go together.

    Attributes:
        discrete, reparameterised, whole: as the law declares (`Law.discrete`, `Law.event_dim`).
    """

    inside: Tensor | None

    def __init__(
        self,
        factor: Factor,
        sizes: Mapping[str, int],
        network: NetworkSpec,
        law: LawSpec,
        generative: bool,
        data: tuple[str, ...] = (),
        guide: Conditional | None = None,
        indicators: Collection[str] = (),
    ):
        super().__init__()
        self.factor = factor
        self.size = sizes[factor.child]
        self.sizes = {parent.name: sizes[parent.name] for parent in factor.parents}
        self.indicators = [name for name in self.sizes if name in indicators]
        self.network: Network | None = None
        wide = {name: size * (1 + (name in self.indicators)) for name, size in self.sizes.items()}
        inputs = [Input(p.name, wide[p.name], p.relation if p.local else None) for p in factor.parents]
        if inputs or not generative:
            self.network = network.build(inputs or [Input(CONSTANT, 1)], factor.local, self.size)
            if self.network.law and not isinstance(law, self.network.law):
                expected = f"distributions.{self.network.law.__name__}"
                raise ValueError(
                    f"the features of {factor} by {network} are the parameters of a {expected}, but its law is {law}; "
                    f"give it {expected}()"
                )
        features = 0 if self.network is None else self.network.features
        self.law = law.build(Shape(self.size, features, factor.local, factor.child, data, guide))
        self.parents = [parent.name for parent in factor.parents]
        self.units: dict[str, Units] = {}  # not registered here: they are the model's
        self.discrete = self.law.discrete
        self.reparameterised = self.law.reparameterised and not self.law.discrete
        self.whole = self.law.event_dim == 1
        self.support = None if self.law.support is None or is_real(self.law.support) else self.law.support
        """Where its values are, if that is somewhere in particular and the same whatever the parents."""
        self.events = [range(self.size)] if self.whole else self.law.events
        """Coordinates that are one event each, and observed together."""
        self.register_buffer("inside", self.law.inside(self.size), persistent=False)
        self._seen = False  # whether the law has made a distribution, which was as declared
        for length in range(2, 9):
            self.check(length)

    def _declared(self, law: TorchDistribution) -> None:
        """Refuse a distribution that is not as its law declares.

        Raises:
            ValueError: another event, or another support.
        """
        event = (self.size,) if self.whole else ()
        if tuple(law.event_shape) != event or not (self.whole or law.batch_shape[-1:] == (self.size,)):
            raise ValueError(
                f"the law of {self.factor} makes a {type(law).__name__} of batch {tuple(law.batch_shape)} and event "
                f"{tuple(law.event_shape)}; by its event_dim = {self.law.event_dim} it has "
                + (f"the event {event}" if self.whole else f"no event, and the last dimension {self.size} in its batch")
            )
        support: Any = None
        with suppress(NotImplementedError):  # a distribution that says nothing of its support
            support = law.support
        if support is not None and not is_real(support):
            declared = self.law.support is None or not is_real(self.law.support)
            if not declared or support.is_discrete != self.discrete:
                raise ValueError(
                    f"the law of {self.factor} makes a {type(law).__name__} on {support}; declare it in the class of "
                    f"the law: support (of torch.distributions.constraints), and discrete = {support.is_discrete}"
                )
        self._seen = True

    def check(self, length: int) -> None:
        """Refuses a residual law that reads what the factor does not, at sequences of this length.

        Raises:
            ValueError: the factor does not read the child's own value a step before.
        """
        own = self.factor.parent(self.factor.child)
        if self.law.residual and not (own and own.relation and own.relation.reads(-1, length)):
            raise ValueError(
                f"{self.factor} has a residual law, which adds {self.factor.child}_{{t-1}}, but it does not read that "
                f"at {length} steps; add {self.factor.child}_{{t-1}} or {self.factor.child}_{{<t}} to its parents, or "
                "use residual=0"
            )

    def scored(self, value: Tensor, counted: Tensor | None) -> Tensor:
        """The value (..., D) with any other that has a density at entries that do not count.

        What stands there may have none, as 0 of a positive variable, and its gradient would be NaN.

        Args:
            value: of the child.
            counted: as the value, or (...) of whole events.
        """
        if self.inside is None or counted is None:
            return value
        return torch.where(counted if counted.dim() == value.dim() else counted[..., None], value, self.inside)

    def forward(
        self,
        parents: Mapping[str, Tensor],
        batch: int,
        length: int,
        lengths: Tensor | None = None,
        groups: Groups | None = None,
    ) -> Parameters:
        """The law's parameters at all steps, (B, T, D), or (B, D) for a static child, of which groups share one."""
        if self.network is None:
            shape = (batch, length, 0) if self.factor.local else (batch, 0)
            return self._in_units(self.law(like(self.law).new_empty(shape)))
        read = self._read(parents, batch, lengths)
        features = self.network(read, length, lengths)
        features = features if groups is None else groups.pooled(features)
        previous = None
        if self.law.residual:
            previous = shift((parents if self._made_in is None else read)[self.factor.child], -1)
        return self._in_units(self.law(features, previous))

    def _read(self, values: Mapping[str, Tensor], batch: int, lengths: Tensor | None) -> dict[str, Tensor]:
        """The parents among `values`, without unit and with their indicators, or a constant in place of none."""
        if not self.parents:
            return {CONSTANT: next(self.parameters()).new_ones(batch, 1)}
        read = [*self.parents, *map(presence, self.parents)]
        found = {name: values[name] for name in read if name in values}
        found |= {n: once_valid(self.units[n], v, lengths) for n, v in found.items() if n in self.units}
        told = {n: self._indicated(found[n], values.get(indicator(n)), lengths) for n in self.indicators if n in found}
        return found | told

    def _indicated(self, value: Tensor, seen: Tensor | None, lengths: Tensor | None) -> Tensor:
        """The value (B, T, D), or (B, D), with its indicators behind it; 0 at padding."""

        def compute() -> Tensor:
            told = torch.ones_like(value) if seen is None else seen.to(value)
            if lengths is not None and value.dim() == 3:
                told = told * valid_steps(lengths, value.shape[1])[..., None]
            return torch.cat([value, told], -1)

        return once(self, [value, seen, lengths], compute)

    @property
    def _made_in(self) -> Units | None:
        """The units that the law's parameters are put into, where these can be."""
        return self.units.get(self.factor.child) if self.law.location_scale else None

    def _in_units(self, parameters: Parameters) -> Parameters:
        if parameters and torch.is_autocast_enabled(parameters[0].device.type):
            # networks may compute in half precision, but not densities, divergences and draws
            parameters = tuple(parameter.to(like(self).dtype) for parameter in parameters)
        units = self._made_in
        if units is None:
            return parameters
        offset = self.offset
        mean = units.mean if offset is None else units.mean - offset
        return self.law.in_units(parameters, mean.to(units.scale.dtype), units.scale)

    @property
    def offset(self) -> Tensor | None:
        """(D,) the mean of values in float64, less which the parameters are; None where values are as the model is."""
        units = self._made_in
        if units is None or not units.wide or not self.law.centred:
            return None
        return units.mean if self.law.centred is True else units.mean * constant(self.law.centred, units.mean)

    def centred(self, value: Tensor) -> Tensor:
        """The value (..., D) of the child less the offset, as the parameters are."""
        offset = self.offset
        return value if offset is None else (value - offset).to(like(self).dtype)

    def distribution(self, parameters: Parameters) -> TorchDistribution:
        """The distribution of the child, see `Law.distribution`."""
        law, offset = self.law.distribution(parameters), self.offset
        if not self._seen:
            self._declared(law)
        return law if offset is None else Offset(law, offset, parameters[0].dtype)

    def mean(self, parameters: Parameters) -> Tensor:
        """The mean of the child (..., D)."""
        return self._placed(self.law.mean(parameters))

    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        """Values (..., D) of the child, see `Law.draw`."""
        return self._placed(self.law.draw(parameters, noise))

    @property
    def drawing(self) -> Callable[[Parameters, Tensor], Tensor]:
        """`draw`, for a loop: the law's own where values have no offset."""
        return self.law.draw if self.offset is None else self.draw

    def _placed(self, value: Tensor) -> Tensor:
        offset = self.offset
        return value if offset is None else value + offset

    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        """The state before a loop that draws those of the parents that are not `given`."""
        if self.network is None:
            return tuple(p.unbind(1) for p in self(given, batch, length))
        state = self.network.start(self._read(given, batch, lengths), batch, length, lengths)
        # read from the draws, given or not
        own = self.factor.child if self.law.residual and self._made_in is not None else None
        live = [name for name in self.units if name in self.parents and (name not in given or name == own)]
        if not live:
            return state
        return Standardised(state, {name: Rows([None] * length) for name in live}, lengths)

    def step(self, state: Any, t: int, drawn: Mapping[str, Sequence[Tensor]], count: int = 1) -> tuple[Parameters, Any]:
        """The law's parameters (B, D) at step t, the last of so many that are taken at once, and the next state."""
        if self.network is None:
            return tuple(p[t] for p in state), state
        inner, read = self._without_unit(state, drawn)
        if count > 1:
            features, inner = self.network.reach(inner, t + 1 - count, count, read)
        else:
            features, inner = self.network.step(inner, t, read)
        previous = None
        if self.law.residual:
            previous = at((drawn if self._made_in is None else read)[self.factor.child], t - 1, features, self.size)
        return self._in_units(self.law(features, previous, t)), self._advanced(state, inner)

    def stretch(self, state: Any, t: int, count: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Parameters, Any]:
        """The law's parameters (B, N, D) at N steps from t on, where what they read is known, and the next state."""
        if self.network is None:
            return tuple(torch.stack(p[t : t + count], dim=1) for p in state), state
        inner, read = self._without_unit(state, drawn)
        features, inner = self.network.stretch(inner, t, count, read)
        previous = None
        if self.law.residual:
            own = (drawn if self._made_in is None else read)[self.factor.child]
            previous = over(own, t - 1, count, features, self.size)
        return self._in_units(self.law(features, previous, t)), self._advanced(state, inner)

    def _without_unit(self, state: Any, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Any, Mapping[str, Any]]:
        """The state of the network, and the draws as it reads them."""
        if not isinstance(state, Standardised):
            return state, drawn
        found = {n: follow(rows, drawn[n], self.units[n], state.lengths) for n, rows in state.kept.items()}
        return state.network, {**drawn, **found}

    def select(self, state: Any, rows: Tensor) -> Any:
        """The state with these rows (N,) of its batch (see `rows.select`)."""
        if self.network is None:
            return select(state, rows)
        if not isinstance(state, Standardised):
            return self.network.select(state, rows)
        kept, lengths = select([state.kept, state.lengths], rows)
        return Standardised(self.network.select(state.network, rows), kept, lengths)

    @staticmethod
    def _advanced(state: Any, inner: Any) -> Any:
        """The state with the network's next one."""
        if not isinstance(state, Standardised):
            return inner
        state.network = inner
        return state

    def chain(self, state: Any, direction: int, noise: Tensor) -> tuple[Tensor, Parameters] | None:
        """Draws (B, T, D) and their parameters by one fused loop, where the factor is a Gaussian chain; else None."""
        if torch.is_autocast_enabled(noise.device.type):  # the fused loop runs in one precision
            return None
        if self.factor.child in self.units:
            return None
        form = None if self.network is None else self.network.chain(state)
        if form is None or form.lag != -direction or form.join.kind not in DERIVATIVES:
            return None
        if not isinstance(self.law, NormalLaw) or self.law.residual:
            return None
        join, out = form.join, self.law.out
        batch, length, _ = noise.shape
        hoisted = form.hoisted if join.first else join.hoist(form.hoisted.known, batch, length, out)
        linear = [layer for layer in join.rest if isinstance(layer, nn.Linear)]
        following = [(layer.weight, layer.bias) for layer in ([*linear, out] if join.first else [])]

        def into(values: Tensor) -> Tensor:
            return values.transpose(0, 1) if direction > 0 else values.transpose(0, 1).flip(0)

        def back(values: Tensor) -> Tensor:
            return values.transpose(0, 1) if direction > 0 else values.flip(0).transpose(0, 1)

        *drawn, states = gaussian_chain(
            into(hoisted.base),
            into(noise),
            [(hoisted.weights[0], None), *following],
            before=form.before,
            cell=None if form.cell is None else (into(form.cell[0]), form.cell[1]),
            min_scale=self.law.min_scale,
            activation=join.kind,
        )
        value, *parameters = map(back, drawn)
        if form.keep is not None and states is not None:
            form.keep(value, back(states))
        return value, tuple(parameters)
