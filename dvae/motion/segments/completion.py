"""Prediction and completion: infer whole segments of motion from partial observations.

    p(z) p(beta) p(observations | z, beta),    z, beta* = argmax log p(z, beta | observations)

A decoder maps z to a segment with its timing, and beta to a body. The search finds the most probable z and beta given
the observations (Marsot et al. 2021, arXiv 2106.04387, sections 5.4 and 5.5). The observations of B segments are one
batch with some of these entries, in metres, NaN where unobserved:

    times     (B, K)        seconds from the first frame of the segment to the observed moments
    frames    (B, K)        the corresponding frames of chi, from 0; fractions are allowed
    surfaces  (B, K, V, 3)  all vertices, e.g. in the first quarter of a second, to predict the rest
    points    (B, K, M, 3)  points on the surface without known vertices, as from a scanner
    markers   (B, K, L, 3)  some vertices
    beta      (B, S)        the body, if it is known

The person starts at the origin with heading zero. A moment without a frame is located by its time, with linear
interpolation between the decoded times of the frames of chi. A moment with a frame is located at this frame, and its
time, if given, is an observation.

The paper adds squared errors with adaptive weights. Here the squared errors are negative log densities of normal
distributions, and the `Deviations` act as weights. The minimum of their sum is therefore the mode of a posterior, which
also gives the uncertainty of a completion.

For points, the error is the distance of each point to the nearest vertex. By default the error is one-sided: a vertex
far from all points is not an error, because points may be few. With `two_way`, each vertex also has an error, the
distance to the nearest observed point of its frame, as in a Chamfer distance; both directions have the same total
weight. The paper does not say which Chamfer distance it uses. These errors do not define a density of points, so the
evidence cannot compare bodies by points. The curvature of the posterior treats the nearest vertices as fixed, which
overstates the information in points; a high k-hat reveals this.

The surface of a frame counts as a single vertex with the mean squared error of all vertices, because errors of
neighbouring vertices are correlated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import pi, sqrt
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from ...inference.bounds.elbo import IWAEBound
from ...inference.diagnostics.posteriors import Descent, Posterior, posterior
from ...options import Positive, check
from ...program.conditional import evaluating, like
from ..bodies import MARKERS, Body, vertex_error
from ..bodies.fitting import is_from_file
from .embodied import SHAPE
from .frames import TimedFrames

LATENT = "z"
TIMES, FRAMES, SURFACES, POINTS, SPOTS = "times", "frames", "surfaces", "points", "markers"
TIME = slice(-1, None)
"""Slice of a frame's coordinates that selects its time increment."""
NEAREST, NEAREST_POINTS = "nearest", "nearest points"
"""Names of the indices (B, K, M) of the vertices nearest to points, and (B, K, V) of the points nearest to vertices."""
TO_POINTS = "surface to points"
"""Name of the distances of vertices from the nearest points."""
AT_ONCE, PAIRS = 32, 2**20
"""Maximum number of frames whose vertices are all in memory, and of pairs of a point and a vertex compared at once.

The second is chosen so that the pairs fit into a processor's cache."""
THIN = 16
"""Stride of the vertices used for a complete surface; a subset determines joints and shape equally well."""


@dataclass(frozen=True)
class Deviations:
    """Standard deviations of observations from the decoded motion, per coordinate.

    They include the error of the decoder. Errors of neighbouring frames are correlated, but the likelihood assumes
    independent errors: verify the coverage of intervals on known segments. The defaults had the smallest vertex errors
    on unseen styles (benchmarks/results/motion_latent_4d).

    Args:
        surface: deviation in metres of the surface of a frame as a whole.
        point: deviation in metres of a point from the nearest vertex, including half the distance between vertices.
        marker: deviation in metres of a marker.
        time: deviation in seconds between the decoded and the observed time of a frame. For observations after the
            decoded end of the segment, deviation between the end and their time.
    """

    surface: Positive = 0.02
    point: Positive = 0.1
    marker: Positive = 0.05
    time: Positive = 0.02

    def __post_init__(self) -> None:
        check(self)

    def of(self, name: str) -> float:
        """Return the standard deviation in metres of one kind of observation: "surfaces", "points" or "markers"."""
        return {SURFACES: self.surface, POINTS: self.point, SPOTS: self.marker}[name]


@dataclass(frozen=True)
class SegmentCompletion:
    """Pyro program of the observations, for `dvae.posterior` and for Pyro's own guides (`AutoDelta`, ...).

    Args:
        model: model of segments, such as `dvae.models.motion.motion_latent.MotionLatentModel`, with `decode`,
            `decoder`, `guide`, `timed` and `body`.
        deviations: standard deviations of the observations.
        markers: (L,), vertex index of each marker; default: `bodies.MARKERS`.
        known: known segments, x (B, N, D) and beta (B, S). The search then also starts from the guide's latents for
            these segments.
        aggregate: whether to estimate the prior of z from `known`. The prior is then a normal distribution with the
            mean and covariance of the guide's latents for all known segments, instead of N(0, I). The two differ if the
            model was trained with a small KL weight. Without `known`, the prior is N(0, I).
        two_way: whether vertices far from all points are errors, too.
    """

    model: Any
    deviations: Deviations = Deviations()
    markers: Sequence[int] = tuple(MARKERS.values())
    known: Mapping[str, Any] | None = None
    aggregate: bool = True
    two_way: bool = False

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Tensor]:
        """Sample z from `prior` and beta from N(0, I), and score the observations given the decoded motion.

        Args:
            observations: result of `read`. Vertices nearest to points are computed unless `renewed` has added them.

        Returns:
            z (B, Z) and beta (B, S).
        """
        model, deviations, kind = self.model, self.deviations, like(self.model)
        size, parameters, prior = len(next(iter(observations.values()))), model.body.parameters_of_shape, self.prior
        with pyro.plate("sequences", size):
            z = pyro.sample(LATENT, prior.expand([size]))
            shape = (
                observations[SHAPE]
                if SHAPE in observations
                else pyro.sample(SHAPE, _standard(parameters, kind).expand([size]))
            )
            times, decoded = self._decode(z, shape, observations, self.two_way)
            if TIMES in observations:
                _observe(TIMES, times, observations[TIMES], deviations.time)
            for name, value in decoded.items():
                if name != TO_POINTS:
                    counts = value.shape[-2] if name == SURFACES else 1  # as one vertex
                    _observe(name, value, observations[name], deviations.of(name) * counts**0.5)
                else:  # all vertices of a frame weigh as much as its points
                    points = observations[POINTS].isfinite().all(-1).sum(-1).clip(min=1)[..., None, None]
                    deviation = deviations.point * (value.shape[-2] / points.to(value)).sqrt()
                    _observe(name, value, _near_points(value, observations), deviation)
        return {LATENT: z, SHAPE: shape}

    @cached_property
    def prior(self) -> Any:
        """Prior distribution of z with event shape (Z,)."""
        if self.known is None or not self.aggregate:
            return _standard(self.model.sizes[LATENT], like(self.model))
        with torch.no_grad(), pyro.poutine.block():  # hides the inner program
            distribution = self.model.posterior(self.known)
        return dist.MultivariateNormal(
            distribution.mean.mean(0), _shrink(distribution.mean, distribution.variance.mean(0))
        )

    @torch.no_grad()
    def distances(self, observations: Mapping[str, Any], z: Tensor, shape: Tensor) -> dict[str, Tensor]:
        """Return mean distances (B,) in metres between the observations and the motion decoded from z and beta.

        Args:
            observations: result of `read`.
            z: (B, Z).
            shape: (B, S).

        Returns:
            Mapping from "surfaces", "points" or "markers" to the distances; for points, to the nearest vertex. With
            points, "surface to points" has the distances from vertices to the nearest point of their frame.
        """
        decoded = self._decode(z, shape, observations, True)[1]
        targets = dict(observations)
        if TO_POINTS in decoded:
            targets[TO_POINTS] = _near_points(decoded[TO_POINTS], observations)
        return {name: (value - targets[name]).norm(dim=-1).flatten(1).nanmean(-1) for name, value in decoded.items()}

    def guide(self, observations: Mapping[str, Any]) -> Any:
        """Sample z from the model's guide for randomly chosen known segments, one for each observed segment.

        Args:
            observations: result of `read`; only the number of segments is used.
        """
        assert self.known is not None
        rows = torch.randint(len(self.known["x"]), (len(next(iter(observations.values()))),))
        return self.model.guide({name: value[rows] for name, value in self.known.items()})

    def renewed(self, observations: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the observations with updated indices of nearest vertices and, with `two_way`, of nearest points.

        Args:
            observations: result of `read`.
            values: z (B, Z), and beta (B, S) unless it was observed; the points are compared with the decoded surfaces.
        """
        if POINTS not in observations:
            return dict(observations)
        shape = values.get(SHAPE, observations.get(SHAPE))
        frames, _ = self._at_moments(values[LATENT], shape, observations)
        rotations, places = self.model.timed.poses(frames)
        pose = shape, rotations, places
        renewed = {**observations, NEAREST: nearest_vertices(self.model.body, *pose, observations[POINTS])}
        if self.two_way:
            renewed[NEAREST_POINTS] = _nearest_points(self._thin_surface(*pose), observations[POINTS])
        return renewed

    def _thin_surface(self, shape: Tensor, rotations: Tensor, places: Tensor) -> Tensor:
        """Return every `THIN`-th vertex (B, K, V, 3)."""
        vertices = torch.arange(0, len(self.model.body.template), THIN, device=shape.device)
        return self.model.body.select_vertices(shape, rotations, places, vertices)  # type: ignore[no-any-return]

    def _decode(
        self, z: Tensor, shape: Tensor, observations: Mapping[str, Any], both: bool
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the times (B, K) of the moments, and the decoded counterparts of all observations by name.

        With points, `both` adds vertices, to compare them with the nearest points.
        """
        body = self.model.body
        frames, times = self._at_moments(z, shape, observations)
        rotations, places = self.model.timed.poses(frames)
        pose, decoded = (shape, rotations, places), {}
        if SURFACES in observations:
            decoded[SURFACES] = self._thin_surface(*pose)
        if SPOTS in observations:
            decoded[SPOTS] = body.select_vertices(*pose, torch.tensor(self.markers, device=z.device))
        if POINTS in observations:
            vertices = (
                observations[NEAREST]
                if NEAREST in observations
                else nearest_vertices(body, *pose, observations[POINTS])
            )
            decoded[POINTS] = body.select_vertices(*pose, vertices)
            if both:
                decoded[TO_POINTS] = self._thin_surface(*pose)
        return times, decoded

    def _at_moments(self, z: Tensor, shape: Tensor, observations: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
        """Return the frames (B, K, D) of the decoded segments at the observed moments, and their times or indices.

        Only the needed frames are decoded. The second result is the times (B, K) in seconds. If times were not observed
        and all segments share whole frame indices, it is these indices instead, because times are not needed.
        """
        frames, decode = observations.get(FRAMES), self.model.decoder(z, shape)
        if TIMES not in observations and frames is not None and bool((frames == frames[:1].round()).all()):
            return decode(frames[0].long()), frames
        return _interpolate(self.model.timed.times(decode(None, TIME)), decode, observations)

    def read(self, observations: Mapping[str, Any]) -> dict[str, Tensor]:
        """Validate observations, and convert them to the model's precision and device.

        Args:
            observations: values in the format of this module.

        Returns:
            The same observations as tensors; surfaces keep only every `THIN`-th vertex.

        Raises:
            ValueError: a name is unknown, a shape is wrong, observations are empty, an observation has neither time nor
                frame, a frame is out of range, or beta is NaN in some segments.
        """
        tensors = {name: torch.as_tensor(value).to(like(self.model)) for name, value in observations.items()}
        body, kinds = self.model.body, [name for name in (SURFACES, POINTS, SPOTS) if name in tensors]
        moments = next((tensors[name] for name in (TIMES, FRAMES) if name in tensors), None)
        if unknown := tensors.keys() - {TIMES, FRAMES, SURFACES, POINTS, SPOTS, SHAPE}:
            raise ValueError(
                f"unknown observations {', '.join(sorted(unknown))}; expected some of {TIMES}, {FRAMES}, "
                f"{SURFACES}, {POINTS}, {SPOTS} and {SHAPE}"
            )
        if moments is None or moments.dim() != 2 or not (kinds or {TIMES, FRAMES} <= tensors.keys()):
            shapes = {name: tuple(value.shape) for name, value in tensors.items()}
            raise ValueError(
                f"expected observations {SURFACES}, {POINTS} or {SPOTS}, with their moments (B, K) in {TIMES} or "
                f"{FRAMES}; got {shapes}"
            )
        if SPOTS in tensors:
            _check_markers(body, self.markers)
        b, k = moments.shape
        trailing_shapes: dict[str, tuple[Any, ...]] = {
            **{TIMES: (k,), FRAMES: (k,), SHAPE: (body.parameters_of_shape,)},
            **{SURFACES: (k, len(body.template), 3), SPOTS: (k, len(self.markers), 3)},
            POINTS: (k, "M" if POINTS not in tensors else tensors[POINTS].shape[2:3].numel(), 3),
        }
        for name, value in tensors.items():
            if value.shape != (b, *trailing_shapes[name]):
                raise ValueError(f"{name} has shape {tuple(value.shape)}, expected {(b, *trailing_shapes[name])}")
        has_time = torch.stack([tensors[name].isfinite() for name in (TIMES, FRAMES) if name in tensors]).any(0)
        for name in kinds:
            untimed = tensors[name].isfinite().flatten(2).any(-1) & ~has_time
            if untimed.any():
                row, column = untimed.nonzero()[0].tolist()
                raise ValueError(f"segment {row} has {name} at moment {column}, but no time and no frame there")
        frames, last = tensors.get(FRAMES), self.model.timed.frames - 1
        if frames is not None and ((frames < 0) | (frames > last)).any():
            low, high = frames.nan_to_num(0.0).aminmax()
            raise ValueError(f"frames of chi must be from 0 to {last}, got {low:g} to {high:g}")
        if SHAPE in tensors and not tensors[SHAPE].isfinite().all():
            raise ValueError(f"{SHAPE} must be given for all segments, or left out to be estimated; got NaN in some")
        return tensors | ({SURFACES: tensors[SURFACES][..., ::THIN, :]} if SURFACES in tensors else {})


@dataclass(frozen=True)
class Completed:
    """Completed segments and their posterior.

    Args:
        program: program of the observations.
        observations: observed values, as returned by `SegmentCompletion.read`.
        posterior: posterior of z, and of beta if it was unknown.
    """

    program: SegmentCompletion
    observations: Mapping[str, Any]
    posterior: Posterior

    @property
    def model(self) -> Any:
        """The model that decodes the segments."""
        return self.program.model

    def evidence(self, particles: int = 200, *, seed: int = 0, chunk: int = 4096) -> IWAEBound:
        """Return the log evidence of the observations in nats, (B,), by importance sampling, with its k-hat.

        Args:
            particles: K, number of draws from the normal approximation of the posterior.
            seed: seed of the draws.
            chunk: largest number of segments times particles in memory.
        """
        with evaluating(self.model):
            return self.posterior.evidence(self.program, self.observations, particles, seed=seed, chunk=chunk)

    @property
    def x(self) -> Tensor:
        """The most probable frames (B, N, D)."""
        return self._decode(self.posterior.mode)[0]

    @property
    def shape(self) -> Tensor:
        """The most probable shape parameters (B, S), or the observed ones."""
        return self._decode(self.posterior.mode)[1]

    def draw(self, n: int, seed: int = 0) -> tuple[Tensor, Tensor]:
        """Draw n frames (n, B, N, D) and shape parameters (n, B, S) from the posterior."""
        return self._decode(self.posterior.draw(n, seed))

    @torch.no_grad()
    def _decode(self, values: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        z = values[LATENT]
        shape = values.get(SHAPE, self.observations.get(SHAPE)).expand(*z.shape[:-1], -1)  # type: ignore[union-attr]
        return self.model.decode(z, shape), shape


def complete(
    model: Any,
    observations: Mapping[str, Any],
    *,
    deviations: Deviations | None = None,
    markers: Sequence[int] | None = None,
    known: Mapping[str, Any] | None = None,
    aggregate: bool = True,
    two_way: bool = False,
    descent: Descent | None = None,
    seed: int = 0,
    chunk: int = 128,
    progress: bool = False,
) -> Completed:
    """Complete partially observed segments, all at once.

    Args:
        model: model of segments, as in `SegmentCompletion`.
        observations: values in the format of this module.
        deviations, markers, known, aggregate, two_way: same as in `SegmentCompletion`.
        descent, seed, chunk, progress: same as in `dvae.posterior`.

    Returns:
        The most probable segments (`x`, `shape`) and their posterior.

    Raises:
        ValueError: same as `SegmentCompletion.read`.
    """
    spots = tuple(markers or MARKERS.values())
    program = SegmentCompletion(model, deviations or Deviations(), spots, known, aggregate, two_way)
    data, guide = program.read(observations), None if known is None else program.guide
    options: dict[str, Any] = {"descent": descent, "seed": seed, "chunk": chunk, "progress": progress}
    with evaluating(model):
        result = posterior(program, data, guide=guide, renew=program.renewed, **options)
    return Completed(program, data, result)


def simulate_observations(
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
    markers: Sequence[int] | None = None,
    seed: int = 0,
) -> dict[str, Tensor]:
    """Return simulated observations of known segments, to evaluate their completion.

    Args:
        model: model of segments, as in `SegmentCompletion`.
        x, shape: frames (B, N, D), and shape parameters (B, S) of their bodies.
        kind: kind of observations: "surfaces", "points" or "markers".
        fps: number of observed moments per second; their times are part of the observations.
        seconds: duration in seconds that is observed from the start; default: the whole segment.
        frames: indices of the observed frames of chi. If given, times are not observed, and `fps` and `seconds` are
            ignored.
        points: number of points M per moment, drawn uniformly from the surface.
        gaps: fraction of points or markers that are missing.
        markers: (L,), vertex index of each marker; default: `bodies.MARKERS`.
        seed: seed of points and gaps.

    Returns:
        Observations in the format of this module, NaN where missing or after the end of a segment.

    Raises:
        ValueError: the kind is unknown.
    """
    if kind not in (SURFACES, POINTS, SPOTS):
        raise ValueError(f"kind is {kind!r}; expected {SURFACES!r}, {POINTS!r} or {SPOTS!r}")
    generator, lasts = torch.Generator().manual_seed(seed), model.timed.lasts(x)
    if frames is None:
        end = lasts if seconds is None else lasts.clamp(max=seconds)
        moments = (torch.arange(int(end.max() * fps + 1e-3) + 1).to(x) / fps).expand(len(x), -1)
        observations = {TIMES: torch.where(moments <= end[:, None] + 1e-4, moments, torch.nan)}
    else:
        observations = {FRAMES: torch.tensor(frames).to(x).expand(len(x), -1)}
    rotations, places = model.timed.poses(_at_moments(model.timed, x, observations)[0])
    if kind == SPOTS:
        vertices = tuple(markers or MARKERS.values())
        _check_markers(model.body, vertices)
        positions = model.body.select_vertices(shape, rotations, places, torch.tensor(vertices))
    else:
        positions = model.body(shape, rotations, places)[0]
        if kind == POINTS:
            positions = sample_surfaces(positions, model.body.faces, points, generator)
    observed = torch.rand(positions.shape[:-1], generator=generator) >= (0.0 if kind == SURFACES else gaps)
    observed &= next(iter(observations.values())).isfinite()[..., None]
    return {**observations, kind: torch.where(observed[..., None], positions, torch.nan)}


def _check_markers(body: Body, markers: Sequence[int]) -> None:
    """Raise an error if a marker is not a vertex of the body, or if the default markers are used on another body."""
    if tuple(markers) == tuple(MARKERS.values()) and is_from_file(body):
        raise ValueError(
            "the default markers are vertices of the bundled person; give the vertices of this body as `markers` "
            "(`--marker-vertices`)"
        )
    if wrong := [vertex for vertex in markers if not 0 <= vertex < len(body.template)]:
        raise ValueError(
            f"marker vertex {wrong[0]} does not exist; the body has vertices 0 to {len(body.template) - 1}"
        )


def sample_surfaces(vertices: Tensor, faces: Tensor, points: int, generator: torch.Generator) -> Tensor:
    """Draw points (..., M, 3) uniformly from surfaces.

    Args:
        vertices: (..., V, 3).
        faces: (F, 3), vertex indices of triangles.
        points: number of points M per surface.
        generator: source of random numbers.
    """
    first, second, third = (vertices[..., corner, :] for corner in faces.unbind(-1))
    area = (second - first).cross(third - first, dim=-1).norm(dim=-1)
    triangles = torch.multinomial(area.flatten(0, -2), points, replacement=True, generator=generator)
    indices = triangles.unflatten(0, area.shape[:-1])[..., None].expand(*area.shape[:-1], points, 3)
    corners = [corner.gather(-2, indices) for corner in (first, second, third)]
    across, along = torch.rand(2, *indices.shape[:-1], 1, generator=generator).to(vertices)
    across = across.sqrt()  # a triangle is wider near its side than near its corner
    shares = 1 - across, across * (1 - along), across * along
    return torch.stack([share * corner for share, corner in zip(shares, corners, strict=True)]).sum(0)


def chamfer(points: Tensor, vertices: Tensor) -> Tensor:
    """Return the mean distance (...,) of points (..., M, 3) to the nearest of the vertices (..., V, 3), in metres.

    The distance is one-sided, because few points do not cover the whole surface. NaN points are ignored. For the other
    direction of a Chamfer distance, exchange the arguments, without NaN.
    """
    exact = "donot_use_mm_for_euclid_dist"  # products of float32 lose a millimetre at 10 m from the origin
    distances = torch.cdist(points.nan_to_num(0.0), vertices, compute_mode=exact).amin(-1)
    return torch.where(points.isfinite().all(-1), distances, torch.nan).nanmean(-1)


def surfaces_at(model: Any, x: Tensor, shape: Tensor, times: Tensor) -> Tensor:
    """Return surfaces (B, K, V, 3) in metres at given times; NaN after the end of a segment.

    Args:
        model: model of segments, as in `SegmentCompletion`.
        x, shape: frames (B, N, D), and shape parameters (B, S) of their bodies.
        times: (B, K) in seconds from the first frame.
    """
    frames, reached = _at_moments(model.timed, x, {TIMES: times})
    surfaces: Tensor = model.body(shape, *model.timed.poses(frames))[0]
    return torch.where((times <= reached + 1e-4)[..., None, None], surfaces, torch.nan)


def error_by_time(
    model: Any, predictions: tuple[Tensor, Tensor], truth: tuple[Tensor, Tensor], times: Sequence[float]
) -> tuple[Tensor, Tensor]:
    """Return the error of predictions at given times, over all segments that are long enough.

    A prediction that ends earlier keeps its last pose.

    Args:
        model: model of segments, as in `SegmentCompletion`.
        predictions, truth: predicted and true segments, each as frames (B, N, D) and shape parameters (B, S).
        times: K times in seconds from the first frame.

    Returns:
        mean vertex error (K,) in metres, NaN if no segment is long enough, and the number of segments (K,).
    """
    moments = torch.tensor(times).to(truth[0]).expand(len(truth[0]), -1)
    true_surfaces = surfaces_at(model, *truth, moments)
    frames, _ = _at_moments(model.timed, predictions[0], {TIMES: moments})
    surfaces = model.body(predictions[1], *model.timed.poses(frames))[0]
    errors = vertex_error(surfaces[:, :, None], true_surfaces[:, :, None])
    return errors.nanmean(0), errors.isfinite().sum(0)


def nearest_vertices(body: Body, shape: Tensor, rotations: Tensor, places: Tensor, points: Tensor) -> Tensor:
    """Return indices (B, K, M) of the vertices nearest to points (B, K, M, 3).

    The pose is given by `shape`, `rotations` and `places` (translation), as in `Body.forward`.
    """
    indices = []
    with torch.no_grad():
        at_once = max(1, AT_ONCE // points.shape[1])
        parts = (part.split(at_once) for part in (shape, rotations, places, points.nan_to_num(0.0)))
        for batch in zip(*parts, strict=True):
            vertices = body(*batch[:3])[0]
            pairs = max(1, PAIRS // (points.shape[2] * vertices.shape[2]))
            blocks = zip(vertices.flatten(0, 1).split(pairs), batch[3].flatten(0, 1).split(pairs), strict=True)
            for flat, near in blocks:  # |p - v|^2 - |p|^2; the second term is constant
                indices.append(torch.baddbmm(flat.square().sum(-1)[:, None], near, flat.mT, alpha=-2).argmin(-1))
    return torch.cat(indices).unflatten(0, points.shape[:2])  # type: ignore[no-any-return]


def _nearest_points(vertices: Tensor, points: Tensor) -> Tensor:
    """Return indices (B, K, V) of the observed points (B, K, M, 3) nearest to vertices (B, K, V, 3)."""
    with torch.no_grad():
        distances = torch.cdist(vertices, points.nan_to_num(0.0))
        return distances.masked_fill(~points.isfinite().all(-1)[..., None, :], torch.inf).argmin(-1)


def _near_points(vertices: Tensor, observations: Mapping[str, Any]) -> Tensor:
    """Return the points (B, K, V, 3) nearest to vertices, NaN in frames without points."""
    points = observations[POINTS]
    nearest = observations[NEAREST_POINTS] if NEAREST_POINTS in observations else _nearest_points(vertices, points)
    near: Tensor = points.gather(-2, nearest[..., None].expand(*nearest.shape, 3))
    return near


def _shrink(means: Tensor, variance: Tensor) -> Tensor:
    """Return the covariance (Z, Z) of a mixture of N normals, shrunk towards a multiple of the identity.

    The estimator is oracle approximating shrinkage (Chen, Wiesel, Eldar and Hero 2010, IEEE Transactions on Signal
    Processing 58:10). Without it, a prior from few segments would exclude different segments. The estimator assumes
    independent means, so it shrinks too little if many segments are from the same take.

    Args:
        means: means (N, Z) of the normals.
        variance: variances (Z,), averaged over the normals.
    """
    (n, p), centred = means.shape, means - means.mean(0)
    covariance = (centred.mT @ centred) / n + variance.diag()
    trace, square = covariance.trace(), covariance.square().sum()
    spread = (n + 1 - 2 / p) * (square - trace**2 / p)
    share = (((1 - 2 / p) * square + trace**2) / spread).nan_to_num(1.0).clamp(max=1.0)
    return (1 - share) * covariance + share * trace / p * torch.eye(p).to(covariance)


def _standard(dimensions: int, kind: Tensor) -> Any:
    return dist.Normal(kind.new_zeros(dimensions), 1.0).to_event(1)


def _observe(name: str, decoded: Tensor, observations: Tensor, deviation: float | Tensor) -> None:
    """Add the normal log density of observations as one `pyro.factor` per segment.

    This is faster than `pyro.sample` with `obs`, which would compute a logarithm for each value.

    Args:
        name: name of the factor.
        decoded: expected observations, same shape as `observations`.
        observations: observed values (B, ...), NaN where missing.
        deviation: standard deviation of all values, or of each.
    """
    observed = observations.isfinite()
    errors = torch.where(observed, observations.nan_to_num(0.0) - decoded, 0.0) / deviation
    constants = observed * (torch.as_tensor(deviation).to(errors) * sqrt(2 * pi)).log()
    pyro.factor(name, -(errors.square() / 2 + constants).flatten(1).sum(-1))


def _at_moments(timed: TimedFrames, x: Tensor, observations: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
    """Return the frames (B, K, D) at the observed moments, from frames (B, N, D), and their times (B, K) in seconds.

    Moments after the end use the last frame; its time then shows how much too early the segment ends.
    """
    return _interpolate(timed.times(x), lambda frames: x if frames is None else x[:, frames], observations)


def _interpolate(
    decoded: Tensor, decode: Callable[[Tensor | None], Tensor], observations: Mapping[str, Any]
) -> tuple[Tensor, Tensor]:
    """Return the frames (B, K, D) at the observed moments and their times (B, K), and decode only needed frames.

    Args:
        decoded: times (B, N) of all frames in seconds.
        decode: function from frame indices, or None for all frames, to these frames (B, n, D).
        observations: observed values with times or frames.
    """
    n_frames = decoded.shape[1]
    times = observations.get(
        TIMES, torch.full_like(observations[FRAMES], torch.nan) if FRAMES in observations else None
    )
    moments = times.nan_to_num(0.0)
    before = torch.searchsorted(decoded.detach(), moments.contiguous(), right=True).sub(1).clamp(0, n_frames - 2)
    ends = torch.stack([before, before + 1], -1)
    start, end = (decoded.gather(1, columns) for columns in ends.unbind(-1))
    share = ((moments - start) / (end - start)).clamp(0, 1)
    if FRAMES in observations:
        frames = observations[FRAMES].nan_to_num(0.0)
        located, around = observations[FRAMES].isfinite(), torch.stack([frames.floor(), frames.ceil()], -1)
        ends = torch.where(located[..., None], around.long(), ends)
        share = torch.where(located, frames - around[..., 0], share)
        start, end = (decoded.gather(1, columns) for columns in ends.unbind(-1))
    is_needed = torch.zeros(n_frames, dtype=torch.bool, device=ends.device).index_fill(0, ends.flatten(), True)
    if few := 2 * int(is_needed.sum()) <= n_frames:  # for more frames, selection takes longer than decoding all
        ends = (is_needed.cumsum(0) - 1)[ends]
    x = decode(is_needed.nonzero().squeeze(1) if few else None)
    weights = torch.stack([1 - share, share], -1)
    # a matrix product has a cheap gradient; the gradient of indexing is as large as x for each index
    interpolation = torch.zeros(*share.shape, x.shape[1]).to(x).scatter_add(2, ends, weights)
    return interpolation @ x, torch.lerp(start, end, share)
