"""Write a table of long forecasts of a run fitted on poses."""

from collections.abc import Callable
from pathlib import Path

import torch
import tyro

from .results import Table, loaded, tabled, write


@torch.no_grad()
def long_run(path: Path, count: int, seconds: float) -> Table:
    """Return a table of bone lengths and speed, by second, of forecasts beyond the training horizon."""
    run = loaded(path)
    test = run.data.windows("test")
    x = test.all()["x"]
    x = x[torch.linspace(0, len(x) - 1, count).long()]
    fps, observed = round(test.protocol.fps), test.protocol.observed
    torch.manual_seed(0)
    frames = round(seconds * fps)
    futures = torch.cat(
        [run.model.forecast(part[:, :observed], frames, 5, draw_emission=False)["x"] for part in x.split(40)], 1
    )
    generated, real = test.positions(futures), test.positions(x)
    lengths, true = test.skeleton.bone_lengths(generated), test.skeleton.bone_lengths(real).mean(1)
    error = (lengths / true[:, None] - 1).abs()  # (S, B, T, bones)
    moving = real.diff(dim=1).norm(dim=-1).mean() * fps
    spans = {str(second): slice((second - 1) * fps, second * fps) for second in range(1, frames // fps + 1)}
    bones = {second: error[:, :, now].mean((0, 1, 2)) for second, now in spans.items()}
    speeds = {second: generated[:, :, now].diff(dim=2).norm(dim=-1).mean() * fps for second, now in spans.items()}

    def worst(second: str) -> str:
        name = test.skeleton.names[test.skeleton.edges[int(bones[second].argmax())][1]]
        return f"{100 * bones[second].max():.1f} % ({name})"

    columns: dict[str, Callable[[str], str]] = {
        "bone-length error": lambda second: f"{100 * bones[second].mean():.1f} %",
        "worst bone": worst,
        "lengths off by > 10 %": lambda second: f"{100 * (error[:, :, spans[second]] > 0.1).float().mean():.1f} %",
        "joint speed, m/s": lambda second: f"{speeds[second]:.3f}",
        "of real motion's": lambda second: f"{speeds[second] / moving:.2f}",
    }
    return tabled({second: second for second in spans}, columns, "second")


def main(
    run: tyro.conf.Positional[Path],
    results: Path | None = None,
    count: int = 200,
    seconds: float = 10.0,
) -> None:
    """Write the table.

    Args:
        run: a run directory.
        results: folder of the tables, such as benchmarks/results; None prints them.
        count: number of windows to forecast.
        seconds: length of the forecasts.
    """
    write(results, {"hit_dvae/long-forecasts": long_run(run, count, seconds)})


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
