"""Base of the methods that map a past to latents of several futures at once, for the decoder of a fitted CVAE.

    p(x_t | x_{<t}, h, k, ...)

k = 1..K is the mode, a one-hot context. A network of the observed poses h returns the CVAE's latent in each mode. The
CVAE's decoder, with frozen weights, predicts the future. The K futures of a window are drawn together, and energies
compare them.

The weights of the decoder are part of the model. They are from a run of `cvae` (`cvae_run`) on the same windows.
Without such a run, a CVAE is fitted first, with the same number of steps, and not saved.

Sources: Yuan and Kitani, 2020, arXiv 1907.04967 and 2003.08386. Our choices: a batch without k has random modes. If the
number of samples is not a multiple of K, the last set is incomplete and has random modes.
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

from ...capture import is_deferring
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
from ...networks.loop import memoize, store_result
from ...options import Size, flat
from ...program.batch import CHUNK, AnyBatch, repeat, rows
from ...program.groups import Groups
from ...program.rollout import Rollout
from ..baselines.cvae import CVAE, SummaryDecoder
from ..registry import configured
from .futures import HISTORY, FutureMethod, FutureModel, LastState

MODE, NOISE = "k", "e"
WHOLE_SETS = "sets"
"""Key of batches, with value True, that contain every window in all modes, mode by mode; energies compare the modes."""
OF_CVAE = ("latent", "width", "hidden", "heading")
"""Options of `ModesMethod` that are options of the CVAE."""
SHAPE = (CVAE.latent, CVAE.width, CVAE.hidden)
"""Sizes of the CVAE if there is no run."""


@dataclass(frozen=True)
class ModesMethod(FutureMethod):
    """A method that predicts futures by a network with K modes and the decoder of a fitted CVAE.

    Args:
        latent: size of the CVAE's latent; None, here and below, for the value of the run or of the CVAE's presets.
        width: units of the CVAE's recurrent networks.
        hidden: widths of the CVAE's perceptrons.
        modes: K, number of futures drawn together; by default 50 for Human3.6M and HumanEva, and 10 for other poses.
        cvae_run: run directory of a fitted cvae; "" to fit one first, with the same number of steps.
        sampler_width: units of the recurrent network over the past.
        sampler_hidden: widths of the perceptron on the last state of this network.
    """

    inference = ""
    trainings: ClassVar[Mapping[str, Training]] = {
        **FutureMethod.trainings,
        **dict.fromkeys((HUMAN36M.name, HUMANEVA.name), Training(15_625, 32, 1e-4, 0.8, gradient_clip=None)),
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
    def resolve_defaults(self, data: Any) -> Self:
        """Return the method with unset options chosen; a run of the CVAE determines the CVAE's options.

        Raises:
            ValueError: if the run is not of a cvae.
            CheckpointError: if the run does not exist or is damaged.
        """
        if not self.cvae_run or all(getattr(self, name) is not None for name in OF_CVAE):
            return super().resolve_defaults(data)
        cvae, *_ = _read_run(self.cvae_run)
        method = self.with_presets({name: getattr(cvae, name) for name in OF_CVAE})
        return super(ModesMethod, method).resolve_defaults(data)

    @override
    def sizes(self) -> dict[str, int]:
        return {MODE: self.modes or 0}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        shape = (self.latent or 0, self.width or 0, self.hidden or (), self.sampler_width, self.sampler_hidden)
        return {"p(x)": ModesDecoder(*shape)}

    @override
    def model_arguments(self, sizes: Mapping[str, int]) -> dict[str, Any]:
        """Return the arguments, with the prior as the guide."""
        return {**super().model_arguments(sizes), "inference": None}

    @override
    def train(self, train: Any, validation: Any = None, steps: int = 2000) -> Recipe:
        """Return one stage on the energies of futures drawn together; the best weights have the lowest loss."""
        method = self.resolve_defaults(train)
        prepare = partial(method.start, train=train, validation=validation, steps=steps)
        return Recipe(train, validation, [Stage(steps, method.objective())], 1.0, prepare)

    def start(self, model: ModesModel, train: Any, validation: Any, steps: int) -> None:
        """Load the weights of the decoder from a run of a CVAE into a model, or fit a CVAE first if there is no run.

        Args:
            model: model of this method.
            train: training windows.
            validation: validation windows, or None.
            steps: number of steps to fit a CVAE.

        Raises:
            ValueError: if the run is not of a cvae, or has other windows or options.
            CheckpointError: if the run does not exist or is damaged.
        """
        cvae: Any = self._load_cvae(train) if self.cvae_run else self._fit_cvae(train, validation, steps)
        model.generator[WHOLE].network.decoder.load_state_dict(cvae.generator[WHOLE].network.state_dict())
        model.generator[WHOLE].head.load_state_dict(cvae.generator[WHOLE].head.state_dict())

    def _load_cvae(self, windows: Any) -> FutureModel:
        path, (cvae, schema, model) = self.cvae_run, _read_run(self.cvae_run)
        current, recorded = (dict(flat(poses.windows.config())) for poses in (Poses.of(windows, self.name), schema))
        if differing := [name for name in current | recorded if current.get(name) != recorded.get(name)]:
            values = (f"{name} is {brief(recorded.get(name))}, not {brief(current.get(name))}" for name in differing)
            raise ValueError(
                f"the cvae of {path} was fitted on other windows: {'; '.join(islice(values, 3))}; fit one on these "
                "windows, with the same --data and --protocol"
            )
        for name in OF_CVAE:
            if getattr(cvae, name) != getattr(self, name):
                raise ValueError(
                    f"{name} is {getattr(self, name)}, but {path} was fitted with {getattr(cvae, name)}; leave it out: "
                    f"{self.name} reads it from the run"
                )
        load_weights(model, path)
        return model

    def _fit_cvae(self, train: Any, validation: Any, steps: int) -> FutureModel:
        method = CVAE(**{name: getattr(self, name) for name in OF_CVAE})
        model, seed = method.build(train), int(torch.randint(2**31, ()))
        training = replace(method.training(train), steps=steps, seed=seed, progress=False)
        fit(model, method.train(train, validation, steps), trackers=[Bar("cvae", steps, True)], **vars(training))
        return model


def _read_run(path: str) -> tuple[CVAE, Poses, FutureModel]:
    """Return options, schema and model of the run of a cvae; the weights are not loaded yet."""
    run = Run(path)
    config, size = run.config, run.size()
    try:
        schema = {**config["schema"]}
        kind, method = schema.pop("kind"), configured(config["method"])
        if kind == Poses.kind and isinstance(method, CVAE) and method.components == 1:
            poses = Poses.from_config(schema)
            with at_most(size, f"{run.path / CONFIG}"):
                return method, poses, method.build(poses)
    except CheckpointError:
        raise
    except Exception as error:  # a file from elsewhere may contain anything
        raise ValueError(f"{run.path / CONFIG} is not the configuration of a cvae: {str(error)[:200]}") from error
    raise ValueError(
        f"{path} is not a run of a cvae with prior N(0, I); fit one first, with `dvae fit cvae … --out {path}-cvae`"
    )


class ModesModel(FutureModel):
    """A model whose futures are drawn together, one in each mode.

    Rows of a batch that are one window in several modes have the same "group" and share the noise.
    """

    extras: ClassVar[tuple[str, ...]] = (WHOLE_SETS,)
    forks: ClassVar[bool] = False

    def __init__(self, method: ModesMethod, frames: int, skeleton: Skeleton | None, **options: Any) -> None:
        super().__init__(method, frames, skeleton, **options)
        self.generator[WHOLE].requires_grad_(False)
        self.sampler.requires_grad_(True)

    @property
    def modes(self) -> int:
        """K, number of modes."""
        return self.sizes[MODE]

    @property
    def sampler(self) -> Sampler:
        """The network that returns the latents of all modes."""
        sampler: Sampler = self.generator[WHOLE].network.sampler
        return sampler

    def in_modes(self, data: Batch, modes: Tensor) -> Batch:
        """Return data of B windows in each of the given modes, mode by mode.

        Args:
            data: data returned by `read`.
            modes: indices of M modes, (M,), from 0.

        Returns:
            Data of M B rows.
        """
        size = len(data[HISTORY])
        codes = self._one_hot(modes.repeat_interleave(size), data[HISTORY])
        windows = torch.arange(size, device=codes.device)
        group = windows.repeat(len(modes))
        count = torch.full_like(group, len(modes))
        # known here; to find either in the values would synchronise with a GPU
        store_result(self.reader, [group], Groups(group, windows, count))
        repeated = Batch(repeat(data, len(modes)))
        store_result(self.sampler.heads, [repeated[HISTORY]], len(modes) == self.modes)
        return repeated | {MODE: codes, "group": group}

    def _one_hot(self, modes: Tensor, like: Tensor) -> Tensor:
        """Return one-hot codes (B, K) of modes (B,), with the type and device of `like`."""
        return torch.eye(self.modes, dtype=like.dtype, device=like.device).index_select(0, modes.to(like.device))

    def in_sets(self, batch: AnyBatch | None) -> Batch:
        """Return a batch of B windows in all modes, as `in_modes` does; energies compare the futures of a window."""

        def compute() -> Batch:
            windows = self.read(batch)
            data = self.in_modes(windows, torch.arange(self.modes, device=windows[HISTORY].device))
            return data | {WHOLE_SETS: torch.ones_like(data.group, dtype=torch.bool)}

        return memoize(self.generator, [batch], compute)

    @override
    def model(
        self, batch: AnyBatch | None = None, *, draws: Mapping[str, int] | None = None, **options: Any
    ) -> dict[str, Tensor]:
        """Run the generative program; with `draws` of the mode, in all modes at once."""
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
            modes = torch.randint(self.modes, history.shape[:1], device=history.device)
            data = data | {MODE: self._one_hot(modes, history)}
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
        """Return whole sets of futures, one per mode; an incomplete last set has random modes."""
        base_forecast = super().forecast

        def make(part: slice, modes: Tensor, count: int) -> dict[str, Tensor]:
            fixed = {name: repeat(rows(torch.as_tensor(v), part), len(modes)) for name, v in (fix or {}).items()}
            inputs = self.in_modes(rows(data, part), modes)
            return base_forecast(inputs, horizon, count, fix=fixed or None, chunk=chunk, **options)

        if isinstance(batch, Mapping) and MODE in batch:
            return base_forecast(batch, horizon, samples, fix=fix, chunk=chunk, **options)
        data = self.read(batch)
        return self._in_sets(make, data, samples, chunk)

    @override
    def reconstruct(self, batch: AnyBatch, samples: int = 1, *, chunk: int = CHUNK) -> dict[str, Tensor]:
        """Return the means of x given latents of the guide, K samples for each mode, as in `forecast`."""
        base_reconstruct = super().reconstruct

        def make(part: slice, modes: Tensor, count: int) -> dict[str, Tensor]:
            return base_reconstruct(self.in_modes(rows(data, part), modes), count, chunk=chunk)

        if isinstance(batch, Mapping) and MODE in batch:
            return base_reconstruct(batch, samples, chunk=chunk)
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
        """Return samples (S, B, ...) of all windows in all modes, computed in chunks of windows.

        Args:
            make: function of a slice of b windows, M modes and a number of draws n, which returns values (n, M b, ...)
                by name.
            data: data of the B windows.
            samples: S. If it is not a multiple of the number of modes, the last samples are of random modes.
            chunk: largest number of windows times modes at once.
        """
        size, step, device = len(data[HISTORY]), max(chunk // self.modes, 1), data[HISTORY].device
        n_full, n_rest = divmod(samples, self.modes)
        sets = [(torch.arange(self.modes, device=device), n_full)] if n_full or not n_rest else []
        sets += [(torch.randperm(self.modes, device=device)[:n_rest], 1)] if n_rest else []

        def parts() -> Iterator[dict[str, Tensor]]:
            for first in range(0, max(size, 1), step):
                outputs = [(make(slice(first, first + step), modes, count), len(modes)) for modes, count in sets]
                per_set = [
                    {n: v.unflatten(1, (m, -1)).flatten(0, 1) for n, v in output.items()} for output, m in outputs
                ]
                yield {name: torch.cat([output[name] for output in per_set]) for name in per_set[0]}

        chunks = list(parts())
        return {name: torch.cat([output[name] for output in chunks], 1) for name in chunks[0]}


@dataclass(frozen=True)
class ModesDecoder:
    """Features of x_t from a CVAE's decoder, whose latent is a function of the past for each mode.

    The latent is a_k(h) e + b_k(h) if the factor reads a noise e, otherwise b_k(h).

    Args:
        latent: size of the CVAE's latent.
        width, hidden: widths as in `SummaryDecoder`.
        sampler_width: units of the recurrent network over the past.
        sampler_hidden: widths of the perceptron on its last state.
    """

    latent: int
    width: int
    hidden: tuple[int, ...]
    sampler_width: int
    sampler_hidden: tuple[int, ...]

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> ModesDecoderNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return ModesDecoderNetwork(self, inputs, size)


class ModesDecoderNetwork(Network):
    """Network of `ModesDecoder`."""

    code: ClassVar[str] = "w"

    def __init__(self, spec: ModesDecoder, inputs: Sequence[Input], size: int) -> None:
        parents = {parent.name: parent for parent in inputs}
        decoder_inputs = [parents[WHOLE], parents[HISTORY], Input(self.code, spec.latent)]
        decoder = SummaryDecoder(spec.width, spec.hidden).build(decoder_inputs, True, size)
        super().__init__(inputs, True, decoder.features)
        self.noisy = NOISE in parents
        self.sampler = Sampler(size, parents[MODE].size, (1 + self.noisy) * spec.latent, spec)
        self.decoder = decoder

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        features: Tensor = self.decoder(self._with_code(parents), length, lengths)
        return features

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        return self.decoder.start(self._with_code(parents), batch, length, lengths)

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        return self.decoder.step(state, t, samples)

    def _with_code(self, parents: Mapping[str, Tensor]) -> dict[str, Tensor]:
        modes = self.sampler(parents[HISTORY])
        one_hot = parents[MODE].unflatten(0, (-1, len(modes)))
        codes = torch.einsum("nrk,rkl->nrl", one_hot, modes).flatten(0, 1)
        if self.noisy:
            scale, location = codes.chunk(2, -1)
            codes = scale * parents[NOISE] + location
        return {**parents, self.code: codes}


class Sampler(nn.Module):
    """Network from the observed poses to the parameters of each mode.

    Args:
        size: D, size of a pose.
        modes: K, number of modes.
        parameters: L, number of parameters of each mode.
        spec: specification with the widths.
    """

    def __init__(self, size: int, modes: int, parameters: int, spec: ModesDecoder) -> None:
        super().__init__()
        self.modes = modes
        self.past = LastState(size, spec.sampler_width)
        shape = (spec.sampler_width, *spec.sampler_hidden)
        self.behind, self.heads = perceptron(shape, "tanh"), nn.Linear(shape[-1], modes * parameters)

    def forward(self, history: Tensor) -> Tensor:
        """Return the parameters (R, K, L) of the modes from the past (N, O D).

        R is N, or N / K if the rows repeat the same R rows K times.
        """

        def compute() -> Tensor:
            count, remainder = divmod(len(history), self.modes)

            def is_equal() -> bool:
                return not (remainder or is_deferring()) and torch.equal(history[count:], history[:-count])

            is_repeated = memoize(self.heads, [history], is_equal)  # `in_modes` stores it
            parameters: Tensor = self.heads(self.behind(self.past(history[:count] if is_repeated else history)))
            return parameters.unflatten(1, (self.modes, -1))

        return memoize(self, [history], compute)
