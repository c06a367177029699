"""Pseudo ground truth: plausible alternative futures of a window, taken from other windows in almost the same pose.

Mao, Liu and Salzmann, 2021, "Generating smooth pose sequences for diverse human motion prediction" (GSPS),
arXiv:2108.08422. The candidates are windows of the training clips. They are stored as unit limb directions d, and posed
with the limb lengths of the window x. A candidate is admissible if

    |last observed pose of candidate - last observed pose of x| < threshold          over all coordinates
    mean joint distance of candidate's future from x's          >= minimum           so that near copies drop out

At most `most` admissible candidates, drawn without replacement, follow the observed frames of x. The threshold is in
the paper's supplement; `minimum` and `most` are in its public code.

Candidates are tried in random order until enough of them meet the conditions. Most of the others are excluded in
advance by matrix products with candidates of average limb lengths. This is valid for two reasons. A mean of distances
over frames is at most their root mean square. Other limb lengths move a joint by at most the sum of the differences
along its path to the root.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...data.batch import Batch
from ...data.sequences import interpolate_missing
from ..data.protocols import Windows
from ..geometry.views import Heading

_ROUNDING = 1e-3  # relative to |x|: bounds the error of distances from matrix products in single precision


class PseudoTruths:
    """Alternative futures of training windows, found among the training clips.

    Args:
        windows: windows whose clips provide the futures; their protocol defines the observed frames.
        threshold: maximum distance of last observed poses, as vectors, in metres.
        minimum: minimum mean joint distance from the window's own future, in metres.
        most: M, maximum number of futures per window.
        stride: frames between the starts of candidates in a clip; GSPS's public code uses 20, and 15 on HumanEva-I.
        heading: compare poses independently of heading. Candidates are rotated about the up axis so that their last
            observed frame has heading zero; windows must be rotated in the same way by `turn`.

    Raises:
        ValueError: a number is out of range, the windows have no future, or the skeleton does not define a heading.
    """

    def __init__(
        self,
        windows: Windows,
        threshold: float = 0.5,
        minimum: float = 0.1,
        most: int = 10,
        stride: int = 20,
        heading: bool = False,
    ) -> None:
        if not threshold > 0 or not minimum >= 0 or most < 1 or stride < 1:
            raise ValueError(
                "`threshold` must be above 0, `minimum` at least 0, and `most` and `stride` at least 1; got "
                f"{threshold}, {minimum}, {most} and {stride}"
            )
        self._observed = windows.protocol.observed
        if windows.length <= self._observed:
            raise ValueError(
                f"windows of {windows.length} frames, {self._observed} of them observed, have no future; use "
                "longer windows"
            )
        self.threshold, self.minimum, self.most, self.heading = threshold, minimum, most, heading
        self._skeleton, self._windows = windows.skeleton, windows

        parents, root = windows.skeleton.parents, windows.skeleton.root
        nodes = [joint for joint in range(len(parents)) if windows.protocol.root != "drop" or joint != root]
        self._root = nodes.index(root) if root in nodes else None
        self._limbs = torch.eye(len(nodes))  # limb vectors = _limbs @ joints; for the root, its own position
        for node, joint in enumerate(nodes):
            if parents[joint] in nodes:
                self._limbs[node, nodes.index(parents[joint])] = -1
        self._chains = torch.linalg.inv(self._limbs).round()

        candidates = windows.all(stride)
        x = interpolate_missing(candidates["x"], candidates.mask())[:, self._observed - 1 :]
        self._average = self._lengths(x[:, 0].unflatten(-1, (-1, 3))).mean(0)
        self._last = torch.empty(len(x), len(nodes) * 3)
        self._futures = torch.empty(len(nodes), len(x), 3, x.shape[1] - 1)  # products and sums run along rows
        for block in torch.arange(len(x)).split(512):
            joints = (Heading(self._skeleton).face(x[block]) if heading else x[block]).unflatten(-1, (-1, 3))
            lengths = self._lengths(joints)
            joints = self._chains @ ((self._average / lengths.clamp(min=1e-9))[..., None] * (self._limbs @ joints))
            self._last[block] = joints[:, 0].flatten(1)
            self._futures[:, block] = joints[:, 1:].permute(2, 0, 3, 1)
        self._squares = self._futures.square().sum((2, 3))

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self._last)

    def turn(self, x: Tensor) -> Tensor:
        """Return windows (..., T, D), rotated about the up axis so that the last observed frame has heading zero.

        Args:
            x: windows (..., T, D) in metres.
        """
        return Heading(self._skeleton, self._observed).face(x)

    def of(self, x: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return alternative futures of windows.

        Args:
            x: (B, T, D) float32, drawn from the windows; rotated by `turn` if `heading` is set.
            generator: random generator for the choice among more than M futures. Its state is not changed, so that the
                windows drawn next are the same with and without pseudo ground truth.

        Returns:
            (B, M, T, D), the observed frames of x followed by an alternative future, and (B, M), whether it is valid.
            Invalid entries are zeros.

        Raises:
            ValueError: x has another shape.
        """
        expected = (self._windows.length, self._windows.size)
        if x.ndim != 3 or x.shape[1:] != expected:
            raise ValueError(f"x must be windows (B, {expected[0]}, {expected[1]}), but has shape {tuple(x.shape)}")
        now = x[:, self._observed - 1]
        future = x[:, self._observed :].unflatten(-1, (-1, 3)).permute(0, 2, 3, 1)  # (B, n, 3, F)
        lengths = self._lengths(x[:, 0].unflatten(-1, (-1, 3)))
        own_generator = torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=generator.clone_state())))
        order = torch.rand(len(x), len(self), generator=own_generator)
        order.masked_fill_(~self._possible(now, future, lengths), torch.inf)
        # computes limb vectors of average length, rescales them, and assembles the poses again
        posing = self._chains @ ((lengths / self._average.clamp(min=1e-9))[:, :, None] * self._limbs)

        pseudo = x.new_zeros(len(x), self.most, *expected)
        valid = torch.zeros(len(x), self.most, dtype=torch.bool)
        count = torch.zeros(len(x), dtype=torch.long)
        rows = order.isfinite().any(1).nonzero()[:, 0]
        while len(rows):
            rank, index = order[rows].topk(min(2 * self.most, len(self)), largest=False)
            order[rows[:, None], index] = torch.inf
            last = posing[rows, None] @ self._last[index].unflatten(-1, (-1, 3))
            close = (last.flatten(2) - now[rows, None]).norm(dim=-1) < self.threshold
            others = self._futures[:, index.flatten()].flatten(2).unflatten(1, index.shape).transpose(0, 1)
            others = (posing[rows] @ others.flatten(2)).unflatten(2, (*index.shape[1:], 3, -1))  # (R, n, k, 3, F)
            far = (others - future[rows, :, None]).square().sum(3).sqrt().mean((1, 3)) >= self.minimum
            admissible = rank.isfinite() & close & far
            slot = count[rows, None] + admissible.cumsum(1) - 1
            row, column = (admissible & (slot < self.most)).nonzero().T
            target = rows[row], slot[row, column]
            valid[target] = True
            pseudo[*target, : self._observed] = x[rows[row], : self._observed]
            pseudo[*target, self._observed :] = others[row, :, column].permute(0, 3, 1, 2).flatten(2)
            count[rows] += admissible.sum(1)
            rows = rows[(count[rows] < self.most) & order[rows].isfinite().any(1)]
        return pseudo, valid

    def _possible(self, now: Tensor, future: Tensor, lengths: Tensor) -> Tensor:
        """Return (B, N), whether a candidate may meet the conditions; all others are excluded for certain."""
        shift = (lengths - self._average).abs() @ self._chains.T
        size = now.unflatten(-1, (-1, 3)).norm(dim=-1)
        slack = (shift + _ROUNDING * size).norm(dim=-1, keepdim=True)
        close = torch.cdist(now, self._last) < self.threshold + slack

        frames = future.shape[-1]
        squares = future.square().sum((2, 3))
        products = future.transpose(0, 1).flatten(2) @ self._futures.flatten(2).mT  # (n, B, N)
        distances = (squares.T[:, :, None] + self._squares[:, None] - 2 * products).clamp_(min=0).sqrt_()
        slack = shift + _ROUNDING * (squares / frames).sqrt()
        far = distances.mean(0) / frames**0.5 + slack.mean(1, keepdim=True) >= self.minimum
        possible: Tensor = close & far
        return possible

    def _lengths(self, joints: Tensor) -> Tensor:
        """Return limb lengths (..., n) of poses (..., n, 3); 1 for a root, which keeps its position."""
        lengths: Tensor = (self._limbs @ joints).norm(dim=-1)
        if self._root is not None:
            lengths[..., self._root] = 1
        return lengths


@dataclass(frozen=True, eq=False)
class WithPseudoTruths:
    """Training windows drawn together with their pseudo ground truth.

    Args:
        windows: windows to draw from.
        truths: source of alternative futures.
    """

    windows: Windows
    truths: PseudoTruths

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the windows."""
        return self.windows.fingerprint

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Draw windows like `Windows.sample`, rotated to heading zero if `truths.heading` is set.

        Args:
            batch_size: B, number of windows.
            generator: random generator on the CPU.

        Returns:
            "x" (B, T, D), "pseudo" (B, M, T, D) and "valid" (B, M), as from `PseudoTruths.of`. If joints may be
            missing, also "mask"; missing values are interpolated before the search for futures.
        """
        batch = self.windows.sample(batch_size, generator)
        x = interpolate_missing(batch["x"], batch.mask())
        x = self.truths.turn(x) if self.truths.heading else x
        pseudo, valid = self.truths.of(x, generator)
        return batch | {"x": x, "pseudo": pseudo, "valid": valid}
