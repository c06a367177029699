"""Read the side and the part of the body from joint names, in any order and spelling."""

from __future__ import annotations

import re
from collections.abc import Sequence

_PREFIX = re.compile(r"^(.*[:|]|bip\d*[ _]|b_|j_|m_avg_|mixamorig\d*_?|cc_base_)", re.IGNORECASE)
_SIDE = (
    re.compile(r"^(?P<l>left)?(?P<r>right)?(?=.)", re.IGNORECASE),
    re.compile(r"(?P<l>left)?(?P<r>right)?$", re.IGNORECASE),
    re.compile(r"(?P<l>left)|(?P<r>right)", re.IGNORECASE),
    re.compile(r"(?<=[ _.\-])(?:(?P<l>l)|(?P<r>r))(?=$|[ _.\-])", re.IGNORECASE),
    re.compile(r"^(?:(?P<l>[lL])|(?P<r>[rR]))(?=[ _.\-]|[A-Z])"),
    re.compile(r"(?<=[a-z])(?:(?P<l>L)|(?P<r>R))$"),
)
"""Patterns for the written-out side, or for its letter next to a separator or a change of case."""


def readings(name: str) -> list[tuple[str, str]]:
    """Return the possible readings (side, word) of a joint name, the most likely first.

    The side is "l", "r" or "" for none. The word names the part of the body, in lower case without separators. For
    example, "LeftUpLeg" has the reading ("l", "upleg"). "lhumerus" has two readings, ("", "lhumerus") and
    ("l", "humerus").
    """
    name = _PREFIX.sub("", name)
    for pattern in _SIDE:
        match = pattern.search(name)
        if match and match.group():
            word = name[: match.start()] + name[match.end() :]
            return [("l" if match["l"] else "r", letters(word))]
    word = letters(name)
    return [("", word), *([(word[0], word[1:])] if word[:1] in ("l", "r") else [])]


def letters(word: str) -> str:
    """Return the word in lower case without separators."""
    return re.sub(r"[ _.\-]", "", word).lower()


def sides(names: Sequence[str]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the indices of the left joints and of the right joints.

    Joints without a counterpart on the other side are left out.

    Args:
        names: names of all joints.
    """
    joints_by_reading: dict[tuple[str, str], list[int]] = {}
    for joint, name in enumerate(names):
        for reading in readings(name):
            joints_by_reading.setdefault(reading, []).append(joint)
    words = {
        word for _, word in joints_by_reading if ("l", word) in joints_by_reading and ("r", word) in joints_by_reading
    }
    left, right = (
        tuple(sorted(joint for word in words for joint in joints_by_reading[side, word])) for side in ("l", "r")
    )
    return left, right
