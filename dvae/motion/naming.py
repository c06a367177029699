"""Names of joints, as people and programs write them: a side of the body and a word, in any order and spelling."""

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
"""By the word, or by its letter between marks or where capitals mark it."""


def readings(name: str) -> list[tuple[str, str]]:
    """Side ("l", "r" or nothing) and word that a name may mean, the surest first, as "lhumerus" means l humerus."""
    name = _PREFIX.sub("", name)
    for pattern in _SIDE:
        found = pattern.search(name)
        if found and found.group():
            word = name[: found.start()] + name[found.end() :]
            return [("l" if found["l"] else "r", letters(word))]
    word = letters(name)
    return [("", word), *([(word[0], word[1:])] if word[:1] in ("l", "r") else [])]


def letters(word: str) -> str:
    """A word without the marks that separate its parts, in small letters."""
    return re.sub(r"[ _.\-]", "", word).lower()


def sides(names: Sequence[str]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Joints on the left and on the right: those whose word is there on both sides."""
    there: dict[tuple[str, str], list[int]] = {}
    for joint, name in enumerate(names):
        for meant in readings(name):
            there.setdefault(meant, []).append(joint)
    words = {word for _, word in there if ("l", word) in there and ("r", word) in there}
    left, right = (tuple(sorted(joint for word in words for joint in there[side, word])) for side in ("l", "r"))
    return left, right
