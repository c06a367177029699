"""Two methods on simulated people, from equations to scored forecasts, in a few minutes on a laptop.

`make demo` runs it. It prints the table of scores and saves demo/futures.png. Everything here is the public
interface; copy what you need.
"""

from pathlib import Path

import torch
import tyro
from matplotlib.figure import Figure
from rich import print

import dvae
from dvae.motion.plot import futures

STEPS = {"hit-dvae": 400, "srnn": 700}
RATES = {"hit-dvae": 3e-3, "srnn": 1e-3}


def main(out: Path = Path("demo"), share: float = 1.0, samples: int = 20, clips: int = 160) -> None:
    """Fit, score and draw.

    Args:
        out: where the scores and the picture go.
        share: of the steps of training.
        samples: futures of a window that are scored.
        clips: of simulated people.
    """
    people = dvae.motion.simulate(clips=clips, frames=150, seed=0)
    protocol = dvae.motion.PROTOCOLS["simulated"]
    train, validation, test = (
        dvae.motion.windows(people, protocol, split) for split in ("train", "validation", "test")
    )

    models = {}
    for name in RATES:
        steps = max(round(share * STEPS[name]), 1)
        loss = {"loss": "evidence"} if name == "hit-dvae" else {}  # its paper's takes longer
        method = dvae.method(name, latent=8, self_feeding=1.0, warm_up=steps // 3, **loss)
        print(f"\n[bold]{name}[/bold]  {method.generative}   {method.inference}", method.source)
        torch.manual_seed(0)
        models[name] = method.build(train)
        recipe = method.train(train, validation, steps)
        result = recipe.fit(models[name], batch_size=32, learning_rate=RATES[name], decay=0.5)
        print(f"best validation bound: {result.best_bound:.2f} nats a frame at step {result.best_step}")

    training = dvae.motion.windows(people, protocol, "train+validation")
    evaluation = dvae.evaluate(models, test, scores=dvae.motion.scores, samples=samples, training_windows=training)
    print(evaluation)

    out.mkdir(exist_ok=True)
    evaluation.save(out / "evaluation.json")
    x = test.all()["x"][:1]
    past, future = test.positions(x).split([protocol.observed, protocol.predicted], dim=1)
    figure = Figure(figsize=(9, 2.6 * len(models)), layout="constrained")
    for axes, (name, model) in zip(figure.subplots(len(models)), models.items(), strict=True):
        torch.manual_seed(0)
        samples = model.forecast({"x": x[:, : protocol.observed]}, horizon=protocol.predicted, samples=10)["x"]
        futures(test.skeleton, past[0], test.positions(samples)[:, 0], future[0], ax=axes)
        axes.set_title(name, fontsize=9)
    figure.savefig(out / "futures.png", dpi=150)
    print(f"saved {out / 'futures.png'} and {out / 'evaluation.json'}")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
