"""Writes the table of long forecasts of docs/results/hit_dvae.md, of a run fitted on poses."""

from pathlib import Path

import torch
import tyro

from .pages import DOCS, loaded, table, write


@torch.no_grad()
def long_run(path: Path, count: int, seconds: float) -> str:
    """Bones and speed of forecasts that run on far past the horizon of training, second by second."""
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
    ours, real = test.positions(futures), test.positions(x)
    lengths, true = test.skeleton.bone_lengths(ours), test.skeleton.bone_lengths(real).mean(1)
    error = (lengths / true[:, None] - 1).abs()  # (S, B, T, bones)
    moving = real.diff(dim=1).norm(dim=-1).mean() * fps
    rows = []
    for end in range(fps, frames + 1, fps):
        now = slice(end - fps, end)
        speed = ours[:, :, now].diff(dim=2).norm(dim=-1).mean() * fps
        bones = error[:, :, now].mean((0, 1, 2))
        worst = test.skeleton.names[test.skeleton.edges[int(bones.argmax())][1]]
        beyond = (error[:, :, now] > 0.1).float().mean()
        rows.append(
            [
                f"{end // fps}",
                f"{100 * bones.mean():.1f} %",
                f"{100 * bones.max():.1f} % ({worst})",
                f"{100 * beyond:.1f} %",
                f"{speed:.3f}",
                f"{speed / moving:.2f}",
            ]
        )
    header = [
        "second",
        "bone-length error",
        "worst bone",
        "lengths off by > 10 %",
        "joint speed, m/s",
        "of real motion's",
    ]
    return table(header, rows)


def main(
    run: tyro.conf.Positional[Path],
    page: Path | None = DOCS / "results" / "hit_dvae.md",
    count: int = 200,
    seconds: float = 10.0,
) -> None:
    """Write the table.

    Args:
        run: a run directory.
        page: where; with None it is printed.
        count: windows from which forecasts run on.
        seconds: for so long.
    """
    write(page, long_run(run, count, seconds), name="long forecasts")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
