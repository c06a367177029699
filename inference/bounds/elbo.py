"""Bounds on the log evidence, as terms per sequence.

`SequenceELBO` is the evidence lower bound, with analytic KL terms wherever they are correct. `iwae_bound` is the
IWAE bound (Burda et al., 2016, arXiv 1509.00519) with the Pareto diagnostic of its weights (Vehtari et al., 2024, arXiv
1507.02646).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from pyro import poutine
from pyro.distributions import Unit
from pyro.infer import ELBO
from torch import Tensor
from torch.distributions import kl_divergence

from ...capture import Captured, replayed
from ...data.batch import WHOLE, Batch
from ...factorization.graph import analytic_kl
from ...locking import serialized
from ...networks.loop import memoizing, valid_steps
from ...program.batch import AnyBatch, repeat
from ...program.conditional import like
from ...program.groups import Groups
from ...program.model import DynamicalVAE
from ...program.rollout import Rollout, Sequence

# Between training steps, glibc may return freed memory to the system, which costs up to a quarter of a step in page
# faults. Freeing a block of just under 32 MiB raises its limit for this to 64 MiB (M_MMAP_THRESHOLD in mallopt(3)).
torch.empty(2**25 - 2**14, dtype=torch.uint8, device="cpu")


@dataclass
class Terms:
    """Terms of a bound, per sequence and in nats.

    Args:
        log_likelihood: log-likelihood (B,) of each data variable, including the log-determinant of a view that changes
            volume.
        kl: KL (B,) of each latent, summed over the steps of a local one.
        energies: energy (B,) of each penalty (a `pyro.factor` site), positive if it costs.
        n_steps: number of valid steps, (B,), without those whose entries are all given (`views.Given`).
        steps: log-likelihood or KL by step (B, T) of each local variable, 0 at padding.
        bounded: names of the variables whose term has a stochastic bound in place of a log density
            (`distributions.Diffusion`). `bound` remains a lower bound. The terms of single steps of a variable that is
            drawn jointly are shares, not conditional densities.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> terms = dvae.SequenceELBO().terms(model, torch.randn(3, 4, 2))
        >>> terms.kl["z"].shape, torch.allclose(terms.bound, terms.log_likelihood["x"] - terms.kl["z"])
        (torch.Size([3]), True)
    """

    log_likelihood: dict[str, Tensor]
    kl: dict[str, Tensor]
    energies: dict[str, Tensor]
    n_steps: Tensor
    steps: dict[str, Tensor] = field(default_factory=dict)
    bounded: tuple[str, ...] = ()

    def map(self, change: Callable[[Tensor], Tensor]) -> Terms:
        """Return the terms with `change` applied to every tensor."""
        tables = (self.log_likelihood, self.kl, self.energies, self.steps)
        likelihood, kl, energies, steps = ({name: change(value) for name, value in t.items()} for t in tables)
        return Terms(likelihood, kl, energies, change(self.n_steps), steps, self.bounded)

    @property
    def likelihood(self) -> bool:
        """Whether the model has a likelihood; if energies replace it, `bound` is minus the KL terms."""
        return bool(self.log_likelihood)

    @property
    def bound(self) -> Tensor:
        """Unweighted evidence lower bound, (B,), without energies."""
        none = torch.zeros_like(self.n_steps)
        return sum(self.log_likelihood.values(), none) - sum(self.kl.values(), none)

    @property
    def per_step(self) -> Tensor:
        """Bound in nats per step, (B,)."""
        return self.bound / self.n_steps


class SequenceELBO(ELBO):
    """Evidence lower bound of a sequence model.

    It can be used like any Pyro ELBO; `terms` returns it by variable and sequence. The KL of a latent is analytic per
    step if both conditionals are normal and no generative parent of the latent is its descendant in the guide.
    Otherwise it is the log-ratio at the draw, which is unbiased for every guide. (For a backward guide the analytic
    form is wrong: it keeps parents fixed that vary with the latent.) Parents are determined for the data of each run:
    where x is missing, or replaced in scheduled sampling, the model reads its own mean, which varies with the parents
    of x.

    It traces like `TraceMeanField_ELBO` and agrees with it where that is correct. It evaluates each conditional only
    once, as it does not compute the trace's own log probability.

    Args:
        num_particles: number of draws from the guide to average.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> dvae.SequenceELBO().loss(model, model.guide, torch.randn(3, 4, 2)) > 0
        True
    """

    def __init__(self, num_particles: int = 1):
        super().__init__(num_particles=num_particles)

    def terms(
        self, model: Callable[..., Any], batch: AnyBatch, guide: Callable[..., Any] | None = None, **options: Any
    ) -> Terms:
        """Return the terms of the bound, averaged over the particles.

        Args:
            model: a `DynamicalVAE`, or a Pyro model that wraps its program.
            batch: batch as in `DynamicalVAE.model`.
            guide: guide; the model's own by default.
            options: options of the program, such as `scheduled_sampling`.

        Returns:
            Terms in nats, (B,) each.

        Raises:
            ValueError: when a site is scaled, or missing in guide or model.
        """
        guide = guide or model.guide  # type: ignore[attr-defined]
        draws = [self._terms(model, guide, (batch,), options) for _ in range(self.num_particles)]
        return draws[0] if len(draws) == 1 else _mean(draws)

    def differentiable_loss(self, model: Any, guide: Any, *args: Any, **kwargs: Any) -> Tensor:
        """Return the energies minus the bound, summed over the batch.

        Args:
            model, guide: Pyro programs, such as a `DynamicalVAE` and its `guide`.
            args, kwargs: arguments of both programs, such as a batch.
        """
        draws = [self._terms(model, guide, args, kwargs) for _ in range(self.num_particles)]
        return sum(sum(t.energies.values()) - t.bound for t in draws).sum() / self.num_particles  # type: ignore[return-value, union-attr]

    def loss(self, model: Any, guide: Any, *args: Any, **kwargs: Any) -> float:
        """Return the energies minus the bound, summed over the batch, as a number.

        Args:
            model, guide: Pyro programs, such as a `DynamicalVAE` and its `guide`.
            args, kwargs: arguments of both programs, such as a batch.
        """
        with torch.no_grad():
            return self.differentiable_loss(model, guide, *args, **kwargs).item()

    def loss_and_grads(self, model: Any, guide: Any, *args: Any, **kwargs: Any) -> float:
        """Return the energies minus the bound as a number, and add the gradient of this loss to the parameters.

        Args:
            model, guide: Pyro programs, such as a `DynamicalVAE` and its `guide`.
            args, kwargs: arguments of both programs, such as a batch.
        """
        loss = self.differentiable_loss(model, guide, *args, **kwargs)
        loss.backward()
        return loss.item()

    def _get_trace(self, model: Any, guide: Any, args: Any, kwargs: Any) -> tuple[poutine.Trace, poutine.Trace]:
        return _traces(model, guide, args, kwargs)

    @memoizing()
    @serialized
    def _terms(self, model: Any, guide: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Terms:
        model_sites, guide_sites = map(sites_of, self._get_trace(model, guide, args, kwargs))
        for name in guide_sites:
            if name not in model_sites:
                raise ValueError(
                    f"the latent {name} is in the guide but not in the model; "
                    "add it to the model, or remove it from the guide"
                )
        closed = _closed_forms(model_sites, guide_sites)
        terms = Terms({}, {}, {}, torch.empty(0))
        for name, site in model_sites.items():
            fn, value, run = site["fn"], site["value"], site["infer"].get("run")
            if run is not None:
                terms.n_steps = _valid_steps(run)
            if name == "log_det":
                terms.log_likelihood[name] = fn.log_prob(value)
            elif isinstance(fn, Unit):
                terms.energies[name] = -fn.log_prob(value)
            elif name in guide_sites:
                _record(terms, terms.kl, name, _kl(fn, guide_sites[name]["fn"], value, name in closed), run)
            elif site["infer"].get("_deterministic"):
                continue
            elif site["is_observed"] and _density(run, name) == "loss":
                _record(terms, terms.energies, name, -site_log_prob(fn, value), run)
                terms.steps.pop(name, None)
            elif site["is_observed"]:
                _record(terms, terms.log_likelihood, name, site_log_prob(fn, value), run)
                if run is not None:  # the run of the model; a replayed latent has the run of the guide
                    terms.bounded = tuple(n for n in run.conditionals if _density(run, n) == "bound")
            else:
                raise ValueError(
                    f"the latent {name} is in the model but not in the guide; add a sample site {name} to the guide"
                )
        values = [*terms.log_likelihood.values(), *terms.kl.values(), *terms.energies.values()]
        if values and not len(terms.n_steps):  # no variable has steps, so each sequence counts once
            terms.n_steps = torch.ones_like(values[0])
        return terms


def _density(run: Rollout | None, name: str) -> str:
    return "exact" if run is None else run.conditionals[name].head.present_density


def _traces(model: Any, guide: Any, args: Any, kwargs: Any) -> tuple[poutine.Trace, poutine.Trace]:
    guide_trace = poutine.trace(guide).get_trace(*args, **kwargs)
    return poutine.trace(poutine.replay(model, trace=guide_trace)).get_trace(*args, **kwargs), guide_trace


def sites_of(trace: Any) -> dict[str, dict[str, Any]]:
    """Return the sample sites of a trace by name, except variables shared by all sequences, whose terms cancel.

    Raises:
        ValueError: when a handler has scaled or masked a site.
    """
    sites = {
        name: site
        for name, site in trace.nodes.items()
        if site["type"] == "sample" and not (poutine.util.site_is_subsample(site) or "shared" in site["infer"])
    }
    for name, site in sites.items():
        if site["scale"] != 1.0 or site["mask"] is not None:
            raise ValueError(
                f"the site {name} is scaled or masked by a handler. Pass weights to the objective "
                "(Evidence(kl_weight=...)), and missing entries to the batch ('mask'), so that the bound stays a bound"
            )
    return sites


def site_log_prob(fn: Any, value: Tensor) -> Tensor:
    """Return the log probability, (B, T) for a local variable, (B,) for a static one."""
    return fn.by_step(value) if isinstance(fn, Sequence) else fn.log_prob(value)


def log_densities(trace: Any) -> dict[str, Tensor]:
    """Return `site_log_prob` of the sample sites of a trace, without energies."""
    sites = sites_of(trace).items()
    return {n: site_log_prob(s["fn"], s["value"]) for n, s in sites if n == "log_det" or not isinstance(s["fn"], Unit)}


def total(logs: Mapping[str, Tensor]) -> Tensor:
    """Return the sum (B,) of log densities (B, T) or (B,) over variables and steps."""
    return sum(log.sum(-1) if log.dim() == 2 else log for log in logs.values())  # type: ignore[return-value]


def joint_and_guide(model: DynamicalVAE, batch: AnyBatch, latents: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Return log p(x, z) and log q(z | x) at given latents, (B,) each.

    Args:
        model: model with its guide.
        batch: batch as in `DynamicalVAE.model`.
        latents: values of all latents by name, (B, T, D) or (B, D) each.
    """
    traces = (
        poutine.trace(poutine.condition(program, data=dict(latents))).get_trace(batch)
        for program in (model.model, model.guide)
    )
    joint, guide = (total(log_densities(trace)) for trace in traces)
    return joint, guide


def _closed_forms(model_sites: Mapping[str, Any], guide_sites: Mapping[str, Any]) -> set[str]:
    """Return the latents whose KL term may be analytic; the empty set if a program's factorization is unknown."""
    # In a replayed model, latent sites have the guide's `infer` dict; data sites have the model's.
    sites = ([site for site in model_sites.values() if site["is_observed"]], guide_sites.values())
    notes = [next((s["infer"] for s in group if "program" in s["infer"]), None) for group in sites]
    if None in notes:
        return set()
    pair, run = [note["program"] for note in notes], notes[0]["run"]  # type: ignore[index]
    # Data that are missing, fed back, or a function of their parents vary with these parents.
    hidden = frozenset(run.hidden) | {name for name, s in model_sites.items() if s["infer"].get("_deterministic")}
    depends_on_length = hidden or any(equations.masks for equations in pair)
    is_analytic = _analytic(*pair, hidden, run.length if depends_on_length else None)
    return {name for name, analytic in is_analytic.items() if analytic}


_analytic = functools.lru_cache(maxsize=256)(analytic_kl)


def _kl(p: Any, q: Any, value: Tensor, closed: bool) -> Tensor:
    """Return the KL (B, T) or (B,) of q from p: a closed form if it is correct and known, otherwise the log-ratio."""
    if closed:
        try:
            if isinstance(p, Sequence) and isinstance(q, Sequence):
                return p.counted(kl_divergence(q.steps(value), p.steps(value)))
            return kl_divergence(q, p)
        except NotImplementedError:  # this pair of families has no closed form
            pass
    log_q, log_p = site_log_prob(q, value), site_log_prob(p, value)
    if log_q.dim() != log_p.dim():  # a custom guide, whose density is not by step
        log_q, log_p = (part.sum(-1) if part.dim() == 2 else part for part in (log_q, log_p))
    return log_q - log_p


def _record(terms: Terms, table: dict[str, Tensor], name: str, value: Tensor, run: Rollout | None) -> None:
    if run is not None and run.draws > 1:
        value = value.unflatten(0, (run.draws, -1)).mean(0)
    if value.dim() == 2:
        if not len(terms.n_steps):  # a custom program that does not give its length
            terms.n_steps = value.new_full((len(value),), float(value.shape[1]))
        terms.steps[name] = value
        value = value.sum(-1)
    table[name] = value


def _valid_steps(rollout: Rollout) -> Tensor:
    reference, rows = like(next(iter(rollout.conditionals.values()))), rollout.batch // rollout.draws
    if rollout.lengths is None:
        steps = reference.new_full((rows,), float(rollout.length))
    else:
        steps = rollout.lengths[:rows].to(reference.dtype)
    if rollout.given is None:
        return steps
    has_target = rollout.observed[WHOLE][:rows].any(-1)
    if rollout.lengths is not None:
        has_target = has_target & valid_steps(rollout.lengths[:rows], rollout.length)
    return has_target.sum(-1).to(steps).clamp(min=1.0)


def _mean(draws: list[Terms]) -> Terms:
    def average(tables: tuple[dict[str, Tensor], ...]) -> dict[str, Tensor]:
        return {name: torch.stack([table[name] for table in tables]).mean(0) for name in tables[0]}

    tables = zip(*((d.log_likelihood, d.kl, d.energies, d.steps) for d in draws), strict=True)
    likelihood, kl, energies, steps = map(average, tables)
    return Terms(likelihood, kl, energies, draws[0].n_steps, steps, draws[0].bounded)


def require_likelihood(model: DynamicalVAE) -> None:
    """Refuse a model whose data have no density given its latents.

    Raises:
        ValueError: when the model has no likelihood, and so no bound.
    """
    if not model.likelihood:
        raise ValueError(
            f"{model.generative} has no likelihood: its data are functions of its latents, or have a loss in place of "
            "a density. It has no bound, and nothing to calibrate; evaluate its forecasts with dvae.evaluate"
        )


def require_densities(model: DynamicalVAE) -> None:
    """Refuse a model without a likelihood, or with a bound in place of a density.

    The mean of importance weights with a stochastic bound may exceed the evidence.

    Raises:
        ValueError: when the model has no likelihood, or not every variable has an exact density.
    """
    require_likelihood(model)
    if model.bounded:
        raise ValueError(
            f"{', '.join(model.bounded)} of {model.generative} has a stochastic lower bound in place of a density, so "
            "importance weights are not available; use SequenceELBO or particles=1, whose bound remains a lower bound"
        )


def bound_notes(label: str, model: DynamicalVAE) -> Iterator[str]:
    """Yield a note for tables if a variable of the model has a stochastic bound in place of a density."""
    if model.bounded:
        yield (
            f"bounds of {label}: {', '.join(model.bounded)} has a stochastic lower bound in place of a log density, "
            "without importance weights (K = 1) and k-hat"
        )


def require_latents(model: DynamicalVAE) -> None:
    """Refuse a model without sampled latents.

    Raises:
        ValueError: when the model has no latents except those that are summed out.
    """
    if not model.latents:
        summed = f" other than {', '.join(model.summed)}, which is summed out" if model.summed else ""
        raise ValueError(f"{model.generative} has no latents{summed}: its bound is the log evidence itself")


def require_data(model: DynamicalVAE, data: AnyBatch) -> int:
    """Return the number of sequences of a batch, after checking that it has everything that a bound needs.

    Raises:
        ValueError: when data or context are missing.
    """
    required = (*model.observed, *model.context)
    if missing := [name for name in required if name not in data]:
        raise ValueError(f"the bound needs {', '.join(required)}; missing in the batch are {', '.join(missing)}")
    return len(data[model.observed[0]])  # type: ignore[call-overload, index]


KHAT_PARTICLES = 25
"""Smallest number of particles for k-hat: arviz_stats fits the tail to a fifth of them and needs five."""


@dataclass(frozen=True)
class IWAEBound:
    """IWAE bound of every sequence, with a diagnostic of the guide.

    Args:
        bound: log mean of the weights, in nats, (B,).
        khat: Pareto shape of the tail of the weights, (B,). Above 0.7 the guide misses so much of the posterior that
            the bound is unreliable with this number of particles. Infinite if a weight of the tail is 0; NaN with fewer
            than 25 particles. With fewer than about 100, k-hat of a single sequence is mostly noise.
        particles: K, number of particles.
    """

    bound: Tensor
    khat: Tensor
    particles: int


@torch.no_grad()
def iwae_bound(
    model: DynamicalVAE,
    batch: AnyBatch,
    particles: int = 100,
    *,
    chunk: int = 4096,
    graphs: Captured | None = None,
    **options: Any,
) -> IWAEBound:
    """Return the IWAE bound: log of the mean over particles of p(x, z) / q(z | x), per sequence.

    Its mean rises with the number of particles, from the evidence lower bound at 1 to the log evidence. With fewer than
    25 particles the tail shape is NaN. For a model without latents it is the log-likelihood, evaluated once, with k-hat
    0.

    Args:
        model: model with its guide.
        batch: batch as in `DynamicalVAE.model`.
        particles: K, number of particles.
        chunk: largest number of sequences times particles in memory.
        graphs: CUDA graphs that replay the weights; the batch must then be a `Batch` on the GPU.
        options: options of the program.

    Returns:
        Bound and tail shape, (B,) each.

    Raises:
        ValueError: `particles` is less than 1, the model has no likelihood, or `particles` is above 1 and a variable
            has a stochastic bound in place of a density.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> dvae.iwae_bound(model, torch.randn(3, 4, 2), particles=16).bound.shape
        torch.Size([3])
    """
    if particles < 1:
        raise ValueError(f"particles must be at least 1, got {particles}")
    (require_densities if particles > 1 else require_likelihood)(model)
    with model.running():
        data = model.read(batch)
        size = next(v.shape[0] for v in data.values() if isinstance(v, Tensor))
        if not model.latents:
            evidence = _log_weights(model, data, options)
            return IWAEBound(evidence, torch.full_like(evidence, math.nan if model.bounded else 0.0), particles)
        groups = Groups.of(data.group) if model.grouped and data.group is not None else None
        kind = "IWAE bound", *sorted(options.items())
        weights = replayed_weights(graphs, kind, model, batch, data, partial(_repeated_weights, model, options))
        return importance_mean(weights, size, particles, chunk, groups)


def replayed_weights(
    graphs: Captured | None,
    kind: Hashable,
    model: DynamicalVAE,
    batch: AnyBatch,
    data: Batch,
    log_weights_of: Callable[[Batch, int], Tensor],
) -> Callable[[int], Tensor]:
    """Return a function from a number of particles to log weights, replayed as a CUDA graph unless `graphs` is None.

    Args:
        graphs: the graphs.
        kind: value that determines `log_weights_of`, except for the number of particles.
        model: model that reads the batch.
        batch: batch as in `DynamicalVAE.model`, a `Batch` on the GPU if there are graphs.
        data: the same batch, read by the model.
        log_weights_of: function from the read batch and a number n of particles to log weights (n B,).
    """
    if graphs is None:
        return partial(log_weights_of, data)

    def weights(count: int) -> Tensor:
        run = replayed(graphs, (kind, count), lambda each: {"weights": log_weights_of(model.read(each), count)})
        return run(batch)["weights"]

    return weights


def importance_mean(
    log_weights_of: Callable[[int], Tensor],
    size: int,
    particles: int,
    chunk: int = 4096,
    groups: Groups | None = None,
) -> IWAEBound:
    """Return the log of the mean weight of every sequence, and the tail shape of the weights.

    Sequences that share latents have one joint weight, whose logarithm is divided equally among them.

    Args:
        log_weights_of: function from a number n of particles to log weights (n B,), particle by particle.
        size: B, number of sequences.
        particles: K, number of particles.
        chunk: largest number of sequences times particles in memory.
        groups: groups of sequences that share latents.
    """
    log_weights = _all_weights(log_weights_of, size, particles, chunk)
    if groups is not None:
        log_weights = groups.summed(log_weights)
    bound, khat = log_weights.logsumexp(0) - math.log(particles), _khat(log_weights)
    if groups is not None:
        bound, khat = groups.split_evenly(bound), khat[groups.place]
    return IWAEBound(bound, khat, particles)


def importance_weights(model: DynamicalVAE, data: AnyBatch, size: int, particles: int, chunk: int) -> Tensor:
    """Return K log weights log p(x, z) - log q(z | x) of each of B sequences, (K, B)."""
    return _all_weights(partial(_repeated_weights, model, {}, model.read(data)), size, particles, chunk)


def _all_weights(log_weights_of: Callable[[int], Tensor], size: int, particles: int, chunk: int) -> Tensor:
    at_once = max(1, min(particles, chunk // size))
    counts = [min(at_once, particles - first) for first in range(0, particles, at_once)]
    return torch.cat([log_weights_of(count).unflatten(0, (count, size)) for count in counts])


def _repeated_weights(model: DynamicalVAE, options: Mapping[str, Any], data: Batch, count: int) -> Tensor:
    return _log_weights(model, repeat(data, count), options)


def _log_weights(model: DynamicalVAE, batch: AnyBatch, options: Mapping[str, Any]) -> Tensor:
    joint, guide = map(log_densities, _traces(model, model.guide, (batch,), options))
    return total(joint) - total(guide)


def _khat(log_weights: Tensor) -> Tensor:
    """Return the Pareto tail shape (B,) of weights (K, B)."""
    if log_weights.shape[0] < KHAT_PARTICLES:
        return log_weights.new_full(log_weights.shape[1:], math.nan)
    khat = [_tail_shape(weights) for weights in log_weights.double().cpu().numpy().T]
    return torch.as_tensor(khat, dtype=log_weights.dtype, device=log_weights.device)


def _tail_shape(log_weights: np.ndarray) -> float:
    """Return the Pareto shape of weights (K,); Hill's estimate if the tail underflows or is constant."""
    from arviz_stats.base import array_stats  # the import takes over a second

    tail = np.sort(log_weights)[-(len(log_weights) // 5) - 1 :]
    if not np.isfinite(tail).all():
        return math.inf
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            # psislw is for leave-one-out: it takes log-likelihoods, the negatives of the log weights.
            khat = float(array_stats.psislw(-log_weights)[1])
    except (FloatingPointError, ValueError):
        khat = math.nan
    return float((tail[1:] - tail[0]).mean()) if math.isnan(khat) else khat
