"""Posterior of latents given observations: its mode and a normal approximation there, for all sequences in parallel.

    w* = argmax log p(w, seen),    p(w | seen) ~ N(w*, H^-1),    H = -d2 log p(w*, seen) / dw dw

A Pyro program defines the observations. Its sequences are independent, so the sum of their energies E = -log p has the
gradient of each. Sequences and starts are the rows of one batch, whose energies Adam minimises. The curvatures of all
rows need as many backward passes as a row has numbers; the last steps are Newton steps that use them. If E is
quadratic, these steps and the normal are exact; otherwise the normal is Laplace's approximation.

The result reports for each row whether the search has converged (`left`), whether starts agree (`behind`), and whether
the normal is reliable (`bent`, and k-hat of `evidence`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from math import ceil
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from pyro import poutine
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel

from ...locking import seeded, serialized
from ...options import Count, Delay, Positive, Size, check
from ...program.batch import repeat, rows
from ..bounds.elbo import IWAEBound, importance_mean
from ..evaluation.result import progress_bar
from .latents import Values, joined, split

_Program = Callable[[Any], Any]


@dataclass(frozen=True)
class Descent:
    """Options of the search for a mode.

    Args:
        steps: number of steps of Adam.
        rate: initial learning rate; it falls to 0 along a cosine.
        starts: S, number of starts for each sequence; the lowest result is kept.
        candidates: number of draws from the prior, and from the guide if there is one. These draws, and the mean of the
            draws from the prior, are divided among the starts. Each start is the most probable candidate of its part.
        renewed: number of steps between calls of `renew`.
        newton: number of Newton steps at the end, each with its own curvature.

    Raises:
        ValueError: an option is out of range, or there are more starts than candidates.

    Example:
        >>> quick = dvae.Descent(steps=50, starts=2)
    """

    steps: Count = 400
    rate: Positive = 0.05
    starts: Size = 4
    candidates: Size = 16
    renewed: Count = 10
    newton: Delay = 2

    def __post_init__(self) -> None:
        check(self)
        if self.starts > self.candidates:
            raise ValueError(f"{self.starts} starts need at least as many candidates, got {self.candidates}")


@dataclass(frozen=True)
class Posterior:
    """Modes of B sequences, and normal approximations there.

    Args:
        mode: most probable value (B, ...) of each latent.
        energy: -log p(w*, seen), in nats, (B,).
        energies: energies that the starts reached, the lowest first, before Newton steps, (S, B).
        course: energies during the search from the start that reached the lowest, (steps, B).
        left: reduction of the energy that another Newton step would give for a quadratic energy, in nats, (B,); about 0
            after convergence.
        bent: number of directions with less curvature of the energy than the prior has, (B,). In these directions, the
            normal is as wide as the prior; otherwise it would be wider or have no finite width.
        factor: lower triangular factor of the covariance of all latent numbers of a sequence, in the order of `mode`,
            (B, P, P).

    Example:
        >>> model = dvae.linear_gaussian_surrogate("p(w) p(x_t | w)", "q(w | x_{1:T})", {"w": 2, "x": 3}, 4)
        >>> result = dvae.posterior(model.model, {"x": model.sample(5, 4)["x"]}, descent=dvae.Descent(steps=20))
        >>> bool((result.left < 1e-6).all())  # nats: it has converged
        True
    """

    mode: Mapping[str, Tensor]
    energy: Tensor
    energies: Tensor
    course: Tensor
    left: Tensor
    bent: Tensor
    factor: Tensor

    @property
    def moved(self) -> Tensor:
        """Reduction of the energy in the last tenth of the steps, in nats, (B,)."""
        return self.course[-ceil(len(self.course) / 10)] - self.course[-1]

    @property
    def behind(self) -> Tensor:
        """Energy of each start's result above the lowest one, in nats, (S, B)."""
        return self.energies - self.energies[:1]

    @property
    def deviation(self) -> dict[str, Tensor]:
        """Standard deviations (B, ...) of each latent."""
        return split(self.factor.norm(dim=-1), self.mode)

    def draw(self, n: int, seed: int = 0) -> dict[str, Tensor]:
        """Return draws (n, B, ...) of each latent from the normal.

        Args:
            n: number of draws for each sequence.
            seed: seed of the draws.
        """
        return split(joined(self.mode) + self._deviations(n, torch.Generator().manual_seed(seed)), self.mode)

    def guide(self, batch: Any = None) -> dict[str, Tensor]:
        """Sample from the normal as a Pyro guide of the program, on the same batch.

        Args:
            batch: ignored; draws are for the batch of this posterior.

        Returns:
            Dictionary from latent to one draw (B, ...).
        """
        with pyro.plate("sequences", len(self.factor)):
            distribution = dist.MultivariateNormal(joined(self.mode), scale_tril=self.factor)
            flat = pyro.sample("_latents", distribution, infer={"is_auxiliary": True})
            values = split(flat, self.mode).items()
            return {name: pyro.sample(name, dist.Delta(value, event_dim=value.dim() - 1)) for name, value in values}

    @torch.no_grad()
    def evidence(
        self, program: _Program, batch: Any, particles: int = 200, *, seed: int = 0, chunk: int = 4096
    ) -> IWAEBound:
        """Return the log evidence of the observations by importance sampling from the normal, with its k-hat.

        A k-hat above 0.7 means that the posterior differs from the normal: its intervals are then rough.

        Args:
            program, batch: program and batch of this posterior.
            particles: K, number of particles.
            seed: seed of the draws.
            chunk: largest number of sequences times particles in memory.

        Returns:
            Log evidence and k-hat, (B,) each.

        Raises:
            ValueError: a site of the program has no separate log-density for each sequence.
        """
        generator = torch.Generator().manual_seed(seed)
        distribution = dist.MultivariateNormal(torch.zeros_like(self.factor[..., 0]), scale_tril=self.factor)

        def log_weights(count: int) -> Tensor:
            deviations = self._deviations(count, generator)
            latents = split((joined(self.mode) + deviations).flatten(0, 1), self.mode)
            return -_energy(program, repeat(batch, count), latents) - distribution.log_prob(deviations).flatten()

        return importance_mean(log_weights, len(self.factor), particles, chunk)

    def _deviations(self, n: int, generator: torch.Generator) -> Tensor:
        """Return draws (n, B, P) from the normal, minus its mean."""
        noise = torch.randn(n, *self.factor.shape[:-1], generator=generator, dtype=self.factor.dtype)
        return (self.factor @ noise.to(self.factor)[..., None]).squeeze(-1)


@torch.inference_mode(False)
def posterior(
    program: _Program,
    batch: Mapping[str, Any],
    *,
    guide: _Program | None = None,
    descent: Descent | None = None,
    renew: Callable[[Mapping[str, Any], Values], Mapping[str, Any]] | None = None,
    seed: int = 0,
    chunk: int = 2048,
    progress: bool = False,
) -> Posterior:
    """Return the posterior of a program's latents given a batch.

    Args:
        program: Pyro program of the batch, such as `DynamicalVAE.model`, in evaluation mode. Its latents (B, ...) are
            continuous and unbounded, about as wide as N(0, I), with a log-concave prior such as a normal; every site
            has one log-density for each sequence.
        batch: tensors (B, ...) by name: the observations and other inputs of the program.
        guide: program of the batch that draws some or all latents, as further candidates.
        descent: options of the search.
        renew: function of the batch and the latents that updates parts of the batch that depend on the latents, such as
            the correspondence of points. It is called every `descent.renewed` steps, without gradients.
        seed: seed of the candidates.
        chunk: largest number of sequences times starts in memory.
        progress: whether to show a progress bar.

    Returns:
        Modes (B, ...) of the latents, their energies (B,) in nats, and the normal approximations at the modes.

    Raises:
        ValueError: when the program has no latents, a site has no separate log-density for each sequence, the prior is
            not log-concave, or sequences have padding.
        FloatingPointError: when no start of a sequence has a finite energy.

    Example:
        >>> model = dvae.linear_gaussian_surrogate("p(w) p(x_t | w)", "q(w | x_{1:T})", {"w": 2, "x": 3}, 4)
        >>> seen = model.sample(5, 4)["x"]
        >>> batch = {"x": seen, "mask": torch.rand(seen.shape) < 0.5}
        >>> result = dvae.posterior(model.model, batch, descent=dvae.Descent(steps=20))
        >>> result.mode["w"].shape, result.draw(10)["w"].shape
        (torch.Size([5, 2]), torch.Size([10, 5, 2]))
    """
    descent = descent or Descent()
    size, at_once = len(_some(batch)), max(1, chunk // descent.starts)
    device = _some(batch).device
    attention = sdpa_kernel(SDPBackend.MATH)  # the only kernel of attention with second derivatives
    with seeded(seed, device), pyro.validation_enabled(False), attention, progress_bar(progress) as bar:
        chunks = [rows(batch, slice(first, first + at_once)) for first in range(0, size, at_once)]
        task = bar.add_task("searching for modes", total=len(chunks) * (descent.steps + descent.newton + 1))
        parts = [_Search(program, chunk, guide, descent, renew, partial(bar.advance, task)).run() for chunk in chunks]
    return parts[0] if len(parts) == 1 else _concatenate(parts)


def _some(batch: Any) -> Tensor:
    """Return a tensor (B, ...) of a batch."""
    return batch if isinstance(batch, Tensor) else _some(next(iter(batch.values())))


class _Search:
    """Search for the modes of one chunk of sequences."""

    def __init__(
        self,
        program: _Program,
        batch: Any,
        guide: _Program | None,
        descent: Descent,
        renew: Any,
        advance: Callable[[], object],
    ):
        self.program, self.batch, self.guide, self.descent, self.advance = program, batch, guide, descent, advance
        self.size = len(_some(batch))
        self.renew = renew or (lambda batch, values: batch)
        self.latents: dict[str, Tensor] = {}  # example values, for their shapes

    def run(self) -> Posterior:
        with torch.no_grad():
            starts = self._starts()
        ends, course = self._descend(starts)
        batch = repeat(self.batch, len(starts))
        energies = self._measure(batch, ends.flatten(0, 1)).unflatten(0, starts.shape[:2])
        finite = energies.isfinite().any(0)
        if not finite.all():
            raise FloatingPointError(
                f"no start of sequence {int(finite.logical_not().nonzero()[0])} of these {self.size} reached a "
                "finite energy; check whether its observations are finite, or lower the rate"
            )
        order = energies.nan_to_num(torch.inf).argsort(0)
        best, each = order[0], torch.arange(self.size)
        values, batch = ends[best, each], self.batch
        for round in range(self.descent.newton + 1):
            batch = self._renew(batch, values)
            gradient, curvature = self._curvature(batch, values)
            factor, bent = _root(curvature, self._curvature(batch, values, list(self.latents))[1])
            step = -(factor @ factor.mT @ gradient[..., None]).squeeze(-1)
            if round < self.descent.newton:
                values = self._line_search(batch, values, step)
            self.advance()
        left = -(gradient * step).sum(-1) / 2
        return Posterior(
            split(values, self.latents),
            self._measure(batch, values),
            energies.gather(0, order),
            course[:, best, each],
            left,
            bent,
            factor,
        )

    def _starts(self) -> Tensor:
        """Return the most probable candidates, (S, B, P)."""
        nodes: dict[str, Any] = poutine.trace(self.program).get_trace(self.batch).nodes
        self.latents = {
            name: site["value"]
            for name, site in nodes.items()
            if site["type"] == "sample" and not site["is_observed"] and not poutine.util.site_is_subsample(site)
        }
        runs = {name: site["infer"]["run"] for name, site in nodes.items() if "run" in (site.get("infer") or {})}
        if rough := [name for name, run in runs.items() if run.conditionals[name].head.present_density != "exact"]:
            raise ValueError(
                f"{', '.join(rough)} has a random bound or loss in place of a density, so its program has no energy "
                "with a mode; use the draws of a guide"
            )
        if not self.latents:
            raise ValueError(
                "the program has no latents, because all its sites are observed; leave latents out of the batch"
            )
        if invalid := [name for name, value in self.latents.items() if len(value) != self.size]:
            raise ValueError(
                f"{', '.join(invalid)} must have one value for each of {self.size} sequences; draw latents in a plate "
                "over sequences"
            )
        draws = [self._draw(self.program) for _ in range(self.descent.candidates)]
        guided = [self._draw(self.program) | self._draw(self.guide) for _ in draws] if self.guide else []
        candidates = torch.stack([torch.stack([joined(each) for each in draws]).mean(0), *map(joined, draws + guided)])
        energies = torch.stack([self._measure(self.batch, each) for each in candidates]).nan_to_num(torch.inf)
        starts, each = self.descent.starts, torch.arange(self.size)
        return torch.stack([candidates[n::starts][energies[n::starts].argmin(0), each] for n in range(starts)])

    def _draw(self, program: _Program) -> dict[str, Tensor]:
        """Return the latents of the searched program that another program, such as a guide, draws, by name."""
        nodes: dict[str, Any] = poutine.trace(program).get_trace(self.batch).nodes
        return {name: nodes[name]["value"] for name in self.latents if name in nodes}

    def _descend(self, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Return the results (S, B, P) of Adam from starts (S, B, P), and the energies (steps, S, B) at each step."""
        descent, course = self.descent, []
        batch = repeat(self.batch, len(starts))
        values = starts.flatten(0, 1).clone().requires_grad_()
        adam = torch.optim.Adam([values], descent.rate)
        scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(adam, descent.steps)
        for step in range(descent.steps):
            if step % descent.renewed == 0:
                batch = self._renew(batch, values.detach())
            energy = self._energy(batch, values)
            (gradient,) = torch.autograd.grad(energy.sum(), values)
            values.grad = gradient.nan_to_num(0.0, 0.0, 0.0)  # a diverged row must not stop the others
            adam.step()
            scheduler.step()
            course.append(energy.detach())
            self.advance()
        return values.detach().unflatten(0, starts.shape[:2]), torch.stack(course).unflatten(1, starts.shape[:2])

    def _energy(self, batch: Any, values: Tensor, sites: Collection[str] | None = None) -> Tensor:
        return _energy(self.program, batch, split(values, self.latents), sites)

    def _renew(self, batch: Any, values: Tensor) -> Any:
        with torch.no_grad():
            return self.renew(batch, split(values, self.latents))

    def _measure(self, batch: Any, values: Tensor) -> Tensor:
        with torch.no_grad():
            return self._energy(self._renew(batch, values), values)

    def _curvature(self, batch: Any, values: Tensor, sites: Collection[str] | None = None) -> tuple[Tensor, Tensor]:
        """Return gradients (B, P) and second derivatives (B, P, P) of the energy with respect to the latents.

        Args:
            batch: batch of the program.
            values: latents as flat vectors (B, P).
            sites: names of the sites whose energy is used, such as the latents for the prior; None for all.
        """
        values = values.clone().requires_grad_()
        with torch.enable_grad():
            energy = self._energy(batch, values, sites)
            (gradient,) = torch.autograd.grad(energy.sum(), values, create_graph=True)
            columns = [
                torch.autograd.grad(part.sum(), values, retain_graph=True, materialize_grads=True)[0]
                for part in gradient.unbind(-1)
            ]
        return gradient.detach(), torch.stack(columns, -1)

    def _line_search(self, batch: Any, values: Tensor, step: Tensor) -> Tensor:
        """Return latents (B, P) after the best of a full, half, quarter or eighth step; unchanged if none is better.

        Args:
            batch: batch of the program.
            values: latents as flat vectors (B, P).
            step: Newton step (B, P).
        """
        shares = step.new_tensor([1.0, 0.5, 0.25, 0.125, 0.0])
        candidates = [values + share * step for share in shares]
        energies = torch.stack([self._measure(batch, each) for each in candidates]).nan_to_num(torch.inf)
        return torch.stack(candidates)[energies.argmin(0), torch.arange(self.size)]


def _energy(program: _Program, batch: Any, values: Values, sites: Collection[str] | None = None) -> Tensor:
    """Return -log p (B,) of a program's sites, or only of `sites`, at these values of its latents."""
    with serialized:
        trace = poutine.trace(poutine.condition(program, data=dict(values))).get_trace(batch)
    trace.compute_log_prob(site_filter=lambda name, _: sites is None or name in sites)
    logs = {name: site["log_prob"] for name, site in trace.nodes.items() if "log_prob" in site}
    size = len(next(iter(values.values())))
    if invalid := {name: tuple(log.shape) for name, log in logs.items() if log.shape != (size,) and log.dim()}:
        raise ValueError(
            f"log-densities have shapes {invalid}, expected one value for each of {size} sequences; draw in one plate "
            "over sequences, and declare all other dimensions as one event (`.to_event()`)"
        )
    return -torch.stack([log for log in logs.values() if log.dim()]).sum(0)  # plates have no dimensions


def _root(curvature: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Return lower triangular roots (B, P, P) of the inverse curvature, and the number of raised directions.

    Where the curvature is less than the prior's, it is raised to the prior's.
    """
    kind, curvature, prior = curvature, curvature.double(), prior.double()
    root, failed = torch.linalg.cholesky_ex(prior)
    if (prior.diagonal(dim1=-2, dim2=-1) == 0).any():
        raise ValueError(
            "the prior has no curvature in some latents, as a Laplace distribution, or after the last step of a "
            "shorter sequence; use priors such as normals, and sequences of one length"
        )
    if failed.any():
        raise ValueError(
            "the prior of the latents is not log-concave at the mode of the posterior, so its width cannot be "
            "bounded; use priors such as normals"
        )
    white = torch.linalg.solve_triangular(root, torch.eye(prior.shape[-1]).to(prior), upper=False)
    relative = white @ curvature @ white.mT
    values, directions = torch.linalg.eigh((relative + relative.mT) / 2)
    bent = (values < 1 - 1e-3).sum(-1)  # without observations exactly 1, except for rounding
    upper = torch.linalg.qr((white.mT @ directions / values.clamp(min=1.0)[..., None, :].sqrt()).mT)[1]
    signs = upper.diagonal(dim1=-2, dim2=-1).sign()
    return (upper * signs[..., None]).mT.to(kind), bent


def _concatenate(parts: Sequence[Posterior]) -> Posterior:
    along = {"energies": 1, "course": 1}
    tensors: dict[str, Any] = {
        field.name: torch.cat([getattr(part, field.name) for part in parts], along.get(field.name, 0))
        for field in fields(Posterior)
        if field.name != "mode"
    }
    return Posterior({name: torch.cat([part.mode[name] for part in parts]) for name in parts[0].mode}, **tensors)
