"""Exchange: one window's first pose with another's paths, to see whether motion follows what it is told.

TrajeVAE (Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351) gives a pose the trajectories of another sequence whose
given joints start at the same place, and compares with the sequence that the trajectories come from; its public code,
with the one that the pose comes from. Ours: one partner for each window, of another clip, and the same windows with
their own poses, as those that have partners may be easier or harder than others.
"""

from __future__ import annotations

import hashlib
from math import inf
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from .protocols import Windows


class Exchanged:
    """Windows that begin with the pose of another window, as `dvae.evaluate` takes them.

    Window n keeps its frames and paths but for the first frame, which is that of another one whose given joints are
    there at nearly the same place relative to the pelvis. Windows that have no such partner are left out. Multimodal
    errors there are none: the windows that begin with that pose have paths of their own.

    Args:
        windows: with the same joints given everywhere, `windows.given(["LWrist"])`, and one observed frame.
        threshold: metres, within which each given joint is in both first frames.
        seed: of the choice among partners.
        own: leave every window its own pose: the same windows, beside which to see what the exchange changes.
        truth: the motion that is to be met is that of the window whose "path" it is, as TrajeVAE's text says, or of the
            one whose "pose", as its public code has it.

    Raises:
        ValueError: windows without given joints or with more than one observed frame, a threshold that is no distance,
            or no window with a partner.
    """

    def __init__(
        self,
        windows: Windows,
        threshold: float = 0.01,
        seed: int = 0,
        *,
        own: bool = False,
        truth: Literal["path", "pose"] = "path",
    ):
        if not windows.given_joints or windows.protocol.observed != 1:
            raise ValueError(
                "what is exchanged is one pose among windows with the same given joints, as in "
                f"windows.given(['LWrist']); these have {windows.protocol.observed} observed frames and are given "
                f"{', '.join(windows.given_joints or ()) or 'no joints'}"
            )
        if windows.missing:
            raise ValueError(
                "poses are exchanged whole, but these windows may lack joints; fill the gaps first (`dvae impute RUN "
                "--filled FILE`)"
            )
        if not threshold > 0:
            raise ValueError(f"the threshold is {threshold}; it must be a positive distance in metres")
        if truth not in ("path", "pose"):
            raise ValueError(f"truth is {truth!r}; expected 'path' or 'pose', whose window's motion it is")
        self.windows, self.threshold, self.seed, self.missing = windows, threshold, seed, False
        self.own, self.truth = own, truth
        self.protocol, self.skeleton, self.joints = windows.protocol, windows.skeleton, windows.joints
        self.given_joints, self.positions = windows.given_joints, windows.positions
        self._kept, partners = self._pairs()
        self._partners = self._kept if own else partners

    def _pairs(self) -> tuple[Tensor, Tensor]:
        """Windows that have a partner, and theirs."""
        first = self.windows.all()["y"][:, 0].unflatten(-1, (-1, 3))
        first = first[:, [self.joints.index(name) for name in self.given_joints or ()]]
        clips = [key[:2] for key in self.windows.keys]
        clip = torch.tensor([clips.index(key) for key in clips])
        generator = torch.Generator().manual_seed(self.seed)
        kept, partners, nearest = [], [], inf
        for n, joints in enumerate(first):
            apart = (first - joints).norm(dim=-1).amax(-1).masked_fill(clip == clip[n], inf)
            close = (apart < self.threshold).nonzero()[:, 0]
            nearest = min(nearest, apart.min().item())
            if len(close):
                kept.append(n)
                partners.append(int(close[torch.randint(len(close), (), generator=generator)]))
        if not kept:
            raise ValueError(
                f"no two windows of different clips have {', '.join(self.given_joints or ())} within "
                f"{self.threshold:g} m; the nearest two are {nearest:.3g} m apart"
            )
        return torch.tensor(kept), torch.tensor(partners)

    references: ClassVar = Windows.references

    @property
    def description(self) -> dict[str, Any]:
        """What a record says of these windows, and how poses were exchanged."""
        said, partners = self.windows.description, len(self._partners.unique())
        exchanged = {"threshold": self.threshold, "seed": self.seed, "partners": partners, "truth": self.truth}
        title = [*said["title"], "with own poses" if self.own else f"first poses of {partners} other windows"]
        return {**said, "exchanged": exchanged, "title": title}

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """(split, clip, first frame) of the windows that the paths come from."""
        keys = self.windows.keys
        return [keys[n] for n in self._kept.tolist()]

    def all(self) -> dict[str, Tensor]:
        """The windows, as of `Windows.all`."""
        whole = self.windows.all()
        batch = {name: values[self._kept] for name, values in whole.items()}
        poses = whole["x"][self._partners]
        batch["x"] = poses if self.truth == "pose" else torch.cat([poses[:, :1], batch["x"][:, 1:]], 1)
        return batch

    def labels(self, name: str) -> list[str]:
        """The label of every window's clip."""
        labels = self.windows.labels(name)
        return [labels[n] for n in self._kept.tolist()]

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the windows and the partners."""
        pairs = self._kept.tolist(), self._partners.tolist()
        return hashlib.sha256(f"{self.windows.fingerprint} {pairs}".encode()).hexdigest()
