"""Draw docs/img/overview.png, the picture of the README, with the model that its example fits, in half a minute."""

import re
from pathlib import Path
from typing import Any

import torch
import tyro

from dvae.inference.evaluation.result import new_figure, styled

from .results import DOCS


def example(steps: int = 600) -> dict[str, Any]:
    """Run the example of the README for a number of training steps and return its variables."""
    (text,) = re.findall(r"```python\n(.*?)```", (DOCS.parent / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    if "steps=600" not in text:
        raise ValueError("the example of the README fits for another number of steps than 600; adapt this script")
    variables: dict[str, Any] = {}
    exec(compile(text.replace("steps=600", f"steps={steps}"), "README.md", "exec"), variables)
    return variables


@styled
def main(out: Path = DOCS / "img" / "overview.png", steps: int = 600) -> None:
    """Fit and draw.

    Args:
        out: file of the picture.
        steps: number of training steps.
    """
    variables = example(steps)
    model, test = variables["model"], variables["test"]
    x = test.all()["x"]
    torch.manual_seed(0)
    futures = model.forecast({"x": x[:, : test.observed]}, x.shape[1] - test.observed, samples=500)["x"][..., 0]

    figure = new_figure(7, 3.6)
    top, bottom = figure.subfigures(2, 1)
    left, right = top.subplots(1, 2)
    model.generative.draw(4, ax=left).set_title("model: p(z_t | z_{t-1}) p(x_t | z_t)")
    model.inference.draw(4, ax=right).set_title("guide: q(z_t | z_{t-1}, x_{t:T})")
    panels = bottom.subplots(1, 3, sharey=True)
    for n, panel in enumerate(panels):
        for level in (0.5, 0.9):
            low, high = futures[:, n].quantile(torch.tensor([(1 - level) / 2, (1 + level) / 2]), dim=0)
            panel.fill_between(range(test.observed, x.shape[1]), low, high, color="C0", alpha=0.3, linewidth=0)
        panel.plot(x[n, :, 0], color="black", linewidth=1)
        panel.axvline(test.observed - 0.5, color="0.6", linewidth=0.8)
        panel.set_xlabel("step")
    panels[0].set_ylabel("x")
    figure.savefig(out, dpi=200)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
