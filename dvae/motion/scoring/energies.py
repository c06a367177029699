"""Energies: penalties for samples of motion, as pure functions; lower is better.

Energies are not likelihoods. A model includes them through `pyro.factor`, and an objective weights them (`Evidence`'s
`energy_weights`). Unless noted otherwise, the source is GSPS (Mao, Liu and Salzmann 2021, arXiv:2108.08422), with the
normalisation of its public code.

Shapes everywhere: samples (S, B, T, D), S samples for each of B sequences, T frames of D coordinates in metres. The
result is (B,); its mean over the batch is the paper's term. The caller passes only the frames that count. NaN values in
a truth, a history or a reference were not observed and do not count. Gradients flow to the samples. Every function
raises ValueError if shapes do not match.
"""

from collections.abc import Callable
from math import log, pi
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import Function, once_differentiable

from ...capture import is_deferring
from ...constants import constant
from ..geometry.angles import AngleLimits, angle_names, cosines
from ..geometry.skeleton import Skeleton, differences

BLOCK = 2**18
"""Number of values processed at once on a CPU, so that intermediate results stay in cache."""


def best_of_many(samples: Tensor, truth: Tensor) -> Tensor:
    """Return the squared error of the best sample: min_s sum_{t,d} (x_s - x)^2. GSPS's reconstruction term L_r.

    Args:
        samples: (S, B, T, D).
        truth: (B, T, D).

    Returns:
        (B,), square metres.
    """
    _check(samples, truth=(truth, samples.shape[1:]))
    with torch.no_grad():
        best = torch.stack([_errors(sample, truth).sum((1, 2)) for sample in samples]).argmin(0)
    return _errors(_select(samples, best, torch.arange(len(best), device=best.device)), truth).sum((1, 2))


def multimodal_best_of_many(samples: Tensor, pseudo: Tensor, valid: Tensor) -> Tensor:
    """Return the squared error of the best sample for each admissible future: min_s sum_{t,d} (x_s - y_m)^2.

    The errors of a sequence are summed over its valid futures and multiplied by B / N, where N is the number of valid
    futures in the whole batch. The mean over the batch is therefore the mean over all valid futures. GSPS's multimodal
    reconstruction term L_mm.

    Args:
        samples: (S, B, T, D).
        pseudo: (B, M, T, D), admissible futures.
        valid: (B, M) bool, False for futures to ignore.

    Returns:
        (B,), square metres; zeros if no future is valid.
    """
    _check(samples)
    _, sequences, *frame_shape = samples.shape
    futures = pseudo.shape[1] if pseudo.dim() == 4 else "M"
    _check(samples, pseudo=(pseudo, (sequences, futures, *frame_shape)), valid=(valid, (sequences, futures)))
    if valid.dtype != torch.bool:
        raise ValueError(f"valid has dtype {valid.dtype}, expected torch.bool")
    if is_deferring():  # all futures, because their number is a value of the GPU
        every = torch.arange(valid.numel(), device=valid.device)
        sequence, future = every // valid.shape[1], every % valid.shape[1]
        pseudo = pseudo.masked_fill(~valid[..., None, None], 0)
    else:
        sequence, future = valid.nonzero(as_tuple=True)
    truths = pseudo[sequence, future]
    with torch.no_grad():  # ||x - y||^2 - ||y||^2 = ||x||^2 - 2 x y, relative to one sample to avoid cancellation
        offsets = (samples - samples[:1]).transpose(0, 1).flatten(2)
        targets = (pseudo - samples[0, :, None]).masked_fill(~valid[..., None, None], 0).flatten(2)
        distances = offsets.square().sum(2)[:, None] - 2 * targets @ offsets.mT
        best = distances[sequence, future].argmin(1)
    errors = (_select(samples, best, sequence) - truths).square().sum((1, 2))
    if is_deferring():
        weights = valid.flatten().float() * (sequences / valid.sum().clamp(min=1))
        return errors.new_zeros(sequences).index_add(0, sequence, errors * weights.to(errors))
    return errors.new_zeros(sequences).index_add(0, sequence, errors) * (sequences / max(len(sequence), 1))


def _errors(samples: Tensor, truth: Tensor) -> Tensor:
    """Return squared errors, 0 where the truth is NaN."""
    return torch.where(truth.isnan(), 0.0, samples - truth).square()


def _select(samples: Tensor, sample: Tensor, sequence: Tensor) -> Tensor:
    """Return samples[sample, sequence], (N, T, D)."""
    return samples.flatten(0, 1).index_select(0, sample * samples.shape[1] + sequence)


def pairwise_diversity(samples: Tensor, scale: float) -> Tensor:
    """Return the similarity of the samples: mean over the pairs i < j of exp(-||vec(x_i) - vec(x_j)||_1 / scale).

    GSPS's diversity term L_div applies it to each body part separately, among samples that share the earlier parts.

    Args:
        samples: (S, B, T, D).
        scale: length scale alpha in metres; the distance is the sum over all T D coordinates.

    Returns:
        (B,), from 0 to 1 (all samples equal); zeros if there is only one sample.
    """
    _check(samples)
    if not scale > 0:
        raise ValueError(f"scale is {scale}, expected a distance above 0, in metres")
    first, second = torch.triu_indices(len(samples), len(samples), 1, device=samples.device)
    identity = torch.eye(len(samples), dtype=samples.dtype, device=samples.device)
    pairs = identity[first] - identity[second]  # a matrix product is a third faster than indexing

    def energy(x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            pair_differences = (pairs @ x.flatten(1)).view(len(first), *x.shape[1:])
        return (-pair_differences.abs().sum((2, 3)) / scale).exp().sum(0) / max(len(first), 1)

    diversity: Tensor = _InBlocks.apply(energy, samples)
    return diversity


def gaussian_diversity(samples: Tensor, scale: float) -> Tensor:
    """Return the similarity of the samples: mean over the pairs i < j of exp(-||vec(x_i) - vec(x_j)||^2 / scale).

    DLow's E_d (Yuan and Kitani, 2020, arXiv 2003.08386), with the normalisation of its public code.

    Args:
        samples: (S, B, T, D).
        scale: scale of the squared distance, in square metres.

    Returns:
        (B,), from 0 to 1 (all samples equal); zeros if there is only one sample.
    """
    if not scale > 0:
        raise ValueError(f"scale is {scale}, expected a squared distance above 0, in square metres")
    _check(samples)
    first, second = torch.triu_indices(len(samples), len(samples), 1, device=samples.device)
    likeness = (-_squared_distances(samples)[:, first, second] / scale).exp()
    return likeness.sum(1) / max(len(first), 1)


def determinantal_diversity(samples: Tensor, quality: Tensor, scale: float) -> Tensor:
    """Return minus the expected number of samples that a determinantal point process selects: -tr(I - (L + I)^-1).

    L_ij = r_i r_j exp(-||vec(x_i) - vec(x_j)||^2 / scale). Similar samples are rarely selected together, and samples of
    low quality are rarely selected. The loss of DSF (Yuan and Kitani, 2020, arXiv 1907.04967).

    Args:
        samples: (S, B, T, D).
        quality: (S, B), quality r of each sample.
        scale: scale of the squared distance, in square metres.

    Returns:
        (B,), from -S to 0.
    """
    _check(samples, quality=(quality, samples.shape[:2]))
    if not scale > 0:
        raise ValueError(f"scale is {scale}, expected a squared distance above 0, in square metres")
    distances = _squared_distances(samples)
    r = quality.T.to(distances)
    identity = torch.eye(len(samples), dtype=distances.dtype, device=distances.device)
    with torch.autocast(samples.device.type, enabled=False):
        kernel = r[:, :, None] * r[:, None] * (-distances / scale).exp()
        # unlike inv, inv_ex does not synchronise with the device
        inverse: Tensor = torch.linalg.inv_ex(kernel + identity)[0]
    return inverse.diagonal(dim1=1, dim2=2).sum(1) - len(samples)


def _squared_distances(samples: Tensor) -> Tensor:
    """Return ||vec(x_i) - vec(x_j)||^2 of all pairs of samples, over all T D coordinates.

    Args:
        samples: (S, B, T, D).

    Returns:
        (B, S, S), square metres, at least in single precision.
    """
    with torch.autocast(samples.device.type, enabled=False):
        x = samples.to(torch.promote_types(samples.dtype, torch.float32)).transpose(0, 1).flatten(2)
        x = x - x.mean(1, keepdim=True)  # avoids cancellation below
        squares = x.square().sum(2)
        return squares[:, :, None] + squares[:, None] - 2 * x @ x.mT


def history_error(samples: Tensor, history: Tensor) -> Tensor:
    """Return the squared error of the samples in the observed frames: mean_{t,s} sum_d (x_s - x)^2. GSPS's L_x.

    Args:
        samples: (S, B, O, D), the O observed frames.
        history: (B, O, D).

    Returns:
        (B,), square metres.
    """
    _check(samples, history=(history, samples.shape[1:]))
    return _errors(samples, history).sum(3).mean((0, 2))


def limb_length(samples: Tensor, reference: Tensor, skeleton: Skeleton) -> Tensor:
    """Return the squared errors of limb lengths: mean_{t,s} sum_limbs (length - reference length)^2. GSPS's L_limb.

    GSPS uses all frames, including the repeated history, and the first observed pose as reference.

    Args:
        samples: (S, B, T, D).
        reference: (B, D), one pose of each sequence, treated as a constant. Limbs with missing joints are ignored.
        skeleton: skeleton of the poses; D = 3 J, or 3 (J - 1) without the root.

    Returns:
        (B,), square metres.
    """
    _check(samples, reference=(reference, (*samples.shape[1:2], *samples.shape[3:])))

    limbs = differences(skeleton, tuple(skeleton.edges), samples.shape[-1], samples.dtype, samples.device)
    pose = reference.detach()
    is_missing = skeleton.bone_lengths(skeleton.with_root(pose.unflatten(-1, (-1, 3)))).isnan()
    expected = torch.where(is_missing, torch.nan, _lengths(pose.nan_to_num(0.0), limbs))
    error: Tensor = _InBlocks.apply(lambda block, other: _limb_errors(block, other, limbs), samples, expected)
    return error


def _limb_errors(samples: Tensor, expected: Tensor, limbs: Tensor) -> Tensor:
    return _errors(_lengths(samples, limbs), expected[:, None]).sum(3).mean((0, 2))


def _lengths(poses: Tensor, limbs: Tensor) -> Tensor:
    """Return limb lengths; `limbs` is the matrix that maps poses to limb vectors."""
    with torch.autocast(poses.device.type, enabled=False):
        vectors: Tensor = (poses @ limbs).unflatten(-1, (-1, 3))
    return vectors.square().sum(-1).clamp_min(1e-30).sqrt()  # makes the gradient at 0 zero instead of NaN


class _InBlocks(Function):
    """Evaluate energy(samples, *constants) for a few sequences at a time, together with its gradient.

    Intermediate results of an energy are several times as large as the samples. In blocks they stay in cache and need
    little memory (measured: half the time for limb lengths, a fifth for pairwise distances).
    """

    @staticmethod
    def forward(ctx: Any, energy: Callable[..., Tensor], samples: Tensor, *constants: Tensor) -> Tensor:
        differentiate = ctx.needs_input_grad[1]
        numbers = max(samples[:, :1].numel(), 1)
        size = max(BLOCK // numbers, 1) if samples.device.type == "cpu" else samples.shape[1]
        values, gradients = [], []
        for block, *others in zip(samples.split(size, 1), *(c.split(size) for c in constants), strict=True):
            with torch.set_grad_enabled(differentiate):
                block = block.detach().requires_grad_(differentiate)
                value = energy(block, *others)
                if differentiate:
                    gradients += torch.autograd.grad(value.sum(), block)
            values.append(value.detach())
        ctx.constants = len(constants)
        ctx.save_for_backward(*([torch.cat(gradients, 1)] if differentiate else []))
        return torch.cat(values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return None, gradient * outputs[0][:, None, None], *[None] * ctx.constants


def joint_angles(samples: Tensor, limits: AngleLimits, skeleton: Skeleton) -> Tensor:
    """Return the squared excess of the joint angles over their limits, in cosines. GSPS's L_a.

    sum_angles [mean_{cos < low} (cos - low)^2 if low >= -.98] + [mean_{cos > high} (cos - high)^2 if high <= .98]

    Each mean is over the violating entries of the whole batch, left and right, not over all entries. The energy of a
    sequence is its share of this sum, times B.

    Args:
        samples: (S, B, T, D); GSPS uses the predicted frames.
        limits: result of `motion.estimate_angle_limits`.
        skeleton: skeleton of the poses, in `motion.angles.ANGLES`; D = 3 J, or 3 (J - 1) without the root.

    Returns:
        (B,), without unit; zeros if all angles are within their limits.
    """
    _check(samples)
    names = angle_names(skeleton)
    if limits.names != names:
        raise ValueError(
            f"`limits` has the angles {', '.join(dict.fromkeys(limits.names))}; expected the angles of skeleton "
            f"{skeleton.name!r}, {', '.join(dict.fromkeys(names))}: estimate the limits from its poses"
        )
    low, high = limits.low.to(samples), limits.high.to(samples)
    low, high = low.masked_fill(low < -0.98, -torch.inf), high.masked_fill(high > 0.98, torch.inf)
    same = constant(tuple(tuple(float(name == other) for other in names) for name in names), samples)
    excess: Tensor = _JointAngles.apply(samples, low, high, same, skeleton)
    return excess


class _JointAngles(Function):
    """Compute the excess in blocks, and differentiate only poses that exceed a limit (few, after training)."""

    @staticmethod
    def forward(ctx: Any, samples: Tensor, low: Tensor, high: Tensor, same: Tensor, skeleton: Skeleton) -> Tensor:
        sequences, frames = samples.shape[1:3]
        excess = []
        for block in samples.flatten(0, 2).split(_poses_at_once(samples)):
            cos = cosines(block, skeleton)
            excess.append(torch.where(cos < low, cos - low, torch.where(cos > high, cos - high, 0)))
        over = torch.cat(excess)
        below, above = ((side.sum(0).to(same) @ same).clamp_min(1) for side in (over < 0, over > 0))
        share = sequences * over / torch.where(over < 0, below, above)
        ctx.skeleton = skeleton
        ctx.save_for_backward(samples, 2 * share)
        return (over * share).sum(1).view(-1, sequences, frames).sum((0, 2))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor | None, ...]:
        samples, slopes = ctx.saved_tensors
        _, sequences, frames, _ = samples.shape
        poses = samples.flatten(0, 2)
        gradient = torch.zeros_like(poses)
        all_rows = torch.arange(len(poses), device=poses.device)
        # finding these poses would synchronise with a GPU
        violating = slopes.any(1).nonzero()[:, 0] if poses.device.type == "cpu" else all_rows
        for rows in violating.split(_poses_at_once(samples)):
            slope = slopes[rows] * outputs[0][rows // frames % sequences, None]
            with torch.enable_grad():
                violating_poses = poses[rows].requires_grad_()
                (gradient[rows],) = torch.autograd.grad(cosines(violating_poses, ctx.skeleton), violating_poses, slope)
        return gradient.view(samples.shape), None, None, None, None


def _poses_at_once(samples: Tensor) -> int:
    return max(BLOCK // samples.shape[3], 1) if samples.device.type == "cpu" else max(samples[..., 0].numel(), 1)


def pose_prior_energy(samples: Tensor, prior: Callable[[Tensor], tuple[Tensor, Tensor]], skeleton: Skeleton) -> Tensor:
    """Return the distance of poses from a prior's centre: -mean_{t,s} sum log N(z; 0, 1), z = flow(limb directions).

    GSPS's L_nf. As in GSPS, the log-determinant of the prior's flow is left out, so this is not a density.

    Args:
        samples: (S, B, T, D); GSPS uses every third predicted frame, starting at a random one of the first three.
        prior: function from directions (..., 3 (J - 1)), zeros for limbs of length zero, to z of the same shape and a
            log-determinant (...).
        skeleton: skeleton of the poses; D = 3 J, or 3 (J - 1) without the root.

    Returns:
        (B,), nats.
    """
    _check(samples)
    z, _ = prior(skeleton.directions(samples))
    return 0.5 * (z.square().sum(3).mean((0, 2)) + z.shape[3] * log(2 * pi))


def _check(samples: Tensor, **others: tuple[Tensor, tuple[Any, ...]]) -> None:
    if samples.dim() != 4 or not samples.numel():
        raise ValueError(f"samples have shape {tuple(samples.shape)}, expected (S, B, T, D) with no size 0")
    for name, (tensor, expected) in others.items():
        if tensor.shape != tuple(expected):
            raise ValueError(
                f"{name} has shape {tuple(tensor.shape)}, expected ({', '.join(map(str, expected))}) for samples of "
                f"shape {tuple(samples.shape)}"
            )
