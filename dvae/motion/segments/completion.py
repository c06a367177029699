"""Prediction and completion: whole segments of motion from whatever was seen of them.

    p(z) p(beta) p(seen | z, beta),    z, beta* = argmax log p(z, beta | seen)

A decoder makes a segment of z, timing included, and a body of beta; both are looked for that agree best with what was
seen (Marsot et al. 2021, arXiv 2106.04387, sections 5.4 and 5.5). What was seen of B segments is one batch, NaN where
nothing was, any mix of

    times     (B, K)        seconds from the first frame of the segment to the moments at which something was seen
    frames    (B, K)        which frames of chi these are, from 0; between two of them, too
    surfaces  (B, K, V, 3)  all vertices, as in the first quarter of a second that is to be continued
    points    (B, K, M, 3)  points of the surface of which nobody knows the vertex, as a scanner sees them
    markers   (B, K, L, 3)  some vertices
    beta      (B, S)        the body, where it is known

in metres, of somebody who starts at the origin, facing heading zero. Moments without a frame are met in the decoded
time, on straight lines between chi's frames. Moments that have both are met at the frame, and its time counts.

The paper adds squared errors, in weights that adapt. Here they are the negative log of normal likelihoods, whose
`Deviations` are the weights: what is minimised is then a posterior's, and a completion knows how sure it is. Of
points, what counts is how far each is from the nearest vertex, one way: a vertex far from all points is no error where
points are few. That is no density of points, so that evidence does not compare bodies by points; and the curvature of
the posterior is that of nearest vertices held fixed, which points tell of more surely than they do: k-hat says so. A
frame's surface counts as one vertex, the mean of all, for its vertices err together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import log, pi, sqrt
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from ...inference.bounds.elbo import ImportanceBound
from ...inference.diagnostics.posteriors import Descent, Posterior, posterior
from ...options import Positive, check
from ...program.conditional import evaluating, like
from ..bodies import MARKERS, Body, vertex_error
from .embodied import SHAPE
from .frames import TimedFrames

LATENT = "z"
TIMES, FRAMES, SURFACES, POINTS, SPOTS = "times", "frames", "surfaces", "points", "markers"
TIME = slice(-1, None)
"""Coordinates of a frame that say when it is."""
NEAREST = "nearest"
"""Name of the vertices (B, K, M) that are taken for the nearest ones of points."""
AT_ONCE, PAIRS = 32, 2**20
"""Frames of which all vertices are held to find the nearest ones; and pairs of points and vertices a cache holds."""
THIN = 16
"""Of so many vertices one stands for a surface of which all are known: that tells no less of joints and a shape."""


@dataclass(frozen=True)
class Deviations:
    """How far what was seen is from what a decoder makes: standard deviations of each coordinate.

    What a decoder cannot make is part of it. Frames next to each other err alike, of which a likelihood with
    independent errors knows nothing: see that intervals hold what they promise on segments that are known. These are
    those that left the least vertex errors on unseen styles (docs/results/motion_latent_4d.md).

    Args:
        surface: metres, of a frame's surface as a whole.
        point: metres, of a point from the nearest vertex; half the way between vertices is part of it.
        marker: metres.
        time: seconds, of a frame from when it was seen, and of a segment's end where it comes too early.
    """

    surface: Positive = 0.02
    point: Positive = 0.1
    marker: Positive = 0.05
    time: Positive = 0.02

    def __post_init__(self) -> None:
        check(self)

    def of(self, name: str) -> float:
        """That of "surfaces", "points" or "markers", in metres."""
        return {SURFACES: self.surface, POINTS: self.point, SPOTS: self.marker}[name]


@dataclass(frozen=True)
class SegmentCompletion:
    """The Pyro program of what was seen, for `dvae.posterior` and for Pyro's own guides (`AutoDelta`, ...).

    Args:
        model: of segments, such as `dvae.models.motion.motion_latent.MotionLatentModel`, of which `decode`, `decoder`,
            `guide`, `timed` and `body` are used.
        deviations: of what was seen.
        markers: the vertices of markers (L,); `bodies.MARKERS` by default.
        known: segments (x and beta), whose latents by the guide are where motion is: starts beside those of the prior.
        aggregate: where segments are known, the prior of z is a normal of what the guide says of them all, its mean and
            its covariance, in place of N(0, I), from which a small weight of the KL lets them stray.
    """

    model: Any
    deviations: Deviations = Deviations()
    markers: Sequence[int] = tuple(MARKERS.values())
    known: Mapping[str, Any] | None = None
    aggregate: bool = True

    def __call__(self, seen: Mapping[str, Any]) -> dict[str, Tensor]:
        """z from `prior` and beta from N(0, I), and what was seen from what is made of them.

        Args:
            seen: see the module; what `read` gave. Where it says nothing of it, nearest vertices are looked for.

        Returns:
            z (B, Z) and beta (B, S).
        """
        model, deviations, kind = self.model, self.deviations, like(self.model)
        size, parameters, prior = len(next(iter(seen.values()))), model.body.parameters_of_shape, self.prior
        with pyro.plate("sequences", size):
            z = pyro.sample(LATENT, prior.expand([size]))
            shape = seen[SHAPE] if SHAPE in seen else pyro.sample(SHAPE, _standard(parameters, kind).expand([size]))
            times, made = self._made(z, shape, seen)
            if TIMES in seen:
                _observe(TIMES, times, seen[TIMES], deviations.time)
            for name, each in made.items():
                counts = each.shape[-2] if name == SURFACES else 1  # as one vertex
                _observe(name, each, seen[name], deviations.of(name) * counts**0.5)
        return {LATENT: z, SHAPE: shape}

    @cached_property
    def prior(self) -> Any:
        """The law of z, of one event (Z,)."""
        if self.known is None or not self.aggregate:
            return _standard(self.model.sizes[LATENT], like(self.model))
        with torch.no_grad(), pyro.poutine.block():  # a program inside another
            law = self.model.posterior(self.known)
        return dist.MultivariateNormal(law.mean.mean(0), _shrunk(law.mean, law.variance.mean(0)))

    @torch.no_grad()
    def away(self, seen: Mapping[str, Any], z: Tensor, shape: Tensor) -> dict[str, Tensor]:
        """How far what was seen is from what is made of z (B, Z) and beta (B, S): mean distances (B,) in metres.

        Args:
            seen: what `read` gave.

        Returns:
            "surfaces", "points" or "markers" to the distances; of points from the nearest vertex.
        """
        made = self._made(z, shape, seen)[1]
        return {name: (each - seen[name]).norm(dim=-1).flatten(1).nanmean(-1) for name, each in made.items()}

    def guide(self, seen: Mapping[str, Any]) -> Any:
        """z of known segments, drawn at random."""
        assert self.known is not None
        chosen = torch.randint(len(self.known["x"]), (len(next(iter(seen.values()))),))
        return self.model.guide({name: value[chosen] for name, value in self.known.items()})

    def renewed(self, seen: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
        """What was seen, with the vertices that are nearest to points where latents have these values."""
        if POINTS not in seen:
            return dict(seen)
        shape = values.get(SHAPE, seen.get(SHAPE))
        met, _ = self._met(values[LATENT], shape, seen)
        rotations, places = self.model.timed.poses(met)
        return {**seen, NEAREST: nearest_vertices(self.model.body, shape, rotations, places, seen[POINTS])}

    def _made(self, z: Tensor, shape: Tensor, seen: Mapping[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """When moments (B, K) are, and where all that was seen at them is made, by name."""
        body = self.model.body
        met, times = self._met(z, shape, seen)
        rotations, places = self.model.timed.poses(met)
        pose, made = (shape, rotations, places), {}
        if SURFACES in seen:
            made[SURFACES] = body.some(*pose, torch.arange(0, len(body.template), THIN, device=z.device))
        if SPOTS in seen:
            made[SPOTS] = body.some(*pose, torch.tensor(self.markers, device=z.device))
        if POINTS in seen:
            which = seen[NEAREST] if NEAREST in seen else nearest_vertices(body, *pose, seen[POINTS])
            made[POINTS] = body.some(*pose, which)
        return times, made

    def _met(self, z: Tensor, shape: Tensor, seen: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
        """`_met` of what is decoded, of which no more is made than is met."""
        frames, made = seen.get(FRAMES), self.model.decoder(z, shape)
        if TIMES not in seen and frames is not None and bool((frames == frames[:1].round()).all()):
            return made(frames[0].long()), frames
        return _along(self.model.timed.times(made(None, TIME)), made, seen)

    def read(self, seen: Mapping[str, Any]) -> dict[str, Tensor]:
        """What was seen, checked, in the model's precision and on its device; of surfaces one vertex in `THIN`.

        Raises:
            ValueError: an unknown name, another shape, nothing seen, or something seen when nobody knows.
        """
        found = {name: torch.as_tensor(value).to(like(self.model)) for name, value in seen.items()}
        body, kinds = self.model.body, [name for name in (SURFACES, POINTS, SPOTS) if name in found]
        moments = next((found[name] for name in (TIMES, FRAMES) if name in found), None)
        if unknown := found.keys() - {TIMES, FRAMES, SURFACES, POINTS, SPOTS, SHAPE}:
            raise ValueError(
                f"there is nothing to be seen called {', '.join(sorted(unknown))}; what is read are {TIMES}, {FRAMES}, "
                f"{SURFACES}, {POINTS}, {SPOTS} and {SHAPE}"
            )
        if moments is None or moments.dim() != 2 or not (kinds or {TIMES, FRAMES} <= found.keys()):
            given = {name: tuple(value.shape) for name, value in found.items()}
            raise ValueError(
                f"what was seen is some of {SURFACES}, {POINTS} and {SPOTS}, at moments (B, K) that {TIMES} or "
                f"{FRAMES} tell; got {given}"
            )
        b, k = moments.shape
        rest: dict[str, tuple[Any, ...]] = {
            **{TIMES: (k,), FRAMES: (k,), SHAPE: (body.parameters_of_shape,)},
            **{SURFACES: (k, len(body.template), 3), SPOTS: (k, len(self.markers), 3)},
            POINTS: (k, "M" if POINTS not in found else found[POINTS].shape[2:3].numel(), 3),
        }
        for name, value in found.items():
            if value.shape != (b, *rest[name]):
                raise ValueError(f"{name} has shape {tuple(value.shape)}, expected {(b, *rest[name])}")
        when = torch.stack([found[name].isfinite() for name in (TIMES, FRAMES) if name in found]).any(0)
        for name in kinds:
            lost = found[name].isfinite().flatten(2).any(-1) & ~when
            if lost.any():
                row, column = lost.nonzero()[0].tolist()
                raise ValueError(f"segment {row} has {name} at moment {column}, but no time and no frame there")
        frames, last = found.get(FRAMES), self.model.timed.frames - 1
        if frames is not None and ((frames < 0) | (frames > last)).any():
            low, high = frames.nan_to_num(0.0).aminmax()
            raise ValueError(f"frames of chi are from 0 to {last}, got {low:g} to {high:g}")
        if SHAPE in found and not found[SHAPE].isfinite().all():
            raise ValueError(f"{SHAPE} is known of all segments, or left out and looked for; got NaN in some")
        return found | ({SURFACES: found[SURFACES][..., ::THIN, :]} if SURFACES in found else {})


@dataclass(frozen=True)
class Completed:
    """Segments that were completed.

    Args:
        program: of what was seen.
        seen: what was seen of them, as it was read.
        posterior: of z, and of beta where that was unknown.
    """

    program: SegmentCompletion
    seen: Mapping[str, Any]
    posterior: Posterior

    @property
    def model(self) -> Any:
        """That made them."""
        return self.program.model

    def evidence(self, particles: int = 200, *, seed: int = 0, chunk: int = 4096) -> ImportanceBound:
        """The log evidence of what was seen, and k-hat: see `Posterior.evidence`."""
        with evaluating(self.model):
            return self.posterior.evidence(self.program, self.seen, particles, seed=seed, chunk=chunk)

    @property
    def x(self) -> Tensor:
        """The most probable frames (B, N, D)."""
        return self._made(self.posterior.mode)[0]

    @property
    def shape(self) -> Tensor:
        """The most probable bodies (B, S), or those that were known."""
        return self._made(self.posterior.mode)[1]

    def draw(self, n: int, seed: int = 0) -> tuple[Tensor, Tensor]:
        """Frames (n, B, N, D) and bodies (n, B, S) from the posterior."""
        return self._made(self.posterior.draw(n, seed))

    @torch.no_grad()
    def _made(self, values: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        z = values[LATENT]
        shape = values.get(SHAPE, self.seen.get(SHAPE)).expand(*z.shape[:-1], -1)  # type: ignore[union-attr]
        return self.model.decode(z, shape), shape


def complete(
    model: Any,
    seen: Mapping[str, Any],
    *,
    deviations: Deviations | None = None,
    markers: Sequence[int] | None = None,
    known: Mapping[str, Any] | None = None,
    aggregate: bool = True,
    descent: Descent | None = None,
    seed: int = 0,
    chunk: int = 128,
    progress: bool = False,
) -> Completed:
    """The rest of segments of which something was seen; all at once.

    Args:
        model: of segments, see `SegmentCompletion`.
        seen: see the module.
        deviations, markers, known, aggregate: see `SegmentCompletion` too.
        descent, seed, chunk, progress: see `dvae.posterior`.

    Raises:
        ValueError: see `SegmentCompletion.read`.
    """
    spots = markers or tuple(MARKERS.values())
    program = SegmentCompletion(model, deviations or Deviations(), spots, known, aggregate)
    data, guide = program.read(seen), None if known is None else program.guide
    how: dict[str, Any] = {"descent": descent, "seed": seed, "chunk": chunk, "progress": progress}
    with evaluating(model):
        found = posterior(program, data, guide=guide, renew=program.renewed, **how)
    return Completed(program, data, found)


def glimpsed(
    model: Any,
    x: Tensor,
    shape: Tensor,
    kind: str,
    *,
    fps: float = 30.0,
    seconds: float | None = None,
    frames: Sequence[int] | None = None,
    points: int = 50,
    gaps: float = 0.0,
    markers: Sequence[int] = tuple(MARKERS.values()),
    seed: int = 0,
) -> dict[str, Tensor]:
    """What somebody would have seen of known segments, to see how well the rest is found.

    Args:
        model: of segments, see `SegmentCompletion`.
        x, shape: frames (B, N, D) on bodies (B, S).
        kind: "surfaces", "points" or "markers".
        fps: moments a second, at known times.
        seconds: from the start that are seen; all by default.
        frames: of chi that are seen in place of such moments, at times that nobody knows.
        points: M, drawn evenly from the surface's triangles.
        gaps: share of points or markers that are missing.
        markers: vertices.
        seed: of points and gaps.

    Raises:
        ValueError: another kind.
    """
    if kind not in (SURFACES, POINTS, SPOTS):
        raise ValueError(f"kind is {kind!r}; expected {SURFACES!r}, {POINTS!r} or {SPOTS!r}")
    generator, lasts = torch.Generator().manual_seed(seed), model.timed.lasts(x)
    if frames is None:
        end = lasts if seconds is None else lasts.clamp(max=seconds)
        moments = (torch.arange(int(end.max() * fps + 1e-3) + 1).to(x) / fps).expand(len(x), -1)
        seen = {TIMES: torch.where(moments <= end[:, None] + 1e-4, moments, torch.nan)}
    else:
        seen = {FRAMES: torch.tensor(frames).to(x).expand(len(x), -1)}
    rotations, places = model.timed.poses(_met(model.timed, x, seen)[0])
    if kind == SPOTS:
        found = model.body.some(shape, rotations, places, torch.tensor(markers))
    else:
        found = model.body(shape, rotations, places)[0]
        if kind == POINTS:
            found = scanned(found, model.body.faces, points, generator)
    kept = torch.rand(found.shape[:-1], generator=generator) >= (0.0 if kind == SURFACES else gaps)
    kept &= next(iter(seen.values())).isfinite()[..., None]
    return {**seen, kind: torch.where(kept[..., None], found, torch.nan)}


def scanned(vertices: Tensor, faces: Tensor, points: int, generator: torch.Generator) -> Tensor:
    """So many points of surfaces (..., V, 3), (..., M, 3): each anywhere on it as probable as anywhere else."""
    first, second, third = (vertices[..., corner, :] for corner in faces.unbind(-1))
    area = (second - first).cross(third - first, dim=-1).norm(dim=-1)
    drawn = torch.multinomial(area.flatten(0, -2), points, replacement=True, generator=generator)
    which = drawn.unflatten(0, area.shape[:-1])[..., None].expand(*area.shape[:-1], points, 3)
    corners = [corner.gather(-2, which) for corner in (first, second, third)]
    across, along = torch.rand(2, *which.shape[:-1], 1, generator=generator).to(vertices)
    across = across.sqrt()  # of a triangle, more lies towards the side than towards the corner
    shares = 1 - across, across * (1 - along), across * along
    return torch.stack([share * corner for share, corner in zip(shares, corners, strict=True)]).sum(0)


def chamfer(points: Tensor, vertices: Tensor) -> Tensor:
    """Mean distance (...,) of points (..., M, 3) from the nearest of the vertices (..., V, 3), metres.

    One way, as few points say nothing of the rest of a surface. Points that are NaN do not count.
    """
    away = torch.cdist(points.nan_to_num(0.0), vertices).amin(-1)
    return torch.where(points.isfinite().all(-1), away, torch.nan).nanmean(-1)


def surfaces_at(model: Any, x: Tensor, shape: Tensor, times: Tensor) -> Tensor:
    """Surfaces (B, K, V, 3) of frames (B, N, D) on bodies (B, S) at times (B, K) in seconds; NaN behind the end."""
    met, reached = _met(model.timed, x, {TIMES: times})
    found: Tensor = model.body(shape, *model.timed.poses(met))[0]
    return torch.where((times <= reached + 1e-4)[..., None, None], found, torch.nan)


def error_by_time(
    model: Any, made: tuple[Tensor, Tensor], truth: tuple[Tensor, Tensor], times: Sequence[float]
) -> tuple[Tensor, Tensor]:
    """How far predictions are from the truth at times, over all segments that are at least so long.

    Where a prediction ends earlier it stays as it ends.

    Args:
        model: of segments.
        made, truth: frames (B, N, D) and bodies (B, S) of each.
        times: K, seconds.

    Returns:
        mean vertex error (K,) in metres, NaN where no segment is so long, and how many are (K,).
    """
    at = torch.tensor(times).to(truth[0]).expand(len(truth[0]), -1)
    theirs = surfaces_at(model, *truth, at)
    met, _ = _met(model.timed, made[0], {TIMES: at})
    ours = model.body(made[1], *model.timed.poses(met))[0]
    errors = vertex_error(ours[:, :, None], theirs[:, :, None])
    return errors.nanmean(0), errors.isfinite().sum(0)


def nearest_vertices(body: Body, shape: Tensor, rotations: Tensor, places: Tensor, points: Tensor) -> Tensor:
    """Which vertices of moving bodies, see `Body.forward`, points (B, K, M, 3) are nearest to, (B, K, M)."""
    found = []
    with torch.no_grad():
        at_once = max(1, AT_ONCE // points.shape[1])
        parts = (part.split(at_once) for part in (shape, rotations, places, points.nan_to_num(0.0)))
        for some in zip(*parts, strict=True):
            vertices = body(*some[:3])[0]
            pairs = max(1, PAIRS // (points.shape[2] * vertices.shape[2]))
            each = zip(vertices.flatten(0, 1).split(pairs), some[3].flatten(0, 1).split(pairs), strict=True)
            for flat, near in each:  # |p - v|^2 less |p|^2, which is the same for all of them
                found.append(torch.baddbmm(flat.square().sum(-1)[:, None], near, flat.mT, alpha=-2).argmin(-1))
    return torch.cat(found).unflatten(0, points.shape[:2])  # type: ignore[no-any-return]


def _shrunk(means: Tensor, variance: Tensor) -> Tensor:
    """Covariance (Z, Z) of a mixture of N normals with these means (N, Z) and, on average, these variances (Z,).

    Shrunk towards its mean variance in all directions by the oracle's approximation (Chen, Wiesel, Eldar and Hero 2010,
    IEEE Transactions on Signal Processing 58:10), so that a few segments do not forbid all that differs from them. It
    takes means for independent, so that many segments of one take are shrunk less than they should be.
    """
    (n, p), away = means.shape, means - means.mean(0)
    found = (away.mT @ away) / n + variance.diag()
    trace, square = found.trace(), found.square().sum()
    spread = (n + 1 - 2 / p) * (square - trace**2 / p)
    share = (((1 - 2 / p) * square + trace**2) / spread).nan_to_num(1.0).clamp(max=1.0)
    return (1 - share) * found + share * trace / p * torch.eye(p).to(found)


def _standard(dimensions: int, kind: Tensor) -> Any:
    return dist.Normal(kind.new_zeros(dimensions), 1.0).to_event(1)


def _observe(name: str, made: Tensor, seen: Tensor, deviation: float) -> None:
    """The log-density of what was seen: as a factor, for a law has a scale for each number and takes its logarithm."""
    known = seen.isfinite()
    away = torch.where(known, seen.nan_to_num(0.0) - made, 0.0).flatten(1).square().sum(-1)
    pyro.factor(name, -away / (2 * deviation**2) - known.flatten(1).sum(-1) * log(deviation * sqrt(2 * pi)))


def _met(timed: TimedFrames, x: Tensor, seen: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
    """Frames (B, K, D) at the moments that were seen, of frames (B, N, D), and when these are, (B, K) in seconds.

    Moments behind the end are at the end, whose time says by how much too early it comes.
    """
    return _along(timed.times(x), lambda frames: x if frames is None else x[:, frames], seen)


def _along(decoded: Tensor, made: Callable[[Tensor | None], Tensor], seen: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
    """`_met` of frames at these times (B, N), of which those that lie at moments are made, or all (None)."""
    many = decoded.shape[1]
    times = seen.get(TIMES, torch.full_like(seen[FRAMES], torch.nan) if FRAMES in seen else None)
    at = times.nan_to_num(0.0)
    before = torch.searchsorted(decoded.detach(), at.contiguous(), right=True).sub(1).clamp(0, many - 2)
    ends = torch.stack([before, before + 1], -1)
    start, end = (decoded.gather(1, each) for each in ends.unbind(-1))
    share = ((at - start) / (end - start)).clamp(0, 1)
    if FRAMES in seen:
        frames = seen[FRAMES].nan_to_num(0.0)
        located, around = seen[FRAMES].isfinite(), torch.stack([frames.floor(), frames.ceil()], -1)
        ends = torch.where(located[..., None], around.long(), ends)
        share = torch.where(located, frames - around[..., 0], share)
        start, end = (decoded.gather(1, each) for each in ends.unbind(-1))
    needed = torch.zeros(many, dtype=torch.bool, device=ends.device).index_fill(0, ends.flatten(), True)
    if few := 2 * int(needed.sum()) <= many:  # of more, choosing takes longer than making all
        ends = (needed.cumsum(0) - 1)[ends]
    x = made(needed.nonzero().squeeze(1) if few else None)
    weights = torch.stack([1 - share, share], -1)
    # by a product of matrices, whose gradient is one too: that of an index is as large as x, once for each
    lines = torch.zeros(*share.shape, x.shape[1]).to(x).scatter_add(2, ends, weights)
    return lines @ x, torch.lerp(start, end, share)
