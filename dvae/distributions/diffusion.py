"""Diffusion and flow matching: a denoiser maps noise to values, for one step, all steps at once, or a static variable.

    x = m + s u,        z_a = cos(a) u + sin(a) e,  e ~ N(0, I),        v = dz_a / da = cos(a) e - sin(a) u

The angle a is the noise level: 0 is the data, pi/2 is noise, and the log signal-to-noise ratio is 2 log cot(a). The
denoiser estimates v from z_a, the level and the features h (v-prediction; Salimans and Ho, 2022, arXiv 2202.00512).
The probability-flow ODE is then dz / da = v(z, a; h). If the denoiser returns 0, the distribution is N(m, s^2).

`Diffusion` has the bound of Kingma et al. (2021, arXiv 2107.00630). With the lowest level b, c = cos^2(b), and times t
that are uniform from 0 to 1, it is

    log p(u | h) >= -D/2 (log 2 pi + 1 - c - log c) - c |u|^2 / 2 + E[w (2 v . v(z) - |v(z)|^2)],    w = cot(a) da / dt

The paper's loss has w |v - v(z)|^2. Here the expectation of |v|^2 is in closed form, so that the estimate of the bound
has no variance if the denoiser returns 0. `FlowMatching` has the regression loss of Lipman et al. (2022, arXiv
2210.02747) with optimal-transport paths (1 - t) u + t e. At unit variance, they are the paths z_a with tan(a) =
t / (1 - t).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor, nn
from torch.distributions import Normal, constraints
from torch.nn import functional
from typing_extensions import override

from ..options import Count, Extra, Positive, Range, require
from .base import ConditionalDistribution, Parameters, Shape

GOLDEN = (math.sqrt(5) - 1) / 2
"""Step of the additive sequence of levels: the multiples of the golden ratio, modulo 1, have low discrepancy."""
FREQUENCIES = (1, 2, 4, 8)
"""Frequencies of the level's sines and cosines, which the denoiser reads."""
LEVEL_SIZE = 2 * len(FREQUENCIES)
RHO = 7
"""The sampler's steps are equal in tan(a)^(1 / RHO) (Karras et al., 2022, arXiv 2206.00364, equation 5)."""
EXACT_DIMENSION = 64
"""Largest number of coordinates for which `exact_log_prob` computes the trace exactly by default."""


class DenoiserSpec:
    """Base class of descriptions of a denoiser of all steps, such as `networks.Denoiser`."""

    def build(self, shape: Shape) -> nn.Module:
        """Return the module, whose arguments and result are those of `networks.denoising.SequenceDenoiser`."""
        raise NotImplementedError


@dataclass(frozen=True)
class Diffusion:
    """Variational diffusion model. `log_prob` is a stochastic lower bound, which `density` declares.

    By default, a perceptron denoises the variable at one step (or a static variable) given the features. With a
    `denoiser`, all steps are denoised jointly, for a factor p(x_{1:T} | h). Its parents must be static, or read at
    {1:T}, {<=t} or {<t}. The denoiser at step t then reads the noisy steps 1 to T, or 1 to t if a parent is restricted
    to the past.

    Without `drop`, m and s are linear functions of the features. Otherwise they do not depend on the features.

    Args:
        hidden: widths of the perceptron.
        denoiser: denoiser of all steps, such as `networks.Denoiser()`; None for the perceptron.
        schedule: "learned" is linear in the log signal-to-noise ratio, with learned ends; "cosine" is linear in the
            angle a, with fixed ends.
        log_snr: lowest and highest log signal-to-noise ratio, the initial ones if they are learned.
        shift: number added to the log signal-to-noise ratio of the cosine schedule between its ends; above 0, more
            times have little noise (Hoogeboom et al., 2023, arXiv 2301.11093).
        loss: what training minimises. "bound": minus the bound. "velocity": the squared error of v at the times of the
            schedule, minus the log density of N(m, s^2). It has more weight at high noise levels, so that draws are
            better and the bound is lower. Training then reports it as an energy; evaluation has the bound.
        steps: number of steps of the sampler.
        sampler: "ancestral", "ddim", "dpm" (DPM-Solver++(2M), Lu et al., 2022, arXiv 2211.01095: second order, with one
            evaluation a step), or "heun" (two evaluations a step).
        drop: probability that training hides the features of a sequence, for guidance; `log_prob` in training mode is
            then a bound of the marginal density for these sequences.
        guidance: weight g of the conditional v in draws, v_0 + g (v_h - v_0); 1 for none (Ho and Salimans, 2022,
            arXiv 2207.12598). Draws with another weight do not follow the density.
        min_scale: lower bound of the scale s.
        residual: share of the previous value, as in `ConditionalDistribution`.
    """

    hidden: tuple[int, ...] = (128, 128)
    denoiser: DenoiserSpec | None = None
    schedule: Literal["learned", "cosine"] = "learned"
    log_snr: tuple[float, float] = (-10.0, 10.0)
    shift: float = 0.0
    loss: Literal["bound", "velocity"] = "bound"
    steps: int = 40
    sampler: Literal["ancestral", "ddim", "dpm", "heun"] = "dpm"
    drop: float = 0.0
    guidance: float = 1.0
    min_scale: float = 1e-3
    residual: float = False

    @property
    def joint(self) -> bool:
        """Whether all steps are drawn jointly."""
        return self.denoiser is not None

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: an option is out of range or does not fit the variable.
        """
        require(Positive, min_scale=self.min_scale)
        if self.schedule not in ("learned", "cosine") or self.sampler not in ("ancestral", "ddim", "dpm", "heun"):
            raise ValueError(
                "a Diffusion has the schedule 'learned' or 'cosine' and the sampler 'ancestral', 'ddim', 'dpm' or "
                f"'heun', got schedule={self.schedule!r} and sampler={self.sampler!r}"
            )
        if self.loss not in ("bound", "velocity") or (self.loss == "velocity" and self.schedule == "learned"):
            raise ValueError(
                "a Diffusion has the loss 'bound', or 'velocity' with schedule='cosine', got "
                f"loss={self.loss!r} and schedule={self.schedule!r}"
            )
        if self.shift and self.schedule == "learned":
            raise ValueError(f"`shift` is {self.shift}, but a learned schedule has none; use schedule='cosine'")
        if not -MAX_LOG_SNR <= self.log_snr[0] < self.log_snr[1] <= MAX_LOG_SNR:
            raise ValueError(
                f"`log_snr` must be increasing and between -{MAX_LOG_SNR} and {MAX_LOG_SNR}, got {self.log_snr}"
            )
        return DiffusionModule(self, shape)


MAX_LOG_SNR = 16
"""Largest absolute log signal-to-noise ratio; at higher values, float32 does not resolve the noise."""


@dataclass(frozen=True)
class FlowMatching:
    """Continuous normalizing flow, trained by flow matching along optimal-transport paths.

    `log_prob` is minus a regression loss, without a relation to the density, which `density` declares: the loss is an
    energy of the model, the model has no bound, and only data can have this distribution. `exact_log_prob` of its
    Pyro distribution is the density.

    m is `residual` times the previous value, and s is `scale`; in units of the variable if it is standardised.

    Args:
        scale: the scale s, above 0.
        hidden, denoiser, steps, drop, guidance, residual: as in `Diffusion`.
        sampler: "ddim", "dpm" or "heun", as in `Diffusion`.
    """

    hidden: tuple[int, ...] = (128, 128)
    denoiser: DenoiserSpec | None = None
    steps: int = 40
    sampler: Literal["ddim", "dpm", "heun"] = "dpm"
    drop: float = 0.0
    guidance: float = 1.0
    scale: float = 1.0
    residual: float = False

    @property
    def joint(self) -> bool:
        """Whether all steps are drawn jointly."""
        return self.denoiser is not None

    def build(self, shape: Shape) -> ConditionalDistribution:
        """Return the module for a variable of this shape.

        Args:
            shape: the variable and its features.

        Raises:
            ValueError: an option is out of range or does not fit the variable.
        """
        if self.scale <= 0 or self.sampler not in ("ddim", "dpm", "heun"):
            raise ValueError(
                "FlowMatching needs a `scale` above 0 and the sampler 'ddim', 'dpm' or 'heun', got "
                f"scale={self.scale} and sampler={self.sampler!r}"
            )
        return FlowMatchingModule(self, shape)


class DenoisingModule(ConditionalDistribution):
    """Base class of the modules of `Diffusion` and `FlowMatching`.

    Its parameters are the location m (..., D), the scale s (..., D) and the features h (..., H). If all steps are
    drawn jointly, a further parameter (B, T, D) is 1 at observed entries, 0 at missing ones and -1 at padding. The
    denoiser then has a density for the entries that are 1, and ignores all others.
    """

    location_scale = True
    centred = True

    def __init__(self, spec: Any, shape: Shape):
        super().__init__(spec.residual)
        if not isinstance(spec.hidden, tuple):
            raise TypeError(f"`hidden` is {spec.hidden!r}; expected a tuple of widths, such as (128, 128)")
        require(Count, steps=spec.steps)
        require(Annotated[float, Range(0, 1, below=True)], drop=spec.drop)
        if spec.guidance != 1 and not spec.drop:
            raise ValueError(
                f"guidance={spec.guidance} needs an unconditional denoiser; set `drop` above 0, such as drop=0.1"
            )
        if spec.drop and (not shape.features or spec.residual):
            raise ValueError(
                f"drop={spec.drop} hides the parents of {shape.name}, which has "
                f"{'the parent that `residual` adds' if spec.residual else 'no parents'}; use drop=0"
            )
        if spec.joint and not isinstance(spec.denoiser, DenoiserSpec):
            raise TypeError(f"`denoiser` is {spec.denoiser}; expected a description such as networks.Denoiser(network)")
        if spec.joint and (shape.relation is None or spec.residual):
            raise ValueError(
                f"a {type(spec).__name__} with a `denoiser` denoises all steps jointly, but {shape.name} "
                f"{'has a residual' if spec.residual else 'is not the only variable of a factor p(x_{1:T} | ...)'}; "
                "use denoiser=None"
            )
        self.spec, self.joint_steps, self.guidance = spec, spec.joint, spec.guidance
        self.event_dim = 0 if spec.joint else 1
        self.denoiser: Any = spec.denoiser.build(shape) if spec.joint else StepDenoiser(spec.hidden, shape)
        self.hidden_features = nn.Parameter(torch.zeros(shape.features)) if spec.drop else None

    def angle(self, t: Tensor) -> Tensor:
        """Return the angle a (...) at times t (...) from 0, the data, to 1."""
        raise NotImplementedError

    def sampler_angles(self, t: Tensor) -> Tensor:
        """Return the angle a (...) of the sampler at t (...), the share of its steps that remain, from 1 to 0."""
        return self.angle(t)

    def score(self, parameters: Parameters, value: Tensor) -> Tensor:
        """Return the contribution (..., D) of each entry of values (..., D) to `log_prob` of the Pyro distribution."""
        raise NotImplementedError

    @override
    def distribution(self, parameters: Parameters) -> DenoisingDistribution:
        return DenoisingDistribution(self, parameters)

    @override
    def mean(self, parameters: Parameters) -> Tensor:
        """Return the estimate of the mean (..., D): the denoised value if the observation is pure noise."""
        loc, scale, features, *steps = parameters
        angle = self.angle(loc.new_ones(())).expand(self._level_shape(loc))
        return torch.addcmul(loc, scale, -angle.sin() * self.denoiser(torch.zeros_like(loc), angle, features, *steps))

    @override
    def draw(self, parameters: Parameters, noise: Tensor) -> Tensor:
        loc, scale, features, *steps = parameters
        spec, z = self.spec, noise
        levels = self.sampler_angles(torch.linspace(1, 0, spec.steps + 1, dtype=loc.dtype, device=loc.device))

        def denoised(z: Tensor, angle: Tensor) -> Tensor:
            angle = angle.expand(self._level_shape(z))
            v = self.denoiser(z, angle, features, *steps)
            if spec.guidance != 1:
                hidden = self.hidden_features.expand_as(features)  # type: ignore[union-attr]
                v = torch.lerp(self.denoiser(z, angle, hidden, *steps), v, spec.guidance)
            return angle.cos() * z - angle.sin() * v

        earlier = torch.zeros_like(z)
        for before, after, share in zip(levels[:-1], levels[1:], _extrapolation(levels), strict=True):
            u = denoised(z, before)
            if spec.sampler == "ancestral":
                kept = (after.tan() / before.tan()).square()
                mean = after.cos() * (kept / before.cos() * z + (1 - kept) * u)
                z = mean + after.sin() * (1 - kept).sqrt() * torch.randn_like(z)
                continue
            estimate, earlier = (u + share * (u - earlier) if spec.sampler == "dpm" else u), u
            next_z = _toward(z, estimate, before, after)
            if spec.sampler == "heun":
                next_z = _toward(z, (u + denoised(next_z, after)) / 2, before, after)
            z = next_z
        if spec.sampler == "ancestral":
            z = z + levels[-1].sin() * torch.randn_like(z)
        return torch.addcmul(loc, scale, z / levels[-1].cos())

    def perturb(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return times (..., 1) from 0 to 1 for values u (..., D), and noise (..., D).

        Times of different elements have low discrepancy, and each is uniform. Steps that are drawn jointly have the
        same time, (..., 1, 1).

        Raises:
            ValueError: the values have half precision.
        """
        if torch.finfo(u.dtype).bits < 32:
            raise ValueError(
                f"a {self.label} does not support half precision, got {u.dtype}; keep float32 weights and fit with "
                "precision='bf16-mixed' or '32-true'"
            )
        shape = self._level_shape(u)
        index = torch.arange(math.prod(shape), dtype=torch.float64, device=u.device)
        times = (torch.rand((), dtype=torch.float64, device=u.device) + GOLDEN * index) % 1
        return times.to(u.dtype).reshape(shape), torch.randn_like(u)

    def _level_shape(self, z: Tensor) -> tuple[int, ...]:
        return (*z.shape[:-2], 1, 1) if self.joint_steps else (*z.shape[:-1], 1)

    def _estimate(self, parameters: Parameters, value: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return u, v and its estimate, (..., D) each, at random times, and the times."""
        loc, scale, features, *steps = parameters
        u = (value - loc) / scale
        times, noise = self.perturb(u)
        angle = self.angle(times)
        cos, sin = angle.cos(), angle.sin()
        if self.training and self.hidden_features is not None:
            rows = (len(features), *[1] * (features.dim() - 1))
            is_hidden = torch.rand(rows, device=features.device) < self.spec.drop
            features = torch.where(is_hidden, self.hidden_features, features)
        guess = self.denoiser(cos * u + sin * noise, angle, features, *steps)
        return u, cos * noise - sin * u, guess, times

    def exact_log_prob(self, parameters: Parameters, value: Tensor, steps: int, probes: int | None) -> ODEDensity:
        """Return the density by the probability-flow ODE, as `DenoisingDistribution.exact_log_prob` does."""
        loc, scale, features, *seen = parameters
        counted = (seen[0] > 0).to(loc.dtype) if seen else torch.ones_like(loc)
        event = 2 if self.joint_steps else 1
        if probes is None:
            probes = 0 if math.prod(value.shape[-event:]) <= EXACT_DIMENSION else 16
        levels = self.angle(torch.linspace(0, 1, steps + 1, dtype=loc.dtype, device=loc.device)).unbind()
        shrink = levels[0].cos()
        z = torch.where(counted > 0, shrink * (value - loc) / scale, 0.0).detach()
        directions = torch.randint(0, 2, (probes, *z.shape), device=z.device).to(z.dtype) * 2 - 1

        def velocity(z: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
            z = z.detach().requires_grad_()
            with torch.enable_grad():
                v = counted * self.denoiser(z, angle.expand(self._level_shape(z)), features, *seen)
                return v.detach(), _divergence(v, z, directions, event)

        log_det = loc.new_zeros(max(probes, 1), *z.shape[:-event])
        for before, after in pairwise(levels):
            h, middle = after - before, (before + after) / 2
            v1, d1 = velocity(z, before)
            v2, d2 = velocity(z + h / 2 * v1, middle)
            v3, d3 = velocity(z + h / 2 * v2, middle)
            v4, d4 = velocity(z + h * v3, after)
            z = z + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
            log_det = log_det + h / 6 * (d1 + 2 * d2 + 2 * d3 + d4)
        each = counted * (-0.5 * (z.square() + math.log(2 * math.pi)) - scale.log() + shrink.log())
        log_probs = each.sum(tuple(range(-event, 0))) + log_det
        error = torch.full_like(log_probs[0], 0.0 if probes == 0 else math.nan)
        if probes > 1:
            error = log_probs.std(0) / math.sqrt(probes)
        return ODEDensity(log_probs.mean(0).detach(), error.detach())


class DiffusionModule(DenoisingModule):
    """Distribution module of `Diffusion`."""

    density = "bound"

    def __init__(self, spec: Diffusion, shape: Shape):
        super().__init__(spec, shape)
        self.trained_as_loss = spec.loss == "velocity"
        low, high = spec.log_snr
        ends = torch.tensor([-high, -low])
        if spec.schedule == "learned":
            self.ends: Tensor = nn.Parameter(ends)
        else:
            self.register_buffer("ends", ends)
        self.out = self.projection(0 if spec.drop else shape.features, 2 * shape.size, shape.size)

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        loc, raw = self.out(features).chunk(2, dim=-1)
        scale = functional.softplus(raw.contiguous()) + self.spec.min_scale
        return self.add_residual(loc, previous), scale, features

    @property
    def noise_range(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest value of minus the log signal-to-noise ratio."""
        low, high = self.ends.clamp(-MAX_LOG_SNR, MAX_LOG_SNR).unbind()
        return low, high

    @override
    def angle(self, t: Tensor) -> Tensor:
        if self.spec.schedule == "learned":
            return (torch.lerp(*self.noise_range, t) / 2).exp().atan()
        low, high = self._shifted_range()
        return (math.exp(-self.spec.shift / 2) * torch.lerp(low, high, t).tan()).atan()

    @override
    def sampler_angles(self, t: Tensor) -> Tensor:
        low, high = ((end / 2 / RHO).exp() for end in self.noise_range)
        return (torch.lerp(low, high, t) ** RHO).atan()

    def weight(self, t: Tensor) -> Tensor:
        """Return w = cot(a) da / dt at times t (...)."""
        if self.spec.schedule == "learned":
            low, high = self.noise_range
            return torch.sigmoid(-torch.lerp(low, high, t)) * (high - low) / 2
        low, high = self._shifted_range()
        double = torch.sin(2 * torch.lerp(low, high, t))  # of the angle without the shift
        return 2 * (high - low) * self.angle(t).cos().square() / double

    def _shifted_range(self) -> tuple[Tensor, Tensor]:
        """Return the lowest and highest angle of the cosine schedule without its shift."""
        low, high = ((end + self.spec.shift) / 2 for end in self.noise_range)
        return low.exp().atan(), high.exp().atan()

    @override
    def score(self, parameters: Parameters, value: Tensor) -> Tensor:
        if self.present_density == "loss":
            loc, scale, *others = parameters
            _, v, guess, _ = self._estimate((loc.detach(), scale.detach(), *others), value)
            normal = Normal(loc, scale, validate_args=False)  # without reading values of a GPU
            return normal.log_prob(value) - (v - guess).square()
        u, v, guess, times = self._estimate(parameters, value)
        signal = torch.sigmoid(-self.noise_range[0])  # cos^2 of the lowest angle
        constant = math.log(2 * math.pi) + 1 - signal - signal.log()
        return self.weight(times) * guess * (2 * v - guess) - (signal * u.square() + constant) / 2 - parameters[1].log()


class FlowMatchingModule(DenoisingModule):
    """Distribution module of `FlowMatching`."""

    density = "loss"
    like: Tensor

    def __init__(self, spec: FlowMatching, shape: Shape):
        super().__init__(spec, shape)
        self.size = shape.size

    @override
    def forward(self, features: Tensor, previous: Tensor | None = None, t: int | None = None) -> Parameters:
        loc = features.new_zeros(*features.shape[:-1], self.size)
        return self.add_residual(loc, previous), torch.full_like(loc, self.spec.scale), features

    @override
    def angle(self, t: Tensor) -> Tensor:
        return torch.atan2(t, 1 - t)

    @override
    def score(self, parameters: Parameters, value: Tensor) -> Tensor:
        _, v, guess, times = self._estimate(parameters, value)
        angle = self.angle(times)
        # the derivative of the path, e - u, is (sin a - cos a) z + (cos a + sin a) v
        return -((angle.cos() + angle.sin()) * (v - guess)).square()


class ODEDensity(NamedTuple):
    """A log density and its standard error."""

    log_prob: Tensor
    standard_error: Tensor


class DenoisingDistribution(TorchDistribution):
    """Distribution of values that a denoiser generates: batch shape (...), event shape (D,).

    If all steps are drawn jointly, the batch shape is (B, T, D), and `log_prob` returns additive shares of one bound
    for all entries, not conditional densities.

    Args:
        module: module of the distribution.
        parameters: result of its `forward`.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    has_rsample = True

    def __init__(self, module: DenoisingModule, parameters: Parameters):
        self.module, self.parameters = module, parameters
        shape = parameters[0].shape
        end = len(shape) - module.event_dim
        super().__init__(shape[:end], shape[end:], validate_args=False)

    @constraints.dependent_property(is_discrete=False)
    def support(self) -> constraints.Constraint:
        """Real vectors, or real numbers if all steps are drawn jointly."""
        return constraints.independent(constraints.real, self.module.event_dim)

    @property
    def density(self) -> str:
        """What `log_prob` returns, as in `ConditionalDistribution.present_density`."""
        return self.module.present_density

    def log_prob(self, value: Tensor) -> Tensor:
        """Return what `density` declares, of the batch shape, for values (..., D); random."""
        shape = torch.broadcast_shapes(value.shape, self.batch_shape + self.event_shape)
        entries = self.module.score(self._expanded(shape[:-1]), value.expand(shape))
        return entries.sum(-1) if self.module.event_dim else entries

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Return draws (*sample_shape, *batch_shape, D), differentiable with respect to the parameters."""
        shape, like = self._extended_shape(torch.Size(sample_shape)), self.parameters[0]
        noise = torch.randn(shape, dtype=like.dtype, device=like.device)
        return self.module.draw(self._expanded(shape[:-1]), noise)

    @torch.no_grad()
    def exact_log_prob(self, value: Tensor, steps: int = 50, probes: int | None = None) -> ODEDensity:
        """Return the log density by the probability-flow ODE. Guidance is ignored.

        Draws follow this density, but those of "ancestral" only if the denoiser is optimal.

        Args:
            value: values (..., D).
            steps: number of steps of the solver (Runge-Kutta of order 4).
            probes: number of random directions of Hutchinson's estimate of the trace; 0 for the exact trace, which
                needs one backward pass per coordinate. None is exact for up to 64 coordinates, 16 probes above.

        Returns:
            Log density (...) and standard error (...) over the directions, 0 for an exact trace, NaN for one direction.
            If all steps are drawn jointly, both are (B,), for all observed steps.

        Raises:
            ValueError: when `steps` is below 1, or `probes` below 0.
        """
        require(Count, steps=steps)
        require(Extra, probes=probes or 0)
        return self.module.exact_log_prob(self.parameters, value, steps, probes)

    def expand(self, batch_shape: Any, _instance: object = None) -> DenoisingDistribution:
        """Return the distribution with another batch shape."""
        shape = torch.Size(batch_shape) + self.event_shape
        return DenoisingDistribution(self.module, self._expanded(shape[:-1]))

    def _expanded(self, batch_shape: torch.Size) -> Parameters:
        return tuple(each.expand(*batch_shape, each.shape[-1]) for each in self.parameters)


class StepDenoiser(nn.Module):
    """Perceptron from a noisy value, the level and features to an estimate of v.

    Args:
        hidden: widths of the layers.
        shape: the variable and its features.
    """

    def __init__(self, hidden: tuple[int, ...], shape: Shape):
        super().__init__()
        widths = [shape.size + LEVEL_SIZE + shape.features, *hidden]
        layers = [[nn.Linear(a, b), nn.GELU()] for a, b in pairwise(widths)]
        self.layers = nn.Sequential(*(part for layer in layers for part in layer))
        self.out = small_linear(widths[-1], shape.size)

    def forward(self, z: Tensor, angle: Tensor, features: Tensor) -> Tensor:
        """Return v (..., D) for z (..., D), angles (..., 1) and features (..., H)."""
        levels = embed_level(angle).expand(*z.shape[:-1], -1)
        v: Tensor = self.out(self.layers(torch.cat([z, levels, features], -1)))
        return v.to(z.dtype)


def embed_level(angle: Tensor) -> Tensor:
    """Return sines and cosines (..., 8) of multiples of the log signal-to-noise ratio of angles (..., 1)."""
    tangent = angle.tan().abs()  # negative for pi / 2, whose float32 is above pi / 2
    ratio = torch.log(tangent.clamp(1e-4, 1e4)) / math.log(1e4) * (math.pi / 4)
    return torch.cat([f(k * ratio) for k in FREQUENCIES for f in (torch.sin, torch.cos)], -1)


def small_linear(features: int, size: int) -> nn.Linear:
    """Return a linear layer with small weights, so that the initial distribution is almost normal."""
    layer = nn.Linear(features, size)
    with torch.no_grad():
        layer.weight.mul_(0.01)
        layer.bias.mul_(0.01)
    return layer


def _toward(z: Tensor, u: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Return z at a lower level if u is the denoised value: cos(b) u + sin(b) / sin(a) (z - cos(a) u)."""
    return after.cos() * u + after.sin() / before.sin() * (z - before.cos() * u)


def _extrapolation(levels: Tensor) -> Tensor:
    """Return how far DPM-Solver++(2M) extrapolates the denoised values at each step, 0 at the first.

    Args:
        levels: angles (steps + 1,), decreasing.
    """
    noise = levels.sin().log() - levels.cos().abs().log()  # infinite at 0, large at pi / 2
    drops = noise.diff()
    shares = functional.pad(drops[1:] / (2 * drops[:-1]), (1, 0))
    return torch.where(shares.isfinite(), shares, 0.0)


def _divergence(v: Tensor, z: Tensor, directions: Tensor, event: int) -> Tensor:
    """Return the divergence of v (..., D) at z, one per direction (S, ...), summed over the last `event` dimensions.

    Args:
        v: function of z.
        z: point (..., D).
        directions: random signs (S, ..., D) for Hutchinson's estimate; S = 0 for the exact divergence, (1, ...).
        event: number of dimensions of an event, which other events do not influence.
    """

    def slope(target: Tensor) -> Tensor:
        return torch.autograd.grad(target, z, retain_graph=True)[0].detach()

    dims = tuple(range(-event, 0))
    if len(directions):
        return torch.stack([(slope((v * e).sum()) * e).sum(dims) for e in directions])
    flat, total = v.flatten(-event), v.new_zeros(v.shape[:-event])
    for i in range(flat.shape[-1]):
        total = total + slope(flat[..., i].sum()).flatten(-event)[..., i]
    return total.detach()[None]
