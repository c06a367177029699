"""Exchange: combine the first pose of one window with the paths of another, to test how well motion follows paths.

TrajeVAE (Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351) pairs a pose with the trajectories of another sequence
whose given joints start at the same place. It compares forecasts with the sequence of the trajectories; its public code
compares with the sequence of the pose. Our choice: each window has one partner from another clip. The same windows with
their own poses serve as a baseline, since windows with partners may be easier or harder than others.
"""

from __future__ import annotations

import hashlib
from math import inf
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from .protocols import Windows


class ExchangedWindows:
    """Windows that begin with the pose of another window, for `dvae.evaluate`.

    Window n keeps its frames and paths, except that its first frame is replaced with the first frame of a partner. A
    partner is a window of another clip whose given joints have nearly the same positions relative to the pelvis.
    Windows without a partner are left out. Multimodal errors are undefined, because the windows that begin with the
    exchanged pose have different paths.

    Args:
        windows: windows with one observed frame and the same given joints everywhere, e.g. `windows.given(["LWrist"])`.
        threshold: maximum distance in metres between each given joint in the two first frames.
        seed: seed for the choice among partners.
        own_pose: whether every window keeps its own pose, as a baseline on the same windows.
        truth: window whose motion is the truth in scores: "path", the window of the paths, as in TrajeVAE's text, or
            "pose", the window of the first pose, as in its public code.

    Raises:
        ValueError: windows have no given joints or more than one observed frame, the threshold is not positive, or no
            window has a partner.
    """

    def __init__(
        self,
        windows: Windows,
        threshold: float = 0.01,
        seed: int = 0,
        *,
        own_pose: bool = False,
        truth: Literal["path", "pose"] = "path",
    ):
        if not windows.given_joints or windows.protocol.observed != 1:
            raise ValueError(
                "poses are exchanged among windows with one observed pose and the same given joints, as in "
                f"windows.given(['LWrist']); these have {windows.protocol.observed} observed frames and "
                f"{', '.join(windows.given_joints or ()) or 'no'} given joints"
            )
        if windows.missing:
            raise ValueError(
                "only whole poses can be exchanged, but these windows may have missing joints; fill them in "
                "first (`dvae impute RUN --filled FILE`)"
            )
        if not threshold > 0:
            raise ValueError(f"`threshold` must be a positive distance in metres, got {threshold}")
        if truth not in ("path", "pose"):
            raise ValueError(f"`truth` must be 'path' or 'pose' (the window whose motion is the truth), got {truth!r}")
        self.windows, self.threshold, self.seed, self.missing = windows, threshold, seed, False
        self.own_pose, self.truth = own_pose, truth
        self.protocol, self.skeleton, self.joints = windows.protocol, windows.skeleton, windows.joints
        self.given_joints, self.positions = windows.given_joints, windows.positions
        self._rows, partners = self._pairs()
        self._partners = self._rows if own_pose else partners

    def _pairs(self) -> tuple[Tensor, Tensor]:
        """Return the indices of windows with a partner, and of their partners."""
        first = self.windows.all()["y"][:, 0].unflatten(-1, (-1, 3))
        first = first[:, [self.joints.index(name) for name in self.given_joints or ()]]
        clips = [key[:2] for key in self.windows.keys]
        clip = torch.tensor([clips.index(key) for key in clips])
        generator = torch.Generator().manual_seed(self.seed)
        rows, partners, nearest = [], [], inf
        for n, joints in enumerate(first):
            distances = (first - joints).norm(dim=-1).amax(-1).masked_fill(clip == clip[n], inf)
            close = (distances < self.threshold).nonzero()[:, 0]
            nearest = min(nearest, distances.min().item())
            if len(close):
                rows.append(n)
                partners.append(int(close[torch.randint(len(close), (), generator=generator)]))
        if not rows:
            raise ValueError(
                f"no two windows of different clips have {', '.join(self.given_joints or ())} within "
                f"{self.threshold:g} m; the nearest two are {nearest:.3g} m apart; raise `threshold`"
            )
        return torch.tensor(rows), torch.tensor(partners)

    references: ClassVar = Windows.references

    @property
    def description(self) -> dict[str, Any]:
        """Description of the windows and of the exchange of poses, for the record of an evaluation."""
        description, partners = self.windows.description, len(self._partners.unique())
        exchanged = {"threshold": self.threshold, "seed": self.seed, "partners": partners, "truth": self.truth}
        title = [
            *description["title"],
            "with own poses" if self.own_pose else f"first poses of {partners} other windows",
        ]
        return {**description, "exchanged": exchanged, "title": title}

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """(split, clip, first frame) of the windows whose paths are used."""
        keys = self.windows.keys
        return [keys[n] for n in self._rows.tolist()]

    def all(self) -> dict[str, Tensor]:
        """Return all windows, in the format of `Windows.all`."""
        windows = self.windows.all()
        batch = {name: values[self._rows] for name, values in windows.items()}
        poses = windows["x"][self._partners]
        batch["x"] = poses if self.truth == "pose" else torch.cat([poses[:, :1], batch["x"][:, 1:]], 1)
        return batch

    def labels(self, name: str) -> list[str]:
        """Return the label of each window's clip.

        Args:
            name: name of the label, such as "action".
        """
        labels = self.windows.labels(name)
        return [labels[n] for n in self._rows.tolist()]

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the windows and the partners."""
        pairs = self._rows.tolist(), self._partners.tolist()
        return hashlib.sha256(f"{self.windows.fingerprint} {pairs}".encode()).hexdigest()
