"""Scores of forecast motion, for `dvae.evaluate(models, windows, scores=dvae.motion.scores)`.

Motion papers compare K futures with the true one in metres (`displacements`; definitions in
`dvae.motion.scoring.metrics`). Their futures are means of the emission. Forecasts are therefore means by default
(`Measure.of_means`), and the table says "mean emission"; `draw_emission=True` adds the noise of the emission. If
windows include global motion (a protocol whose root is not "drop"), these scores compare poses relative to their own
root, as in TrajeVAE's evaluation. "global ADE" and "global FDE" compare all joints in world coordinates. If the paths
of the same joints are given in all windows, "path error" is the mean distance of these joints from their paths, over
all K futures.

Two scores compare diversity and motion with their true amounts (BeLFusion: Barquero, Escalera and Palmero 2023,
arXiv:2211.14304). *APDE* is |APD of the futures - APD of the multimodal ground truth|, averaged over the windows whose
last pose is shared by another window. *CMD* (`cumulative_motion_distance`) compares the motion of joints between
frames. As in the public code, it is computed for each class of motion, and averaged with weights proportional to the
number of windows. The class of a clip is its label "content"; without such labels, all windows form one class. The pace
of a class is the pace of the true futures of the evaluated windows; the public code uses a constant for each of its
data sets. CMD is one number for the whole set, with a jackknife over clips. Real motion does not score 0, because its
pace varies. If joints are missing, a step of a joint counts only if the true joint was observed in both frames. The
same steps are left out of the futures.

Three scores measure the body: limb stretch, limb jitter and limb-angle error (SkeletonDiffusion: Curreli et al. 2025,
arXiv:2501.06035, equation 13). Let l_t be the length of a limb in frame t of a future, and m its mean length over the
frames of the true future. *Limb stretch* is mean_t |l_t - m| / m and *limb jitter* is mean_t |l_{t+1} - l_t| / m; the
"RMS" versions use the root of the mean square. All are averaged over limbs and futures. For the mean stretch, the
public code uses |mean_t l_t - m| / m, which ignores variation about the mean; we follow the paper. The *limb-angle
error* is the error of the angle between adjacent limbs in degrees, averaged over frames and joints, of the best future.
It is the mean angle error (MAE) of the public code. We report fractions instead of percentages, and use all limbs; the
public code leaves out the limbs at the pelvis and uses angles along its own choice of chains. The *bone-length error*
compares with the observed frames. Bones shorter than `SHORTEST` in some window are excluded from all these scores,
because some files put both ends at one place. A note gives their number.

*Jerk* is the length of the third derivative of a joint's position, by third differences, in m/s³, averaged over frames,
joints and futures. It is high for motion that shakes or does not continue the observed motion, and low for motion that
stands still. The last three observed frames are included. The jerk of real motion is in the notes of the table.

A classifier adds two scores with its name (Bie et al. 2022, arXiv:2204.01565). *ACC* is the fraction of the K futures
that it assigns to the true class of the window. *FID* is the Fréchet distance between its features of the true futures
and of all K generated ones of all windows. It is one number for the whole set; its standard error is a jackknife over
clips (`metrics.frechet_pseudo_values`).
"""

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from typing import Any

import torch
from torch import Tensor, nn

from ...constants import indices
from ...data.batch import Batch
from ...data.sequences import HeldOutWindows, interpolate_missing, mean_of_known
from ...inference.evaluation import metrics
from ...inference.evaluation.evaluation_windows import cluster_index, on_device_of, seeded_evaluation
from ...inference.evaluation.scores import ENERGY, VARIOGRAM, Measure, means_of_those_that_count, paired
from ..data.exchange import ExchangedWindows
from ..data.protocols import Windows
from ..geometry.skeleton import SHORTEST, Skeleton
from .energies import pose_prior_energy
from .metrics import (
    average_displacement_error,
    final_displacement_error,
    median_average_displacement_error,
    median_final_displacement_error,
    motion_pseudo_values,
    multimodal_errors,
    multimodal_note,
    multimodal_truths,
)

SEAM = 3
"""Number of observed frames included in the jerk, so that it covers the transition to the future."""
TOGETHER = 64
"""Number of consecutive windows whose ground truths are compared together, because they share many futures."""


def scores(
    windows: HeldOutWindows,
    pose_prior: Any = None,
    classifiers: Mapping[str, Any] | None = None,
    itself: bool = True,
    paces: Mapping[str, float] | None = None,
) -> list[Measure]:
    """Return the scores of the motion papers for these windows.

    Reference values (the ground truth of the multimodal errors, the features of the true futures) are computed once
    here, for all models. The returned scores are therefore valid for these windows only.

    Args:
        windows: windows of the evaluation.
        pose_prior: fitted pose prior that scores single poses of the forecasts: minus the mean log density of the
            flow's z, without the log-determinant (the NLL of GSPS, arXiv:2108.08422).
        classifiers: `{name: fitted action classifier}`, for the scores "ACC name" and "FID name" and a reference row of
            real motion. Classifiers must be fitted under the same protocol and without test clips.
        itself: whether a window is among its own multimodal truths, as in the public code of DLow, GSPS, BeLFusion and
            HumanMAC. If not, windows without others are left out of the multimodal errors.
        paces: {class: mean motion of the joints between frames, in metres}, for the CMD by "action" as in BeLFusion's
            public code, which uses constants; default: the paces of the true futures, by "content".

    Raises:
        TypeError: the windows have no skeleton.
        ValueError: the skeleton, frames or labels of the windows do not match a classifier; there are too few windows
            for normal fits to its features; or the observed frames do not match the pose prior.
    """
    if not isinstance(windows, Windows | ExchangedWindows):
        raise TypeError(
            f"scores of motion need windows of dvae.motion, which have a skeleton, not {type(windows).__name__}; for "
            "errors in metres only, use dvae.motion.displacements"
        )
    moves = windows.protocol.root != "drop"
    measures = displacements(windows, _body(windows.skeleton) if moves else lambda x: x, itself=itself)
    if moves:
        measures += [replace(measure, name=f"global {measure.name}", headline=False) for measure in (_ADE, _FDE)]
    if windows.given_joints:
        measures.append(_path_error(windows))
    bones = _bones(windows)
    measures += _limbs(windows, *bones)
    if windows.protocol.predicted > 1:
        measures.append(_cumulative_motion(windows, paces))
    if windows.protocol.observed + windows.protocol.predicted > SEAM:
        measures.append(_jerk(windows))
    if pose_prior is not None:
        measures.append(_pose_nll(pose_prior, windows.protocol.observed))
    by_classifier = [
        _classifier_scores(name, classifier, windows) for name, classifier in sorted((classifiers or {}).items())
    ]
    measures += [*(accuracy for accuracy, _ in by_classifier if accuracy), *(distance for _, distance in by_classifier)]
    return [replace(measure, of_means=True) for measure in measures]


_ADE = Measure("ADE", paired(average_displacement_error), "m", headline=True)
_FDE = Measure("FDE", paired(final_displacement_error), "m", headline=True)
_MEDIAN = (
    Measure("ADEm", paired(median_average_displacement_error), "m"),
    Measure("FDEm", paired(median_final_displacement_error), "m"),
)
_MULTIMODAL = ("MMADE", "MMFDE", "MMADEm", "MMFDEm")
"""Names in the order of `multimodal_errors`."""


def displacements(
    windows: HeldOutWindows,
    body: Callable[[Tensor], Tensor] = lambda x: x,
    threshold: float | None = None,
    itself: bool = True,
) -> list[Measure]:
    """Return diversity, errors of the best and of the median future, and proper scores.

    Args:
        windows: windows for the multimodal ground truth, of motion in metres or of any arrays. Exchanged windows have
            none, because windows that begin with the exchanged pose have other paths.
        body: function that selects the compared part of frames (..., T, D).
        threshold: distance below which last observed frames count as the same, in the unit of the data; default: the
            protocol's `multimodal_threshold`, or else 0.5, as in the papers.
        itself: whether a window is among its own multimodal truths, as in `scores`.
    """

    def of_body(measure: Measure) -> Measure:
        def function(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
            return measure.function(body(forecasts), body(truth), past, index)

        return replace(measure, function=function, unit="m", of_means=True)

    diversity = lru_cache(maxsize=1)(metrics.average_pairwise_distance)  # shared by all scores of a batch

    def energy(forecasts: Tensor, truth: Tensor, *_: Any) -> Tensor:
        return metrics.energy_score(forecasts, truth, None if truth.isnan().any() else diversity(forecasts))

    apd = Measure("APD", lambda forecasts, *_: diversity(forecasts), "m", "higher")
    several = [] if isinstance(windows, ExchangedWindows) else _multimodal(windows, body, diversity, threshold, itself)
    proper = [replace(ENERGY, function=energy), VARIOGRAM]
    return list(map(of_body, [apd, _ADE, _FDE, *several[:2], *_MEDIAN, *several[2:], *proper]))


def _multimodal(
    windows: HeldOutWindows,
    body: Callable[[Tensor], Tensor],
    diversity: Callable[[Tensor], Tensor],
    threshold: float | None,
    itself: bool,
) -> list[Measure]:
    """Return errors averaged over the futures of all windows in almost the same pose, and the APDE."""
    threshold = getattr(windows.protocol, "multimodal_threshold", 0.5) if threshold is None else threshold
    truths = multimodal_truths(windows, threshold)
    futures = body(Batch(windows.all()).mask_to_nan()[:, windows.protocol.observed :])
    alone = sum(len(truths_of_window) == 1 for truths_of_window in truths)
    others = truths if itself else multimodal_truths(windows, threshold, itself)
    settings: dict[str, Any] = {"threshold": threshold, "itself": itself, "alone": alone}
    shared: Any = {
        "unit": "m",
        "note": multimodal_note(**settings, windows=len(truths)),
        "basis": {"multimodal": settings},
    }

    pool: Any = {} if itself else {"pool": means_of_those_that_count, "partial": True}

    @lru_cache(maxsize=1)  # shared by all scores of a batch
    def errors(forecasts: Tensor, index: Tensor) -> Tensor:
        none = forecasts.new_full((len(_MULTIMODAL),), math.nan)
        pairs = [(window, futures[others[n]]) for window, n in zip(forecasts, index.tolist(), strict=True)]
        return torch.stack([multimodal_errors(window, each) if len(each) else none for window, each in pairs])

    def error(place: int) -> Callable[..., Tensor]:
        return lambda forecasts, truth, past, index: errors(forecasts, index)[:, place]

    @cache
    def real() -> Tensor:
        together = range(0, len(truths), TOGETHER)
        return torch.cat([_diversities(futures, truths[start : start + TOGETHER]) for start in together])

    def diversity_error(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        return (diversity(forecasts) - real()[index]).abs()

    truths_of_window = [
        Measure(name, error(place), headline=name in ("MMADE", "MMFDE"), **shared, **pool)
        for place, name in enumerate(_MULTIMODAL)
        if itself or alone < len(truths)
    ]
    apde = Measure("APDE", diversity_error, pool=means_of_those_that_count, partial=True, **shared)
    return [*truths_of_window, *([apde] if alone < len(truths) else [])]


def _diversities(futures: Tensor, sets: Sequence[Tensor]) -> Tensor:
    """Return the APD of each of several sets of futures; distances of pairs that sets share are computed once.

    Args:
        futures: (N, T, D).
        sets: indices of the futures in each set; the APD of a single future is NaN.
    """
    members_of_any = torch.cat([*sets]).unique()
    rows = futures[members_of_any].flatten(1).double()
    centre = rows.mean(0)
    if centre.isnan().any():
        apds = [metrics.average_pairwise_distance(futures[members]) if len(members) > 1 else None for members in sets]
        return torch.stack([futures.new_tensor(math.nan) if apd is None else apd for apd in apds])
    rows = rows - centre  # otherwise distances that are small compared with the rows lose precision in products
    products = rows @ rows.T
    squares = products.diagonal()
    distances = (squares[:, None] + squares).sub_(products, alpha=2).clamp_(min=0).sqrt_().fill_diagonal_(0.0)
    membership = torch.stack([torch.isin(members_of_any, members) for members in sets]).to(distances)
    sums, counts = (membership @ distances * membership).sum(1), membership.sum(1)
    return (sums / (counts * (counts - 1))).to(futures)


def _body(skeleton: Skeleton) -> Callable[[Tensor], Tensor]:
    """Return a function that makes frames (..., T, D) relative to their own root and drops the root."""

    @lru_cache(maxsize=2)  # for forecasts and futures, shared by all scores of a batch
    def body(x: Tensor) -> Tensor:
        joints = x.unflatten(-1, (-1, 3))
        return skeleton.without_root(joints - joints[..., skeleton.root, None, :]).flatten(-2)

    return body


def _path_error(windows: Windows | ExchangedWindows) -> Measure:
    columns = [windows.joints.index(name) for name in windows.given_joints or ()]

    def function(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        paths = past["y"][:, None, windows.protocol.observed :]
        paths = torch.where(truth[:, None].isnan(), torch.nan, paths)
        distances = (forecasts - paths).unflatten(-1, (-1, 3)).norm(dim=-1)
        return mean_of_known(distances[..., columns], (1, 2, 3))

    return Measure("path error", function, "m")


def _bones(windows: Windows | ExchangedWindows) -> tuple[list[int], str]:
    """Return the bones with a length in every window, as indices into `Skeleton.edges`, and a note on the others."""
    lengths = mean_of_known(windows.skeleton.bone_lengths(windows.positions(Batch(windows.all()).mask_to_nan())), 1)
    short = (lengths < SHORTEST).any(0)
    note = f"limbs and bone lengths: {int(short.sum())} of {len(short)} bones are shorter than {SHORTEST:g} m; left out"
    return (~short).nonzero()[:, 0].tolist(), note if short.any() else ""


def _limbs(windows: Windows | ExchangedWindows, bones: list[int], note: str) -> list[Measure]:
    """Return errors of bone lengths, stretch and jitter of limbs, and errors of the angles between them."""
    skeleton = windows.skeleton

    edges = [skeleton.edges[bone] for bone in bones]
    starts, ends = (list(joints) for joints in zip(*edges, strict=True))
    pairs = [(ends.index(parent), ends.index(child)) for parent, child in edges if parent in ends]
    first, second = ([pair[side] for pair in pairs] for side in (0, 1))

    def limbs(x: Tensor) -> Tensor:
        """Return limb vectors (3, limbs, ..., T) of frames (..., T, D)."""
        joints = _coordinates(windows.positions(x).flatten(-2))
        return joints.index_select(1, indices(ends, x)) - joints.index_select(1, indices(starts, x))

    @lru_cache(maxsize=1)  # for forecasts, shared by all scores of a batch
    def lengths(x: Tensor) -> Tensor:
        """Return limb lengths (B, limbs, ..., T)."""
        return torch.stack([_norm(limbs(window)) for window in x])

    @lru_cache(maxsize=1)
    def relative(forecasts: Tensor, truth: Tensor) -> Tensor:
        """Return relative errors (B, limbs, K, T) of lengths."""
        return lengths(forecasts) / mean_of_known(lengths(truth), -1)[..., None, None] - 1

    def of_errors(score: Callable[[Tensor], Tensor]) -> Callable[..., Tensor]:
        """Return a measure that averages `score`, (B, limbs, K) of relative errors, over limbs and futures."""
        return lambda forecasts, truth, past, index: mean_of_known(score(relative(forecasts, truth)), (1, 2))

    scores: dict[str, Callable[[Tensor], Tensor]] = {
        "limb stretch": lambda errors: errors.abs().mean(-1),
        "limb stretch RMS": lambda errors: errors.square().mean(-1).sqrt(),
    }
    if windows.protocol.predicted > 1:
        scores["limb jitter"] = lambda errors: errors.diff(dim=-1).abs().mean(-1)
        scores["limb jitter RMS"] = lambda errors: errors.diff(dim=-1).square().mean(-1).sqrt()

    def bone_length_error(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        reference = mean_of_known(lengths(past.mask_to_nan()), -1)
        return mean_of_known((lengths(forecasts) / reference[..., None, None] - 1).abs(), (1, 2, 3))

    shared: Any = {"partial": windows.missing, "note": note}
    functions = {"bone-length error": bone_length_error, **{name: of_errors(score) for name, score in scores.items()}}
    measures = [Measure(name, function, "relative", **shared) for name, function in functions.items()]

    def angles(x: Tensor) -> Tensor:
        """Return angles between limbs, (pairs, ..., T)."""
        vectors = limbs(x)
        u, v = (vectors.index_select(1, indices(joints_of_side, x)) for joints_of_side in (first, second))
        return torch.atan2(_norm(_cross(u, v)), (u * v).sum(0)).rad2deg()

    def angle_error(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        errors = ((angles(x) - angles(y)[:, None]).abs() for x, y in zip(forecasts, truth, strict=True))
        return torch.stack([mean_of_known(joints_of_side, (0, 2)).amin() for joints_of_side in errors])

    angular = Measure("limb-angle error", angle_error, "degrees", **shared)
    return [*measures, *([angular] if pairs else [])]


def _coordinates(x: Tensor) -> Tensor:
    """Return joints (..., T, D) as (3, D / 3, ..., T), so that equal coordinates are contiguous."""
    coordinates: Tensor = x.unflatten(-1, (-1, 3)).movedim((-1, -2), (0, 1)).contiguous()
    return coordinates


def _norm(vectors: Tensor) -> Tensor:
    """Return norms (...) of vectors (3, ...), at least three times as fast as torch's norm over the first dimension."""
    x, y, z = vectors
    norms: Tensor = (x * x).addcmul_(y, y).addcmul_(z, z).sqrt_()
    return norms


def _cross(first: Tensor, second: Tensor) -> Tensor:
    """Return cross products of vectors (3, ...)."""
    (a, b, c), (x, y, z) = first, second
    return torch.stack([b * z - c * y, c * x - a * z, a * y - b * x])


def _cumulative_motion(windows: Windows | ExchangedWindows, paces: Mapping[str, float] | None = None) -> Measure:
    """Return the CMD, computed class by class."""
    label = "action" if paces else "content"
    try:
        labels = windows.labels(label)
    except KeyError:
        if paces:
            raise
        label, labels = "", [""] * len(windows)
    names = sorted(set(labels))
    if unknown := {*names} - {*(paces or names)}:
        raise ValueError(f"paces have no class {', '.join(sorted(unknown))}; give one for each action of the windows")
    classes = torch.tensor([names.index(label_of_window) for label_of_window in labels])
    body = _body(windows.skeleton) if windows.protocol.root != "drop" else lambda x: x

    def moved(x: Tensor) -> Tensor:
        """Return mean steps of the joints, (B, ..., T - 1), of frames (B, ..., T, D)."""
        steps = (_norm(_coordinates(window).diff(dim=-1)) for window in body(x))
        return torch.stack([mean_of_known(label_of_window, 0) for label_of_window in steps]).double()

    def function(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        return mean_of_known(moved(_where_true(forecasts, truth)), 1)

    real = mean_of_known(moved(Batch(windows.all()).mask_to_nan()[:, windows.protocol.observed :]), -1)
    source = "the pace of its true futures"
    if paces:
        real, source = torch.tensor([paces[name] for name in labels]).to(real), "a given pace"
    scope = f"each {label} is a class, {len(names)} in total" if label else "all windows are one class"
    return Measure(
        "CMD",
        function,
        "m",
        partial=windows.missing,
        pool=lambda motion, clips: motion_pseudo_values(motion, real, classes, clips),
        note=f"CMD: {scope}; its forecasts are compared with {source}",
        basis={"CMD": {"label": label, "classes": names} | ({"paces": dict(paces)} if paces else {})},
    )


def _jerk(windows: Windows | ExchangedWindows) -> Measure:
    """Return the jerk, including the transition from the observed frames."""
    body = _body(windows.skeleton) if windows.protocol.root != "drop" else lambda x: x
    start = max(windows.protocol.observed - SEAM, 0)

    def jerk(x: Tensor) -> Tensor:
        """Return the jerk (B, ...) of frames (B, ..., T, D)."""
        changes = (_norm(_coordinates(window).diff(n=3, dim=-1)) for window in body(x))
        return torch.stack([mean_of_known(steps, (0, -1)) for steps in changes]) * windows.protocol.fps**3

    def function(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        observed = past.mask_to_nan()[:, None, start:].expand(-1, forecasts.shape[1], -1, -1)
        return mean_of_known(jerk(torch.cat([observed, _where_true(forecasts, truth)], 2)), 1)

    real = mean_of_known(jerk(Batch(windows.all()).mask_to_nan()[:, start:]), 0)
    note = f"jerk: real motion has {real:.1f} m/s³"
    return Measure("jerk", function, "m/s³", "", partial=windows.missing, note=note)


def _where_true(forecasts: Tensor, truth: Tensor) -> Tensor:
    """Return forecasts (B, K, T, D), NaN where the truth (B, T, D) was not observed."""
    missing = truth.isnan()
    return forecasts.masked_fill(missing[:, None], torch.nan) if missing.any() else forecasts


def _pose_nll(prior: Any, observed: int) -> Measure:
    if prior.forward_at not in (None, observed - 1):
        raise ValueError(
            f"the pose prior was fitted to windows whose heading is zero in frame {prior.forward_at + 1}, but here the "
            f"last observed frame is {observed}; fit a pose prior under this protocol"
        )

    @torch.no_grad()
    def function(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        history = interpolate_missing(past["x"], past.mask())[:, None].expand(-1, forecasts.shape[1], -1, -1)
        motion = on_device_of(prior, {"x": torch.cat([history, forecasts], 2)})["x"]
        poses = prior.facing(motion)[:, :, observed:].movedim(1, 0)
        return pose_prior_energy(poses, prior, prior.skeleton).to(forecasts)

    return Measure("pose NLL", function, "nats", basis={"pose prior": _hash(prior)})


def _classifier_scores(
    name: str, classifier: Any, windows: Windows | ExchangedWindows
) -> tuple[Measure | None, Measure]:
    """Return the ACC, if the class of some window is known, and the FID."""
    if windows.missing:
        raise ValueError(
            f"ACC and FID {name} need features of whole futures, but these windows have missing joints; leave the "
            "classifier out, or fill them in first (`dvae impute RUN --filled FILE`)"
        )
    labels = _labels(name, classifier, windows)
    classes = torch.tensor([classifier.classes.index(label) if label in classifier.classes else -1 for label in labels])
    unknown = int((classes < 0).sum())
    settings = {"label": classifier.label, "classes": list(classifier.classes)}
    basis = {f"classifier {name}": {**settings, "weights": _hash(classifier), "unknown": unknown}}
    note = f"ACC, FID {name}: classifier {_hash(classifier)[:12]}"
    note += f"; {unknown} of {len(labels)} windows have a class that it does not know" if unknown else ""
    shared: Any = {"truth": "real motion", "note": note, "basis": basis}

    @lru_cache(maxsize=1)  # shared by both scores of a batch
    def features(futures: Tensor) -> Tensor:
        with seeded_evaluation(classifier, 0):
            values: Tensor = classifier.features(on_device_of(classifier, {"x": futures})["x"])
            return values

    def accuracy(forecasts: Tensor, truth: Tensor, past: Batch, index: Tensor) -> Tensor:
        hits = (classifier.logits(features(forecasts)).cpu().argmax(-1) == classes[index, None]).double().mean(1)
        fraction: Tensor = hits.masked_fill(classes[index] < 0, math.nan)
        return fraction

    x = windows.all()["x"][:, windows.protocol.observed :]
    real = torch.cat([features(futures) for futures in x.split(32)]).double().cpu()
    distance = Measure(
        f"FID {name}",
        lambda forecasts, *_: features(forecasts).double().cpu(),
        pool=lambda generated, clips: metrics.frechet_pseudo_values(real, generated, clips),
        **shared,
    )
    some_known = unknown < len(labels)
    return Measure(f"ACC {name}", accuracy, "share", "higher", partial=True, **shared) if some_known else None, distance


def _labels(name: str, classifier: Any, windows: Windows | ExchangedWindows) -> list[str]:
    """Return the true labels of windows that match a classifier.

    Raises:
        ValueError: the windows do not match the classifier.
    """
    size = 3 * len(windows.joints)
    if windows.skeleton != classifier.skeleton or size != classifier.size:
        raise ValueError(
            f"the classifier {name} was fitted to the skeleton {classifier.skeleton.name!r} and frames of "
            f"{classifier.size} numbers; these windows have the skeleton {windows.skeleton.name!r} and {size}"
        )
    expected, actual = ((p.predicted, p.fps) for p in (classifier.protocol, windows.protocol))
    if expected != actual:
        raise ValueError(
            f"the classifier {name} was fitted to {expected[0]} predicted frames at {expected[1]:g} fps; these windows "
            f"have {actual[0]} at {actual[1]:g}"
        )
    clips = cluster_index(windows.keys).bincount()
    if len(windows.keys) - (int(clips.max()) if len(clips) > 1 else 0) < 2:
        raise ValueError(
            f"FID {name} fits normal distributions to features, and needs at least two windows when any one clip is "
            f"left out; got {len(windows.keys)} windows of {len(clips)} clips"
        )
    try:
        return windows.labels(classifier.label)
    except KeyError as error:
        raise ValueError(f"the classifier {name} distinguishes {classifier.label}s, but {error.args[0]}") from error


def _hash(module: nn.Module) -> str:
    digest = hashlib.sha256()
    for name, value in module.state_dict().items():
        digest.update(name.encode() + value.cpu().numpy().tobytes())
    return digest.hexdigest()
