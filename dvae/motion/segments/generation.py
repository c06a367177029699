"""Segments of motion from the prior of a latent space, and statistics that compare them with real segments.

    z ~ p(z) = N(0, I),    chi = mean of p(chi | z, beta)

A variational autoencoder generates plausible data from its prior only if the aggregate posterior, the mixture of the
guide's distributions over all segments, is close to the prior (Hoffman and Johnson 2016, "ELBO surgery"). With a small
KL weight it is not. `aggregate_posterior` measures the difference.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import log
from typing import Any

import torch
from torch import Tensor

from ...data.batch import WHOLE
from ...inference.evaluation.evaluation_windows import on_device_of, seeded_evaluation
from ...inference.evaluation.metrics import average_pairwise_distance
from ...inference.evaluation.result import Table
from ..data.clips import MotionSet
from ..geometry import kinematics
from .completion import TIMES, SegmentCompletion, _at_moments
from .frames import OFFSETS

STILL = 0.5
"""Speed in m/s below which the lower foot counts as in contact with the ground."""
CENTRAL = 0.99
"""Probability of the central interval of real segments in which each statistic of a plausible segment lies."""
MOMENTS = 30
"""Number of evenly spaced times of a segment at which statistics are computed."""
MOST_PROPOSALS = 200
"""Maximum number of draws of z for each segment with a given duration."""
APD, PLAUSIBLE = "APD (m)", "plausible (%)"
STANDARD, FITTED, AGGREGATE = "N(0, I)", "fitted normal", "aggregate posterior"
"""Names of distributions of z."""
KNOWN, REAL = "real, training", "real, test"
"""Names of real segments."""


@dataclass(frozen=True, eq=False)
class Generated:
    """Segments on bodies, such as those that `generate` returns.

    Args:
        model: model of segments, with `timed` and `body`.
        x: frames (B, N, D).
        shape: shape parameters (B, S) of the bodies.
    """

    model: Any
    x: Tensor
    shape: Tensor

    @cached_property
    def statistics(self) -> Mapping[str, Tensor]:
        """Statistics (B,) of the segments by name and unit, from 30 poses that are evenly spaced in time.

        * duration, and displacement of the root from the first to the last frame
        * speed: mean over joints and time; peak speed: maximum over joints and frames
        * contact: share of time when the lower foot is slower than 0.5 m/s
        * sliding: horizontal speed of the lower foot, averaged over time
        * floor: standard deviation over time of the height of the lower foot
        * bone stretch: standard deviation over time of a bone's length relative to its mean, averaged over bones. It is
          0 by construction, because rotations move a body of constant size.
        """
        timed, skeleton = self.model.timed, self.model.timed.skeleton
        durations = timed.lasts(self.x)
        step = durations / (MOMENTS - 1)
        times = torch.linspace(0, 1, MOMENTS).to(self.x) * durations[:, None]
        joints = self._joints(_at_moments(timed, self.x, {TIMES: times})[0])
        ends = set(range(skeleton.joints)) - set(skeleton.parents)
        feet = [j for j in sorted(ends) if re.search("foot|toe", skeleton.names[j], re.IGNORECASE)]
        heights = joints[..., feet, skeleton.vertical]
        lowest = heights[:, :-1].argmin(-1)[..., None, None].expand(-1, -1, 1, 3)
        moves = joints.diff(dim=1)
        paths = moves.norm(dim=-1)
        foot = moves[..., feet, :].gather(-2, lowest)[..., 0, :]
        level = [axis for axis in range(3) if axis != skeleton.vertical]
        contact = (foot.norm(dim=-1) < STILL * step[:, None]).to(step)
        lengths = skeleton.bone_lengths(joints)
        return {
            "duration (s)": durations,
            "displacement (m)": timed.travels(self.x),
            "speed (m/s)": paths.mean(-1).sum(-1) / durations,
            "peak speed (m/s)": paths.amax((1, 2)) / step,
            "contact (%)": 100 * contact.mean(-1),
            "sliding (m/s)": foot[..., level].norm(dim=-1).sum(-1) / durations,
            "floor (cm)": 100 * heights.amin(-1).std(-1),
            "bone stretch (%)": 100 * (lengths.std(1) / lengths.mean(1)).mean(-1),
        }

    @property
    def diversity(self) -> float:
        """APD in metres: mean distance between two segments, each the vector of all joint positions in all frames."""
        return float(average_pairwise_distance(self._joints(self.x).flatten(2)))

    def plausible(self, real: Generated) -> Tensor:
        """Return whether every statistic is in the central 99 % of the statistics of real segments, as booleans (B,).

        Args:
            real: real segments.
        """
        tail = (1 - CENTRAL) / 2
        inside = []
        for name, values in self.statistics.items():
            low, high = real.statistics[name].quantile(values.new_tensor([tail, 1 - tail])).tolist()
            margin = 0.01 if name.startswith("bone") else 0.0  # rounding, since all values are 0
            inside.append((values >= low - margin) & (values <= high + margin))
        return torch.stack(inside).all(0)

    def motion(self, fps: float | None = None) -> MotionSet:
        """Return the segments as clips from the origin with heading zero.

        Args:
            fps: frames per second; default: the rate of the training data.
        """
        motion: MotionSet = self.model.timed.back({WHOLE: self.x, OFFSETS: self.model.body.offsets(self.shape)}, fps)
        clips = [replace(clip, name=f"sample-{n:02d}") for n, clip in enumerate(motion)]
        return replace(motion, clips=clips)

    def _joints(self, frames: Tensor) -> Tensor:
        """Return the positions (B, K, J, 3) of the joints in frames (B, K, D), in metres."""
        timed, body = self.model.timed, self.model.body
        rotations, translation = timed.poses(frames)
        offsets = body.offsets(self.shape)[:, None].expand(-1, frames.shape[1], -1, -1)
        positions: Tensor = kinematics.forward(body.parents, rotations, offsets, translation)[0]
        return positions


def priors(model: Any, batch: Mapping[str, Any]) -> dict[str, Any]:
    """Return distributions of z by name: the prior, and two that are estimated from the latents of segments.

    "fitted normal" has the mean and covariance of the latents, as in `SegmentCompletion`. "aggregate posterior" is the
    mixture of the posteriors of all segments.

    Args:
        model: model of segments.
        batch: segments, x (B, N, D) and beta (B, S).
    """
    with seeded_evaluation(model, 0):
        batch = on_device_of(model, batch)
        posterior = model.posterior(batch)
        components = torch.distributions.Independent(torch.distributions.Normal(posterior.mean, posterior.stddev), 1)
        weights = torch.distributions.Categorical(logits=posterior.mean.new_zeros(len(posterior.mean)))
        standard = torch.distributions.Normal(torch.zeros_like(posterior.mean[0]), 1.0)
        return {
            STANDARD: torch.distributions.Independent(standard, 1),
            FITTED: SegmentCompletion(model, known=batch).prior,
            AGGREGATE: torch.distributions.MixtureSameFamily(weights, components),
        }


def summarise(rows: Mapping[str, Generated], real: Generated) -> dict[str, dict[str, float]]:
    """Return means of the statistics, APD, and the share of plausible segments, by row.

    Args:
        rows: segments by name.
        real: real segments that define the plausible range of each statistic.
    """
    return {
        name: {
            **{statistic: float(values.double().mean()) for statistic, values in segments.statistics.items()},
            APD: segments.diversity,
            PLAUSIBLE: 100 * float(segments.plausible(real).double().mean()),
        }
        for name, segments in rows.items()
    }


def summary_table(summary: Mapping[str, Mapping[str, float]]) -> Table:
    """Return the result of `summarise` as a table, one row per statistic."""
    table = Table(caption=f"means over segments; plausible: all statistics in the central {CENTRAL:.0%} of real ones")
    table.add_column("")
    for name in summary:
        table.add_column(name, justify="right")
    for statistic in next(iter(summary.values())):
        table.add_row(statistic, *(f"{values[statistic]:.2f}" for values in summary.values()))
    return table


def generate(
    model: Any,
    shape: Tensor,
    *,
    seconds: float | None = None,
    tolerance: float = 0.05,
    prior: Any = None,
    seed: int = 0,
) -> Generated:
    """Draw segments of motion from the prior.

    Args:
        model: model of segments, such as a fitted `motion-latent`.
        shape: shape parameters (B, S) of the bodies, one for each segment.
        seconds: duration of the segments; by default the model draws it. Draws with other durations are rejected, so
            segments are from the prior given this duration.
        tolerance: largest difference of the duration from `seconds`.
        prior: distribution of z with event shape (Z,); default: N(0, I), the prior of the model.
        seed: seed of the draws.

    Returns:
        B segments: means of the decoder.

    Raises:
        ValueError: too few draws have this duration.
    """
    with seeded_evaluation(model, seed):
        shape = shape.to(next(model.parameters()))
        standard = torch.distributions.Normal(shape.new_zeros(model.sizes["z"]), 1.0)
        prior = prior or torch.distributions.Independent(standard, 1)
        x = model.decode(prior.sample((len(shape),)), shape)
        drawn, (low, high) = len(x), model.timed.lasts(x).aminmax()
        while seconds is not None and (rejected := (model.timed.lasts(x) - seconds).abs() > tolerance).any():
            count = int(rejected.sum())
            if drawn >= MOST_PROPOSALS * len(x):
                raise ValueError(
                    f"only {len(x) - count} of {drawn} draws from the prior last {seconds:g} ± {tolerance:g} s; the "
                    f"first {len(x)} take {low:.2f} to {high:.2f} s; choose such a duration, or a larger tolerance"
                )
            x[rejected] = model.decode(prior.sample((count,)), shape[rejected])
            drawn += count
    return Generated(model, x.cpu(), shape.cpu())


def aggregate_posterior(model: Any, batch: Mapping[str, Any]) -> dict[str, float]:
    """Compare the aggregate posterior of segments with the prior N(0, I).

    Args:
        model: model of segments.
        batch: segments, x (B, N, D) and beta (B, S).

    Returns:
        KL: mean KL of a posterior from the prior, in nats.
        norm: mean norm of the posterior means.
        deviation: mean standard deviation of the posteriors.
        radius: root mean square norm of draws from the aggregate posterior, divided by that of the prior, sqrt(Z).
        aggregate KL: KL in nats from the prior of the normal with the mean and covariance of the aggregate posterior;
            0 if they match.
        excess: lower bound in nats of the KL of the aggregate posterior of these segments from the prior, mean KL minus
            log N, because z has at most log N nats about which of N segments it describes (Hoffman and Johnson 2016).
            If it is far above 0, the prior does not generate such segments.
    """
    with seeded_evaluation(model, 0):
        posterior = model.posterior(on_device_of(model, batch))
    means, variances = posterior.mean.double().cpu(), posterior.variance.double().cpu()
    size, centre = means.shape[1], means.mean(0)
    covariance = (means - centre).T @ (means - centre) / len(means) + variances.mean(0).diag()
    kl = 0.5 * (variances + means.square() - 1 - variances.log()).sum(1)
    total = covariance.trace() + centre.square().sum()
    return {
        "KL": float(kl.mean()),
        "norm": float(means.norm(dim=1).mean()),
        "deviation": float(variances.sqrt().mean()),
        "radius": float((total / size).sqrt()),
        "excess": float(kl.mean()) - log(len(means)),
        "aggregate KL": float(0.5 * (total - size - torch.linalg.slogdet(covariance).logabsdet)),
    }
