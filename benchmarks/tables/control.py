"""Prints how diverse the parts of the body are in futures of runs, and in those that share one draw of the lower body.

The diversity is that of a part's coordinates alone (APD), over all test windows, or every few of them. Methods that
have variables for the parts (GSPS, BoM with its equation 14) are given the lower body of the first future; those that
hold a part by their training (`dlow --held lower`) have futures that share it as they are.
"""

from __future__ import annotations

from pathlib import Path

import torch
import tyro

import dvae
from dvae.inference.metrics import average_pairwise_distance
from dvae.motion.parts import UNIONS, body_parts

from .pages import table, write


@torch.no_grad()
def control(path: Path, samples: int, every: int = 1) -> list[list[str]]:
    """The run, and the mean diversity of the whole body, of the lower one and of the upper one; then with it held."""
    run = dvae.load(path)
    protocol, parts = run.data.protocol, body_parts(run.data.motion.skeleton, tuple(UNIONS))
    places = [slice(None), *([3 * j + axis for j in joints for axis in range(3)] for joints in parts.values())]
    windows, found = run.data.windows("test"), {}
    torch.manual_seed(0)
    for past in windows.all()["x"][::every, : protocol.observed].split(64):
        free = run.model.forecast(past, protocol.predicted, samples)
        futures = {path.name: free}
        if "lower" in free:
            given = {"lower": free["lower"][0]}
            futures[f"{path.name}, lower held"] = run.model.forecast(past, protocol.predicted, samples, fix=given)
        for name, each in futures.items():
            x = each["x"].movedim(0, 1)
            apd = torch.stack([average_pairwise_distance(x[..., place]) for place in places])
            found.setdefault(name, []).append(apd)
    return [
        [name, *(f"{mean:.3f}" for mean in torch.cat(values, 1).mean(1).tolist())] for name, values in found.items()
    ]


def shown(rows: list[list[str]]) -> str:
    """The table of such rows."""
    return table(["", "APD", *(f"APD {part}" for part in UNIONS)], rows)


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]], page: Path | None = None, samples: int = 50, every: int = 1
) -> None:
    """Print the table.

    Args:
        runs: their directories.
        page: where to write it, between marks.
        samples: futures of a window.
        every: windows from one that counts to the next.
    """
    write(page, shown([row for path in runs for row in control(path, samples, every)]))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
