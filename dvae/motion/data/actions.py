"""Actions of Human3.6M, read from the names of clips, and their five groups.

The groups are those of table 4 of Bie et al., 2022, arXiv 2204.01565, which trains its action classifier on them:
without translation, some of the 15 actions do not differ.
"""

from __future__ import annotations

import re

from .clips import Clip

GROUPS = {
    "0": ("Directions", "Discussion", "Greeting", "Photo", "Posing", "Purchases", "WalkDog", "Waiting"),
    "1": ("Eating", "Phoning", "Sitting", "Smoking"),
    "2": ("SittingDown",),
    "3": ("Walking",),
    "4": ("WalkTogether",),
}
"""Actions of Human3.6M by their group."""

ACTION, GROUP = "action", "group"
"""Labels of Human3.6M's clips that `human36m_label` returns."""

_GROUP_OF = {action: group for group, actions in GROUPS.items() for action in actions}
_ACTION_OF = {action.lower(): action for action in _GROUP_OF} | {
    "takingphoto": "Photo",
    "walkingdog": "WalkDog",
    "walkingtogether": "WalkTogether",
}
"""Actions by their spellings in public archives, in lower case."""


def human36m_label(clip: Clip, label: str) -> str:
    """Return the action or the group of a clip of Human3.6M.

    Clips are named by their action, which a number may follow: "Walking 1", "walkingdog_2", or "Photo.55011271" with
    the number of a camera.

    Args:
        clip: clip, named by its action.
        label: "action" or "group".

    Raises:
        ValueError: the name is not one of the 15 actions.
    """
    action = _ACTION_OF.get(re.sub(r"([ _]\d+)?(\.\d+)?$", "", clip.name).lower())
    if action is None:
        raise ValueError(
            f"clip {'/'.join(clip.key)} has no label {label!r}, and its name {clip.name!r} is not an action of "
            f"Human3.6M; expected one of {', '.join(_GROUP_OF)}, with or without a number, or a column {label} in "
            "labels.csv next to the file"
        )
    return action if label == ACTION else _GROUP_OF[action]
