"""What methods share that map a past to the latents of several futures, jointly, for the decoder of a fitted CVAE.

    p(x_t | x_{<t}, h, k, ...)

k = 1..K is the mode, one-hot context. A network of the observed poses h gives the CVAE's latent in each mode, and the
CVAE's decoder, whose weights stay as they are, makes the future. Energies compare the K futures of a window, which are
drawn together.

The weights of the decoder are part of the model. They are those of a run of `cvae` (`cvae_run`) on the same windows;
where none is given, one is fitted first, in as many steps as the run itself has, and not kept.

Sources: Yuan and Kitani, 2020, arXiv 1907.04967 and 2003.08386. Ours: a batch that says nothing of k has a mode at
random, and samples whose number is no multiple of K are whole sets and a random part of one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from reprlib import repr as brief
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...inference.training.checkpoints import CONFIG, CheckpointError, Run, at_most, load_weights
from ...inference.training.fit import fit
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...inference.training.trackers import Bar
from ...motion import HUMAN36M, HUMANEVA, Skeleton
from ...motion.data.protocols import Poses
from ...networks import Input, Network, NetworkSpec
from ...networks.base import perceptron
from ...networks.loop import once
from ...options import Size, flat
from ...program.batch import CHUNK, AnyBatch, repeat, rows
from ...program.rollout import Rollout
from ..baselines.cvae import CVAE, SummaryDecoder
from ..registry import configured
from .futures import HISTORY, FutureMethod, FutureModel, LastState

MODE, NOISE = "k", "e"
WHOLE_SETS = "sets"
"""Name in batches that are of every window in all modes, mode by mode, whose futures energies compare; all True."""
OF_CVAE = ("latent", "width", "hidden", "heading")
"""Options that are the CVAE's."""
SHAPE = (CVAE.latent, CVAE.width, CVAE.hidden)
"""Sizes among them, where there is no run."""


@dataclass(frozen=True)
class ModesMethod(FutureMethod):
    """A method that makes futures by the modes of a network, and a CVAE that was fitted before.

    Args:
        latent: size of the CVAE's latent; None, here and below, for that of the run, or of the CVAE's presets.
        width: units of the CVAE's recurrent networks.
        hidden: widths of the CVAE's perceptrons.
        modes: K, futures that are made together; None for 50 with the poses of Human3.6M and HumanEva, and for 10 with
            others.
        cvae_run: run directory of a fitted cvae; "" to fit one first, in as many steps as the run itself has.
        sampler_width: units of the recurrent network over the past whose last state the modes are read from.
        sampler_hidden: widths of the perceptron behind it.
    """

    inference = ""
    trainings: ClassVar[Mapping[str, Training]] = {
        **FutureMethod.trainings,
        **dict.fromkeys((HUMAN36M.name, HUMANEVA.name), Training(15_625, 32, 1e-4, 0.8)),
        "": Training(decay=0.5),
    }

    latent: Size | None = None
    width: Size | None = None
    hidden: tuple[Size, ...] | None = None
    modes: Size | None = None
    cvae_run: str = ""
    sampler_width: Size = 128
    sampler_hidden: tuple[Size, ...] = (1024, 512)

    @override
    def suited(self, data: Any) -> Self:
        """With the options that are left open chosen: the CVAE's by its run, if there is one.

        Raises:
            ValueError: a run of something else.
            CheckpointError: no run, or a damaged one.
        """
        if not self.cvae_run or all(getattr(self, name) is not None for name in OF_CVAE):
            return super().suited(data)
        cvae, *_ = _read(self.cvae_run)
        taken = self.filled({name: getattr(cvae, name) for name in OF_CVAE})
        return super(ModesMethod, taken).suited(data)

    @override
    def sizes(self) -> dict[str, int]:
        return {MODE: self.modes or 0}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        shape = (self.latent or 0, self.width or 0, self.hidden or (), self.sampler_width, self.sampler_hidden)
        return {"p(x)": ModesDecoder(*shape)}

    @override
    def described(self, sizes: Mapping[str, int]) -> dict[str, Any]:
        """With the prior for a guide."""
        return {**super().described(sizes), "inference": None}

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Minimises the energies of futures that are drawn together; the best weights are those of the lowest loss."""
        method = self.suited(train)
        prepare = partial(method.start, train=train, validation=validation, steps=steps)
        return Recipe(train, validation, [Stage(steps, method.objective())], 1.0, prepare)

    def start(self, model: ModesModel, train: Any, validation: Any, steps: int) -> None:
        """Has a model take the weights of the CVAE's decoder.

        Raises:
            ValueError: a run of something else, on other windows or with other options.
            CheckpointError: no run, or a damaged one.
        """
        cvae: Any = self._loaded(train) if self.cvae_run else self._fitted(train, validation, steps)
        model.generator[WHOLE].network.decoder.load_state_dict(cvae.generator[WHOLE].network.state_dict())
        model.generator[WHOLE].law.load_state_dict(cvae.generator[WHOLE].law.state_dict())

    def _loaded(self, windows: Any) -> FutureModel:
        path, (cvae, schema, model) = self.cvae_run, _read(self.cvae_run)
        ours, theirs = (dict(flat(each.windows.config())) for each in (Poses.of(windows, self.name), schema))
        if differing := [name for name in ours | theirs if ours.get(name) != theirs.get(name)]:
            values = (f"{name} is {brief(theirs.get(name))}, not {brief(ours.get(name))}" for name in differing)
            raise ValueError(
                f"the cvae of {path} was fitted on other windows: {'; '.join(islice(values, 3))}; fit one on these, "
                "by the same --data and --protocol"
            )
        for name in OF_CVAE:
            if getattr(cvae, name) != getattr(self, name):
                raise ValueError(
                    f"{name} is {getattr(self, name)}, but {path} was fitted with {getattr(cvae, name)}; leave it out, "
                    f"and {self.name} takes it from there"
                )
        load_weights(model, path)
        return model

    def _fitted(self, train: Any, validation: Any, steps: int) -> FutureModel:
        method = CVAE(**{name: getattr(self, name) for name in OF_CVAE})
        model, seed = method.build(train), int(torch.randint(2**31, ()))
        training = replace(method.training(train), steps=steps, seed=seed, progress=False)
        fit(model, method.train(train, validation, steps), trackers=[Bar("cvae", steps, True)], **vars(training))
        return model


def _read(path: str) -> tuple[CVAE, Poses, FutureModel]:
    """Options, schema and model of the run of a cvae; the weights are not its own yet."""
    run = Run(path)
    config, size = run.config, run.size()
    try:
        schema = {**config["schema"]}
        described, found = schema.pop("kind"), configured(config["method"])
        if described == Poses.kind and isinstance(found, CVAE) and found.components == 1:
            poses = Poses.from_config(schema)
            with at_most(size, f"{run.path / CONFIG}"):
                return found, poses, found.build(poses)
    except CheckpointError:
        raise
    except Exception as error:  # whatever stands in a file of somebody else's
        raise ValueError(f"{run.path / CONFIG} is none of a cvae: {str(error)[:200]}") from error
    raise ValueError(
        f"{path} holds no cvae whose latent is near N(0, I); fit one first, by `dvae fit cvae … --out {path}-cvae`"
    )


class ModesModel(FutureModel):
    """A model whose futures are made together, one in each mode.

    Rows of a batch that are one window in several modes have the same "group", and the noise in common.
    """

    extras: ClassVar[tuple[str, ...]] = (WHOLE_SETS,)
    forks: ClassVar[bool] = False

    def __init__(self, method: ModesMethod, frames: int, skeleton: Skeleton | None, **options: Any) -> None:
        super().__init__(method, frames, skeleton, **options)
        self.generator[WHOLE].requires_grad_(False)
        self.sampler.requires_grad_(True)

    @property
    def modes(self) -> int:
        """K."""
        return self.sizes[MODE]

    @property
    def sampler(self) -> Sampler:
        """The network of the modes."""
        found: Sampler = self.generator[WHOLE].network.sampler
        return found

    def in_modes(self, data: Batch, modes: Tensor) -> Batch:
        """What was read of B windows in each of these modes, mode by mode.

        Args:
            data: as `read` gives it.
            modes: (M,), from 0.

        Returns:
            Likewise, M B rows.
        """
        size = len(data[HISTORY])
        places = self._coded(modes.repeat_interleave(size), data[HISTORY])
        group = torch.arange(size, device=places.device).repeat(len(modes))
        return Batch(repeat(data, len(modes))) | {MODE: places, "group": group}

    def _coded(self, modes: Tensor, like: Tensor) -> Tensor:
        """(B, K), 1 at the mode of each row."""
        return torch.eye(self.modes, dtype=like.dtype, device=like.device).index_select(0, modes.to(like.device))

    def in_sets(self, batch: AnyBatch | None) -> Batch:
        """A batch of B windows in all modes, as `in_modes` has it, whose futures are to be compared."""

        def compute() -> Batch:
            read = self.read(batch)
            data = self.in_modes(read, torch.arange(self.modes, device=read[HISTORY].device))
            return data | {WHOLE_SETS: torch.ones_like(data.group, dtype=torch.bool)}

        return once(self.generator, [batch], compute)

    @override
    def model(
        self, batch: AnyBatch | None = None, *, draws: Mapping[str, int] | None = None, **options: Any
    ) -> dict[str, Tensor]:
        """The generative program, with `draws` of the mode in all modes at once."""
        return super().model(self.in_sets(batch) if draws else batch, **options)

    @override
    def guide(self, batch: AnyBatch, *, draws: Mapping[str, int] | None = None, **options: Any) -> dict[str, Tensor]:
        return super().guide(self.in_sets(batch) if draws else batch, **options)

    @override
    def rollout(
        self, batch: AnyBatch | None, length: int | None = None, size: int = 1, *, guide: bool = False
    ) -> Rollout:
        data = self.read(batch)
        if MODE in (self.inference if guide else self.generative).context and MODE not in data and HISTORY in data:
            history = data[HISTORY]
            drawn = torch.randint(self.modes, history.shape[:1], device=history.device)
            data = data | {MODE: self._coded(drawn, history)}
        rollout = super().rollout(data, length, size, guide=guide)
        return replace(rollout, draws=self.modes) if WHOLE_SETS in data else rollout

    @override
    def forecast(
        self,
        batch: AnyBatch,
        horizon: int,
        samples: int = 1,
        *,
        fix: Mapping[str, Tensor] | None = None,
        chunk: int = CHUNK,
        **options: Any,
    ) -> dict[str, Tensor]:
        """Sets of a future in each mode, one after the other; of the last set so many modes as are left, at random."""
        making = super().forecast

        def make(part: slice, modes: Tensor, count: int) -> dict[str, Tensor]:
            held = {name: repeat(rows(torch.as_tensor(v), part), len(modes)) for name, v in (fix or {}).items()}
            some = self.in_modes(rows(data, part), modes)
            return making(some, horizon, count, fix=held or None, chunk=chunk, **options)

        if isinstance(batch, Mapping) and MODE in batch:
            return making(batch, horizon, samples, fix=fix, chunk=chunk, **options)
        data = self.read(batch)
        return self._in_sets(make, data, samples, chunk)

    @override
    def reconstruct(self, batch: AnyBatch, samples: int = 1, *, chunk: int = CHUNK) -> dict[str, Tensor]:
        """Means of the data, of sets as in `forecast`."""
        making = super().reconstruct

        def make(part: slice, modes: Tensor, count: int) -> dict[str, Tensor]:
            return making(self.in_modes(rows(data, part), modes), count, chunk=chunk)

        if isinstance(batch, Mapping) and MODE in batch:
            return making(batch, samples, chunk=chunk)
        data = self.read(batch)
        return self._in_sets(make, data, samples, chunk)

    @torch.no_grad()
    def _in_sets(
        self,
        make: Callable[[slice, Tensor, int], Mapping[str, Tensor]],
        data: Batch,
        samples: int,
        chunk: int,
    ) -> dict[str, Tensor]:
        """What is made (n, M b, ...) of a slice of b windows in M modes, n times, as samples (S, B, ...) of all."""
        size, step = len(data[HISTORY]), max(chunk // self.modes, 1)
        whole, rest = divmod(samples, self.modes)
        sets = [(torch.arange(self.modes), whole)] if whole or not rest else []
        sets += [(torch.randperm(self.modes)[:rest], 1)] if rest else []

        def parts() -> Iterator[dict[str, Tensor]]:
            for first in range(0, max(size, 1), step):
                made = [(make(slice(first, first + step), modes, count), len(modes)) for modes, count in sets]
                apart = [{n: v.unflatten(1, (m, -1)).flatten(0, 1) for n, v in each.items()} for each, m in made]
                yield {name: torch.cat([each[name] for each in apart]) for name in apart[0]}

        found = list(parts())
        return {name: torch.cat([each[name] for each in found], 1) for name in found[0]}


@dataclass(frozen=True)
class ModesDecoder:
    """Features of x_t: those of a CVAE's decoder, whose latent a network of the past tells for each mode.

    It is a_k(h) e + b_k(h) where the factor reads a noise e, else b_k(h).

    Args:
        latent: size of the CVAE's latent.
        width, hidden: see `SummaryDecoder`.
        sampler_width: units of the recurrent network over the past.
        sampler_hidden: widths of the perceptron on its last state.
    """

    latent: int
    width: int
    hidden: tuple[int, ...]
    sampler_width: int
    sampler_hidden: tuple[int, ...]

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> ModesDecoderNetwork:
        """The network of a factor with these parents."""
        return ModesDecoderNetwork(self, inputs, size)


class ModesDecoderNetwork(Network):
    """What `ModesDecoder` describes."""

    code: ClassVar[str] = "w"

    def __init__(self, spec: ModesDecoder, inputs: Sequence[Input], size: int) -> None:
        read = {parent.name: parent for parent in inputs}
        given = [read[WHOLE], read[HISTORY], Input(self.code, spec.latent)]
        decoder = SummaryDecoder(spec.width, spec.hidden).build(given, True, size)
        super().__init__(inputs, True, decoder.features)
        self.noisy = NOISE in read
        self.sampler = Sampler(size, read[MODE].size, (1 + self.noisy) * spec.latent, spec)
        self.decoder = decoder

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        made: Tensor = self.decoder(self._coded(parents), length, lengths)
        return made

    @override
    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        return self.decoder.start(self._coded(given), batch, length, lengths)

    @override
    def step(self, state: Any, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        return self.decoder.step(state, t, drawn)

    def _coded(self, parents: Mapping[str, Tensor]) -> dict[str, Tensor]:
        modes = self.sampler(parents[HISTORY])
        chosen = parents[MODE].unflatten(0, (-1, len(modes)))
        found = torch.einsum("nrk,rkl->nrl", chosen, modes).flatten(0, 1)
        if self.noisy:
            scale, location = found.chunk(2, -1)
            found = scale * parents[NOISE] + location
        return {**parents, self.code: found}


class Sampler(nn.Module):
    """What the observed poses say of each mode.

    Args:
        size: D.
        modes: K.
        told: L, numbers of each mode.
        spec: with the widths.
    """

    def __init__(self, size: int, modes: int, told: int, spec: ModesDecoder) -> None:
        super().__init__()
        self.modes = modes
        self.past = LastState(size, spec.sampler_width)
        shape = (spec.sampler_width, *spec.sampler_hidden)
        self.behind, self.heads = perceptron(shape, "tanh"), nn.Linear(shape[-1], modes * told)

    def forward(self, history: Tensor) -> Tensor:
        """(R, K, L) from the past (N, O D).

        R is N, or N / K where the rows are the same R, K times over, of which once is enough.
        """

        def compute() -> Tensor:
            count, odd = divmod(len(history), self.modes)
            alike = not odd and torch.equal(history[count:], history[:-count])
            found: Tensor = self.heads(self.behind(self.past(history[:count] if alike else history)))
            return found.unflatten(1, (self.modes, -1))

        return once(self, [history], compute)
