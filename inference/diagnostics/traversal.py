"""Traversals: how a latent's coordinates affect the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ...program.batch import AnyBatch, repeat
from ...program.model import DynamicalVAE
from ..evaluation.evaluation_windows import seeded_evaluation
from .checks import decode


@dataclass(frozen=True, eq=False)
class Traversal:
    """Sequences decoded at several values of one coordinate of a latent.

    Attributes:
        latent: name of the latent.
        coordinates: indices of the C coordinates, which are shifted one at a time.
        offsets: offsets (M,) in units of `scale`; 0 is the inferred latent.
        scale: standard deviation of each coordinate under the prior or the posterior, (C,).
        decoded: decoded x, (C, M, B, T, D).
        unit: "prior" or "posterior".
    """

    latent: str
    coordinates: tuple[int, ...]
    offsets: Tensor
    scale: Tensor
    decoded: Tensor
    unit: str

    @property
    def effect(self) -> Tensor:
        """Standard deviation of x over offsets, as a root mean square over sequences, steps and dimensions, (C,)."""
        return self.decoded.var(1, correction=0).mean((1, 2, 3)).sqrt()


@torch.no_grad()
def traverse(
    model: DynamicalVAE,
    batch: AnyBatch,
    latent: str,
    coordinates: Sequence[int] | None = None,
    span: tuple[float, float] = (-3.0, 3.0),
    steps: int = 7,
    *,
    unit: Literal["prior", "posterior"] = "prior",
    free: Sequence[str] = (),
    draws: int = 256,
    seed: int = 0,
) -> Traversal:
    """Decode sequences with one coordinate of a latent shifted at a time, by the same amount at all steps.

    Latents are drawn once from the guide. One coordinate is then shifted and the others are kept. x runs freely, and is
    the mean of its emission. Decoded sequences therefore differ only by the effect of that coordinate on x.

    Args:
        model: model with its guide.
        batch: sequences (B, T, D) to start from, or a mapping with context.
        latent: name of the latent to shift.
        coordinates: coordinates to shift; all by default.
        span: smallest and largest offset, in standard deviations.
        steps: M, number of evenly spaced offsets, which must include 0, the inferred latent.
        unit: standard deviation that is the unit of offsets: of the prior (over free runs and steps), or of the guide
            given the batch.
        free: other latents, drawn from the model with the same noise at each offset, so that they follow the shifted
            one. Required if the latent affects x only through others.
        draws: number of draws for the standard deviation.
        seed: seed of all draws.

    Returns:
        Decoded x (C, M, B, T, D) for C coordinates and M offsets, with offsets (M,) and their units (C,).

    Raises:
        ValueError: when a latent or coordinate is unknown, offsets do not include 0, or the latent does not affect x.

    Example:
        >>> model = dvae.DynamicalVAE("p(w) p(x_t | w)", "q(w | x_{1:T})", {"w": 2, "x": 3})
        >>> result = dvae.traverse(model, torch.randn(4, 5, 3), "w", steps=5)
    """
    if latent not in model.latents or not set(free) <= set(model.latents) - {latent}:
        raise ValueError(
            f"`latent` must be one of {', '.join(model.latents)}, and `free` must list others of these; got "
            f"latent={latent!r} and free={tuple(free)}"
        )
    indices = tuple(range(model.sizes[latent]) if coordinates is None else coordinates)
    if not indices or not set(indices) <= set(range(model.sizes[latent])) or steps < 2 or draws < 2:
        raise ValueError(
            f"coordinates of {latent} must be from 0 to {model.sizes[latent] - 1}, steps and draws at least 2; "
            f"got coordinates={indices}, steps={steps} and draws={draws}"
        )
    offsets = torch.linspace(*span, steps, dtype=torch.float64)
    offsets[offsets.abs() < 1e-9 * offsets.abs().max()] = 0
    if (offsets != 0).all():
        raise ValueError(
            f"{steps} offsets from {span[0]:g} to {span[1]:g} do not include 0, the inferred latent; use an odd number "
            "of steps, and a span that is symmetric about 0"
        )
    if unit not in ("prior", "posterior"):
        raise ValueError(f"unit must be 'prior' or 'posterior', got {unit!r}")
    _check_path(model, latent, free)
    data = model.read(batch)
    if partial := {"lengths", "mask"} & data.keys():
        raise ValueError(f"a traversal needs complete sequences, but these have {', '.join(sorted(partial))}")
    with seeded_evaluation(model, seed):
        scale = _scale(model, data, latent, unit, draws)[list(indices)]
        torch.manual_seed(seed)
        inferred = model.guide(data)
        offsets = offsets.to(scale)
        fixed = {name: value for name, value in inferred.items() if name not in (*free, latent)}
        decoded = []
        for coordinate, unit_scale in zip(indices, scale, strict=True):
            shifted = repeat(inferred[latent], steps).unflatten(0, (steps, -1))
            shifted[..., coordinate] += (offsets * unit_scale).reshape(steps, *[1] * (shifted.dim() - 2))
            # Free latents have the same noise at each offset only in separate runs.
            for group in shifted.split(1 if free else steps):
                torch.manual_seed(seed)
                latents = {**repeat(fixed, len(group)), latent: group.flatten(0, 1)}
                decoded.append(decode(model, repeat(data, len(group)), latents, True))
    shape = (len(indices), steps, -1)
    return Traversal(latent, indices, offsets.cpu(), scale.cpu(), torch.cat(decoded).unflatten(0, shape).cpu(), unit)


def _check_path(model: DynamicalVAE, latent: str, free: Sequence[str]) -> None:
    moving, reach = {latent}, True
    while reach:
        readers = {name for name in (*free, *model.observed) if moving & set(model.generator[name].parents)}
        reach = bool(readers - moving)
        moving |= readers
    if not moving & set(model.observed):
        readers = {name for name in model.latents if latent in model.generator[name].parents}
        raise ValueError(
            f"x does not depend on {latent} directly, so shifting it would change nothing; list the latents that read "
            f"it in `free`: free={tuple(sorted(readers))}"
        )


def _scale(model: DynamicalVAE, data: dict[str, Tensor], latent: str, unit: str, draws: int) -> Tensor:
    """Return standard deviations (D,) of a latent's coordinates over draws.

    Args:
        model: model with its guide.
        data: batch as returned by `read`.
        latent: name of the latent.
        unit: "prior" for draws from the model, pooled over steps; "posterior" for draws from the guide given each
            sequence, whose variances are averaged over sequences and steps.
        draws: number of draws.
    """
    if unit == "prior":
        size, length = data["x"].shape[:2]
        rows = torch.arange(draws) % size
        context = {name: value[rows] for name, value in data.items() if name in model.context}
        values = model.sample(draws, length, context or None)[latent]
        return values.flatten(0, -2).std(0)
    values = model.guide(repeat(data, draws))[latent].unflatten(0, (draws, -1))
    return values.var(0).flatten(0, -2).mean(0).sqrt()
