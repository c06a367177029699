"""Posterior of a small model's weights, as an ensemble of models.

    p(weights | x) ~ prod over weights of N(weight; 0, scale^2) prod over n of p(x_n | weights)

The weights are those of the generative networks. NUTS (Hoffman and Gelman, 2014, arXiv 1111.4246) draws them from the
posterior. Laplace's approximation is a normal at its mode, with the inverse Hessian as covariance (MacKay, 1992). The
density of x_n is the exact evidence if it is known: without latents, with all latents summed out, or for a
linear-Gaussian model. Otherwise NUTS draws the latents of all sequences jointly with the weights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pyro import poutine
from pyro.infer.mcmc import MCMC, NUTS
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.attention import SDPBackend, sdpa_kernel

from ...data.batch import Batch
from ...options import Count, Positive, Range, require
from ...program.batch import AnyBatch
from ...program.model import DynamicalVAE
from ...program.oracle import Oracle
from ..bounds.elbo import log_densities, require_data, require_densities, total
from ..evaluation.ensemble import Ensemble
from ..evaluation.evaluation_windows import seeded_evaluation
from ..evaluation.result import progress_bar
from .latents import Values, joined, require_real, split
from .reference_posterior import Sampling, diagnose

MOST = 2000
"""Largest number of weights and latent values; a Hessian has the square of their number."""


@dataclass(frozen=True)
class WeightPosterior:
    """Draws from the posterior of a model's weights.

    Args:
        ensemble: models with S of the draws, evenly spaced, for `evaluate` and `compare`.
        draws: draws of each parameter by name, (N, ...), in double precision.
        sampling: convergence of NUTS, over all weights and sampled latents; None for "laplace".
    """

    ensemble: Ensemble
    draws: Mapping[str, Tensor]
    sampling: Sampling | None

    def __repr__(self) -> str:
        count, size = len(next(iter(self.draws.values()))), sum(draws[0].numel() for draws in self.draws.values())
        models = len(self.ensemble.models)
        return f"WeightPosterior({count} draws of {size} weights, {models} models, sampling={self.sampling})"


class _LogDensity(nn.Module):
    """Log density of all sequences given latents by name, or without latents if the exact evidence is known."""

    def __init__(self, model: DynamicalVAE, data: Batch):
        super().__init__()
        self.model, self.data, self.has_evidence, self.obstacle = model, data, False, ""
        if model.latents and not model.wide:
            try:
                with torch.no_grad():
                    self._evidence()
                self.has_evidence = True
            except ValueError as error:  # not linear-Gaussian, or with context
                self.obstacle = f" ({error})"
        self.sampled = () if self.has_evidence else model.latents

    def _evidence(self) -> Tensor:
        return Oracle(self.model, self.data[self.model.observed[0]].shape[1]).evidence(self.data)

    def forward(self, latents: Values) -> Tensor:
        if self.has_evidence:
            return self._evidence().sum()
        program = poutine.condition(self.model.model, data=dict(latents))
        return total(log_densities(poutine.trace(program).get_trace(self.data))).sum()


@torch.inference_mode(False)
def weight_posterior(
    model: DynamicalVAE,
    batch: AnyBatch,
    method: Literal["nuts", "laplace"] = "nuts",
    *,
    scale: float = 1.0,
    members: int = 50,
    draws: int = 500,
    chains: int = 4,
    warmup: int = 500,
    seed: int = 0,
    progress: bool = True,
) -> WeightPosterior:
    """Draw the weights of a small generative model from their posterior, given all sequences of a batch.

    Chains and the search for the mode start at the model's weights, so fit it first. Hidden units can be exchanged, so
    a network has equivalent modes. If chains reach different ones, R-hat is large although predictions agree. The
    guide keeps its weights, so bounds of the members are looser than those of the model that it was fitted with.

    Args:
        model: fitted model with its guide; it does not change.
        batch: training sequences, as in `DynamicalVAE.model`.
        method: "nuts", or "laplace", which needs the exact evidence: no latents, latents that are summed out, or a
            linear-Gaussian model.
        scale: standard deviation of the normal prior of every weight.
        members: S, number of models of the ensemble.
        draws, chains, warmup: number of draws per chain, chains, and warm-up steps per chain of NUTS; "laplace" has as
            many draws in all.
        seed: seed of all draws.
        progress: whether to show a progress bar.

    Raises:
        ValueError: when the model has more than 2000 weights and latent values, no likelihood, or no exact evidence for
            "laplace"; when its groups share latents; when the log density has no maximum near the weights.
        FloatingPointError: when the log density is not finite at the model's weights.

    Example:
        >>> model = dvae.DynamicalVAE("p(x_t | x_{t-1})", "", {"x": 1}, dvae.networks.Dense(()))
        >>> posterior = dvae.weight_posterior(model, torch.randn(9, 5, 1), "laplace", members=3)
        >>> dvae.evaluate(posterior.ensemble, dvae.ArrayWindows(torch.randn(6, 5, 1), 3), progress=False).samples
        50
    """
    require(Count, members=members, warmup=warmup)
    require(Annotated[int, Range(4, 10**6)], draws=draws)  # arviz needs as many for R-hat
    require(Annotated[int, Range(2, 64)], chains=chains)
    require(Positive, scale=scale)
    require(Literal["nuts", "laplace"], method=method)
    require_densities(model)
    copy = deepcopy(model).double()
    with seeded_evaluation(copy, seed), copy.running(), torch.enable_grad(), progress_bar(progress) as bar:
        data = copy.read(batch)
        require_data(copy, data)
        density = _LogDensity(copy, data)
        weights = {f"generator.{n}": p.detach() for n, p in copy.generator.named_parameters() if p.requires_grad}
        latents = {name: value.detach() for name, value in copy.guide(data).items()} if density.sampled else {}
        _require_supported(copy, data, method, weights, latents, density.obstacle)
        template = {name: value[None] for name, value in (weights | latents).items()}

        def energy(flat: Tensor) -> Tensor:
            """Return the negative log density of weights, latents and data, up to a constant."""
            values = split(flat, template)
            given = {name: values[name] for name in latents}
            prior = sum(values[name].square().sum() for name in weights) / (2 * scale**2)
            return prior - functional_call(density, {f"model.{name}": values[name] for name in weights}, (given,))

        start, sampling = joined(template)[0], None
        if not torch.isfinite(energy(start)):
            raise FloatingPointError("the log density is not finite at the model's weights; fit the model first")
        if method == "laplace":
            with sdpa_kernel(SDPBackend.MATH):  # the only kernel of attention with second derivatives
                mode, root = laplace(energy, start)
            noise = torch.randn(len(mode), chains * draws, dtype=mode.dtype, device=mode.device)
            drawn = mode + torch.linalg.solve_triangular(root.T, noise, upper=True).T
        else:
            task = bar.add_task("drawing weights", total=chains * (warmup + draws))
            drawn, sampling = _nuts(energy, start, draws, chains, warmup, lambda *_: bar.advance(task))
    members_of = [deepcopy(model) for _ in range(members)]
    values = {name: value for name, value in split(drawn, template).items() if name in weights}
    for member, index in zip(members_of, torch.linspace(0, len(drawn) - 1, members).round().long(), strict=True):
        member.load_state_dict({name: value[index] for name, value in values.items()}, strict=False)
    return WeightPosterior(Ensemble(members_of), values, sampling)


def _require_supported(
    model: DynamicalVAE, data: Batch, method: str, weights: Values, latents: Values, obstacle: str
) -> None:
    if model.grouped and data.group is not None:
        raise ValueError("sequences of a group have one joint density; remove 'group' from the batch")
    if latents and method == "laplace":
        names = ", ".join(latents)
        raise ValueError(
            f"'laplace' needs the exact evidence, but {names} can only be sampled{obstacle}; use method='nuts'"
        )
    if latents:
        require_real(model)
        if data.lengths is not None:
            raise ValueError("NUTS cannot draw latents at padding; give sequences of one length, without 'lengths'")
    counts = [sum(value.numel() for value in values.values()) for values in (weights, latents)]
    if sum(counts) > MOST:
        raise ValueError(
            f"the model has {counts[0]:,} weights and {counts[1]:,} latent values to draw, more than {MOST:,}; use a "
            "smaller network or fewer sequences, or an ensemble of training seeds: dvae.Ensemble(models)"
        )


def _nuts(
    energy: Callable[[Tensor], Tensor], start: Tensor, draws: int, chains: int, warmup: int, advance: Callable[..., Any]
) -> tuple[Tensor, Sampling]:
    """Return draws (C N, P), chain by chain, and their convergence."""
    results, divergences = [], 0
    for _ in range(chains):  # all from the weights of the model, each with its own momenta
        kernel = NUTS(potential_fn=lambda values: energy(values["u"]))
        run = MCMC(kernel, draws, warmup, {"u": start.clone()}, hook_fn=advance, disable_progbar=True)
        run.run()
        results.append(run.get_samples()["u"])
        divergences += len(run.diagnostics()["divergences"]["chain 0"])
    rhat, effective = diagnose(torch.stack(results))
    counts = np.array([divergences]), np.array([0])
    return torch.cat(results), Sampling(rhat[None], effective[None], *counts, chains, draws, warmup)


def laplace(energy: Callable[[Tensor], Tensor], start: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mode of exp(-energy) near a start (P,), and the Cholesky root (P, P) of the Hessian there.

    Raises:
        ValueError: when there is no minimum of the energy nearby.
    """
    mode = start.clone().requires_grad_()
    options: Any = {"tolerance_grad": 1e-9, "tolerance_change": 1e-14, "line_search_fn": "strong_wolfe"}
    optimiser = torch.optim.LBFGS([mode], max_iter=2000, history_size=50, **options)

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = energy(mode)
        value.backward(inputs=[mode])
        return value

    optimiser.step(closure)
    (gradient,) = torch.autograd.grad(energy(mode), mode)
    root, failed = torch.linalg.cholesky_ex(torch.autograd.functional.hessian(energy, mode.detach()))
    if failed or gradient @ torch.cholesky_solve(gradient[:, None], root)[:, 0] > 1e-6:  # squared distance to the mode
        raise ValueError(
            "no maximum of the log density near the model's weights; fit it longer, or use a smaller `scale`"
        )
    return mode.detach(), root
