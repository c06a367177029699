"""One run of a factorization: what is known, and how the rest is drawn.

Teacher forcing, free running, forecasting, self-feeding and scoring are the same factors run with different things
known. A `Rollout` holds what is known in one run; every site of the Pyro program asks it for draws and conditionals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor, nn

from .conditional import Conditional
from .distributions import Sequence
from .heads import Parameters
from .networks.base import valid_steps
from .notation import Block, Factorization


@dataclass(frozen=True)
class SelfFeeding:
    """Scheduled sampling: frames of the data's history are replaced by the model's own means (Bengio et al., 2015).

    Args:
        probability: of each frame, independently.
        passes: None runs through time, exactly and without a gradient. A number of passes approximates that in
            parallel: in each, all means are computed at once from the last pass's history (T passes are exact).
    """

    probability: float
    passes: int | None = None


@dataclass
class Rollout:
    """A run of `factorization` over a batch.

    Args:
        factorization: what is run.
        conditionals: name to `Conditional`.
        batch, length: B and T.
        values: what is known: data, context, statics (B, D) and, as they become known, latents (B, T, D).
        data: names of the observed variables.
        lengths: (B,) valid steps of a ragged batch.
        observed: name to (B, T, D) True where an entry of the data was observed.
        prefix: name to (B, O, D) first values of a variable that is then drawn on.
        mean_emission: data variables are not drawn but set to their means.
        feeding: self-feeding of the data's history, or None.
    """

    factorization: Factorization
    conditionals: Mapping[str, Conditional]
    batch: int
    length: int
    values: dict[str, Tensor]
    data: frozenset[str] = frozenset()
    lengths: Tensor | None = None
    observed: Mapping[str, Tensor] = field(default_factory=dict)
    prefix: Mapping[str, Tensor] = field(default_factory=dict)
    mean_emission: bool = False
    feeding: SelfFeeding | None = None

    def __post_init__(self) -> None:
        self._block = {name: block for block in self.factorization.blocks for name in block.names}
        self._drawn: dict[str, Tensor] = {}
        self._evaluated: dict[str, tuple[Tensor, Parameters]] = {}
        self._history: dict[str, Tensor] | None = None
        self._valid = None if self.lengths is None else valid_steps(self.lengths, self.length)[..., None]

    def law(self, name: str) -> TorchDistribution:
        """The distribution of a variable, for its Pyro site."""
        conditional = self.conditionals[name]
        if conditional.factor.local:
            return Sequence(self, name)
        parameters = conditional(self.values, self.batch, self.length, self.lengths)
        return conditional.head.distribution(parameters).to_event(1)

    def know(self, name: str, value: Tensor) -> None:
        """Record the value of a site, which later sites read."""
        if name in self._drawn and not _same(value, self._drawn[name]):
            handed_out = self.values.keys() & self._drawn.keys() & set(self._block[name].names)
            dependants = sorted(handed_out - {name})
            if dependants:
                raise ValueError(
                    f"{name} was set to a value after {', '.join(dependants)} had been drawn along with another draw "
                    f"of it; pass {name} to the model as data instead of conditioning on it"
                )
        self.values[name] = value

    def mask(self, name: str) -> Tensor | None:
        """(B, T, 1 or D) True at the entries that count, or None if all do."""
        mask = self.observed.get(name)
        if self._valid is None:
            return mask
        valid = self._valid.expand(-1, -1, self.conditionals[name].size)
        return valid if mask is None else mask & valid

    def evaluate(self, name: str, value: Tensor) -> TorchDistribution:
        """The conditionals of a local variable at all steps, over (B, T, D)."""
        head = self.conditionals[name].head
        if name in self._evaluated and self._evaluated[name][0] is value:
            return head.distribution(self._evaluated[name][1])
        history = self.history()
        known = {**self.values, name: value, **history}
        return head.distribution(self.conditionals[name](known, self.batch, self.length, self.lengths))

    def draw(self, name: str) -> Tensor:
        """A draw (B, T, D) of a local variable, and with it of the variables that its loop interleaves it with."""
        if name not in self._drawn or any(
            not _same(self.values.get(other, value), value)
            for other, value in self._drawn.items()
            if other in self._block[name].names
        ):
            self._drawn.update(self._run(self._block[name]))
        return self._drawn[name]

    def history(self) -> dict[str, Tensor]:
        """What the model reads as the data's past: the data, or under self-feeding its mixture with own means."""
        if self.feeding is None or self.feeding.probability == 0:
            return {}
        if self._history is None:
            with torch.no_grad():
                frames = torch.rand(self.batch, self.length, 1, device=next(iter(self.values.values())).device)
                self._history = self._feed(frames < self.feeding.probability, self.feeding.passes)
        return self._history

    def _feed(self, frames: Tensor, passes: int | None) -> dict[str, Tensor]:
        fed: dict[str, Tensor] = {}
        for block in self.factorization.blocks:
            names = [name for name in block.names if name in self.data]
            if not names:
                continue
            if passes is None:
                fed.update(self._run(block, fed, frames))
                continue
            for _ in range(passes):
                known = {**self.values, **fed}
                for name in names:
                    mean = self.conditionals[name](known, self.batch, self.length, self.lengths)[0]
                    fed[name] = torch.where(frames, mean, self.values[name])
        return fed

    def _run(
        self, block: Block, fed: Mapping[str, Tensor] | None = None, frames: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Values of the unknown variables of a block; with `frames`, of its data, self-fed at those frames."""
        if frames is None:
            live = [name for name in block.names if name not in self.values]
        else:
            live = [name for name in block.names if name in self.data]
        given = {name: value for name, value in {**self.values, **(fed or {})}.items() if name not in live}
        loop = any(parent in live for name in live for parent in self.conditionals[name].parents)
        noise = {
            name: self.conditionals[name].head.noise(
                (self.batch, self.length, self.conditionals[name].size), _like(self.conditionals[name])
            )
            for name in live
            if frames is None and not (self.mean_emission and name in self.data)
        }
        if loop:
            return self._loop(block, live, given, noise, frames)
        drawn = {}
        for name in live:
            conditional = self.conditionals[name]
            parameters = conditional(given, self.batch, self.length, self.lengths)
            value = conditional.head.draw(parameters, noise[name]) if name in noise else parameters[0]
            if frames is not None:
                value = torch.where(frames, value, self.values[name])
            elif name in self.prefix:
                value = torch.cat([self.prefix[name], value[:, self.prefix[name].shape[1] :]], dim=1)
            drawn[name] = self._hide(value)
            if frames is None:
                self._evaluated[name] = (drawn[name], parameters)
        return drawn

    def _loop(
        self,
        block: Block,
        live: list[str],
        given: Mapping[str, Tensor],
        noise: Mapping[str, Tensor],
        frames: Tensor | None,
    ) -> dict[str, Tensor]:
        states = {name: self.conditionals[name].start(given, self.batch, self.length, self.lengths) for name in live}
        padded = self._valid is not None and block.direction < 0  # a backward loop meets the padding first
        if len(live) == 1 and frames is None and not padded and live[0] in noise and live[0] not in self.prefix:
            name = live[0]
            chain = self.conditionals[name].chain(states[name], block.direction, noise[name])
            if chain is not None:
                value = self._hide(chain[0])
                self._evaluated[name] = (value, chain[1])
                return {name: value}
        drawn: dict[str, list[Tensor]] = {name: [None] * self.length for name in live}  # type: ignore[list-item]
        evaluated: dict[str, list[Parameters]] = {name: [] for name in live}
        steps = {name: values.unbind(1) for name, values in noise.items()}
        prefix = {name: self.prefix[name].unbind(1) for name in live if name in self.prefix}
        order = range(self.length) if block.direction >= 0 else range(self.length - 1, -1, -1)
        for t in order:
            for name in live:
                conditional = self.conditionals[name]
                parameters, states[name] = conditional.step(states[name], t, drawn)
                evaluated[name].append(parameters)
                if name in prefix and t < len(prefix[name]):
                    value = prefix[name][t]
                elif name in steps:
                    value = conditional.head.draw(parameters, steps[name][t])
                else:
                    value = parameters[0]
                if frames is not None:
                    value = torch.where(frames[:, t], value, self.values[name][:, t])
                if padded:
                    value = value * self._valid[:, t]  # type: ignore[index]
                drawn[name][t] = value
        values = {name: self._hide(torch.stack(drawn[name], dim=1)) for name in live}
        if frames is None:
            for name in live:
                in_time = evaluated[name] if block.direction >= 0 else evaluated[name][::-1]
                stacked = tuple(torch.stack(p, dim=1) for p in zip(*in_time, strict=True))
                self._evaluated[name] = (values[name], stacked)
        return values

    def _hide(self, value: Tensor) -> Tensor:
        return value if self._valid is None else value * self._valid


def _same(value: Tensor, drawn: Tensor) -> bool:
    """Whether a site's value is the draw: Pyro may hand it back detached."""
    return value is drawn or torch.equal(value, drawn)


def _like(module: nn.Module) -> Tensor:
    """A tensor of the module's type and device."""
    for tensor in module.parameters():
        return tensor
    return next(module.buffers())
