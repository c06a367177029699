"""Draw docs/img/overview.png, the picture of the README: its example, fitted for ten times as many steps.

This takes three minutes on one core. The lower row shows ten futures of one test window, chosen by a fixed rule. In
candidate windows, a wrist is below its shoulder in the observed frames and above the head at some time after. The
selected one has the median error of the best of ten among all candidates.
"""

from pathlib import Path

import torch
import tyro
from matplotlib.figure import Figure

import dvae
from dvae.motion.drawing.plot import futures
from dvae.motion.scoring.metrics import average_displacement_error

from .results import DOCS


def main(out: Path = DOCS / "img" / "overview.png", steps: int = 6000, clips: int = 400) -> None:
    """Fit and draw.

    Args:
        out: where the picture goes.
        steps: of training.
        clips: of simulated people.
    """
    people = dvae.motion.simulate(clips=clips)
    protocol = dvae.motion.PROTOCOLS["simulated"]
    train, validation, test = (dvae.motion.windows(people, protocol, s) for s in ("train", "validation", "test"))
    torch.manual_seed(0)
    model = dvae.DynamicalVAE(
        generative="p(w) p(z_t | z_{<t}, w) p(x_t | z_t, w)",
        inference="q(w | x_{1:T}) q(z_t | x_{1:T}, w)",
        sizes={"w": 16, "z": 16, "x": train.size},
        network=dvae.networks.Recurrent(width=64),
        distributions={"p(x)": dvae.distributions.FixedNormal(scale=0.1, learned=True)},
    )
    dvae.fit(model, train, validation, steps=steps, batch_size=16, learning_rate=6e-3, decay=0.5)

    x, observed = test.all()["x"], protocol.observed
    torch.manual_seed(0)
    samples = model.forecast({"x": x[:, :observed]}, protocol.predicted, samples=10, draw_emission=False)["x"]
    errors = average_displacement_error(samples.movedim(0, 1), x[:, observed:])

    def height(joint: str) -> torch.Tensor:
        """Of a joint above the pelvis, (windows, frames)."""
        return test.positions(x)[:, :, test.skeleton.find(joint), test.skeleton.vertical]

    raised = torch.zeros(len(x), dtype=torch.bool)
    for side in ("L", "R"):
        wrist = height(f"{side}Wrist")
        hangs = (wrist < height(f"{side}Shoulder"))[:, :observed].all(1)
        raised |= hangs & (wrist > height("Head"))[:, observed:].any(1)
    chosen = raised.nonzero()[:, 0]
    chosen = chosen[errors[chosen].argsort()[len(chosen) // 2]]
    print(f"{int(raised.sum())} of {len(x)} windows; drawn is {test.keys[chosen]}, off by {errors[chosen]:.3f} m")

    figure = Figure(figsize=(9, 5.8), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=(3, 2.6))
    left, right = top.subplots(1, 2)
    model.generative.draw(4, ax=left).set_title("model", fontsize=10)
    dvae.audit(model.generative, model.inference).draw(4, ax=right).set_title("guide", fontsize=10)
    past, future = test.positions(x[chosen]).split([observed, protocol.predicted])
    futures(test.skeleton, past, test.positions(samples[:, chosen]), future, ax=bottom.subplots())

    figure.savefig(out, dpi=120)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
