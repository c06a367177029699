"""Euler angle errors by action, on the windows of Human3.6M's benchmark of exponential maps.

The benchmark scores eight windows of each of 15 actions of subject 5, four of each of its two clips. Their starts are
drawn with a fixed seed. The draws are those of the public code of Martinez, Black and Romero, 2017, arXiv 1705.02445,
which took them from Jain et al., 2016, arXiv 1511.05298. The predicted frames of a window are the same for every number
of observed frames. Figure 10 of Aliakbarian et al., 2020, arXiv 1908.00733, shows errors of these actions.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...inference.evaluation.evaluation import Evaluation
from ...inference.evaluation.result import Table
from ..data.protocols import Windows
from ..geometry.euler import TIMES

ACTION = "action"
"""Label of clips with the name of their action."""
SEED = 1234567890
BEFORE, AFTER, FIRST, DRAWS = 50, 100, 16, 8
"""Frames before and after the first predicted frame that are left free, least draw, and number of draws."""


def action_windows(windows: Windows) -> Windows:
    """Return the eight windows of each action, at 25 frames per second.

    Args:
        windows: test windows, whose clips have the label "action".

    Raises:
        ValueError: the windows have another rate or more frames than the benchmark, or an action does not have two
            clips that are long enough.
    """
    protocol = windows.protocol
    observed, predicted = protocol.observed, windows.length - protocol.observed
    if protocol.fps != 25 or observed > BEFORE + FIRST or predicted > AFTER:
        raise ValueError(
            f"the benchmark has 25 frames per second, at most {BEFORE + FIRST} observed and {AFTER} predicted frames; "
            f"{protocol.name} has {protocol.fps:g}, {observed} and {predicted}"
        )
    clips: dict[str, list[tuple[str, str, int]]] = {}
    for clip in sorted(windows.clips, key=lambda clip: clip.key):
        clips.setdefault(clip.labels.get(ACTION, ""), []).append((*clip.key, clip.frames - BEFORE - AFTER))
    keys = []
    for action, pair in clips.items():
        if not action or len(pair) != 2 or min(count for *_, count in pair) <= FIRST:
            names = ", ".join(f"{split}/{name}" for split, name, _ in pair)
            raise ValueError(
                f"the action {action!r} has the clips {names}; the benchmark needs two clips of each action with the "
                f"label {ACTION!r} and more than {BEFORE + AFTER + FIRST} frames"
            )
        random = np.random.RandomState(SEED)
        for draw in range(DRAWS):
            split, name, count = pair[draw % 2]
            keys.append((split, name, int(random.randint(FIRST, count)) + BEFORE - observed))
    return windows.at(keys)


def errors_by_action(evaluation: Evaluation, windows: Windows, model: str, count: int) -> Table:
    """Return a table of a model's errors: one row per action, and the mean over actions.

    Args:
        evaluation: errors from `euler_errors` on `windows`.
        windows: windows of all actions, as from `action_windows`.
        model: name of the model.
        count: number K of futures from which the best is chosen.
    """
    actions = {"/".join(clip.key): clip.labels[ACTION] for clip in windows.clips}
    rows: Mapping[str, np.ndarray] = evaluation.rows[model].cluster_means
    names = [name for time in TIMES if (name := f"{time:g} ms, best of {count}") in rows]
    table = Table(
        title=f"{model} · Euler angles (rad), best of {count}",
        caption=f"mean of {DRAWS} windows of each action ± standard error over its two clips; last row: over actions",
    )
    for header in ("", *(name.partition(",")[0] for name in names)):
        table.add_column(header, justify="right" if header else "left")
    of_cluster = np.array([actions[cluster] for cluster in evaluation.clusters])
    errors = np.array([rows[name] for name in names])  # each clip has half of the windows of its action
    means = []
    for action in dict.fromkeys(of_cluster.tolist()):
        of_action = errors[:, of_cluster == action]
        means.append(of_action.mean(1))
        table.add_row(action, *map(_cell, means[-1], of_action.std(1, ddof=1) / 2**0.5))
    number = len(means)
    deviation = np.std(means, 0, ddof=1) if number > 1 else np.full(len(names), np.nan)
    table.add_section()
    table.add_row("mean", *map(_cell, np.mean(means, 0), deviation / number**0.5))
    return table


def _cell(mean: float, error: float) -> str:
    return f"{mean:.2f} ± " + ("–" if np.isnan(error) else f"{error:.2f}")
