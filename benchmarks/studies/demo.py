"""Two methods on simulated people, from equations to scored forecasts, in a few minutes on a laptop.

`make demo` runs it. It prints the table of scores, and saves demo/futures.png and demo/report.html. After Ctrl-C,
`make demo` continues. Everything here is the public interface; copy what you need.
"""

import os
import shutil
import signal
import sys
from pathlib import Path

if __name__ == "__main__":  # during an import, a KeyboardInterrupt can become any error
    signal.signal(signal.SIGINT, lambda *_: os.write(2, b"interrupted\n") and os._exit(130))

import torch
import tyro
from matplotlib.figure import Figure
from rich import print

import dvae
from dvae.cli import main as command
from dvae.inference.training.checkpoints import Run
from dvae.inference.training.fit import Fit
from dvae.inference.training.recipe import Trainable
from dvae.motion.drawing.plot import futures
from dvae.runs.directory import read_config, resume
from dvae.runs.kinds import Dataset

PROTOCOL = dvae.motion.Protocol("one second", observed=15, predicted=30, fps=30, train_stride=5, test_stride=15)
STEPS = {"bom-parts": 500, "hit-dvae": 600}
RATES = {"bom-parts": 1e-3, "hit-dvae": 3e-3}


def main(out: Path = Path("demo"), share: float = 1.0, samples: int = 20, clips: int = 160) -> None:
    """Fit, score, draw and report.

    Args:
        out: folder of data, runs, scores, picture and page; replaces an earlier complete demonstration.
        share: fraction of the training steps.
        samples: number of scored futures of each window.
        clips: number of simulated clips.
    """
    out.mkdir(parents=True, exist_ok=True)
    report = out / "report.html"
    if report.exists():
        shutil.rmtree(out / "runs", ignore_errors=True)
        report.unlink()
    dvae.motion.save(out / "people.npz", dvae.motion.simulate(clips=clips, frames=150, seed=1))
    data = dvae.motion.MotionData.open(out / "people.npz", PROTOCOL)
    test = data.windows("test")

    steps = {name: max(round(share * number), 1) for name, number in STEPS.items()}
    options = {"latent": 8, "scheduled_sampling": 1.0, "warm_up": steps["hit-dvae"] // 3}
    methods = {
        "bom-parts": dvae.method("bom-parts", width=64),
        "hit-dvae": dvae.method("hit-dvae", loss="evidence", **options),  # the loss of its paper takes longer
    }
    runs = {name: out / "runs" / name for name in methods}
    for name, run in runs.items():
        method = methods[name]
        print(f"\n[bold]{name}[/bold]  {method.generative}   {method.inference}", method.source)
        training = dvae.Training(steps=steps[name], batch_size=32, learning_rate=RATES[name], decay=0.5)
        result = fit_or_resume(method, data, run, training)
        print(result.best)

    models = {name: dvae.load(run).model for name, run in runs.items()}
    evaluation = dvae.evaluate(
        models,
        test,
        scores=dvae.motion.scores,
        samples=samples,
        training_windows=data.windows("train+validation"),
        configs={name: Run(run).config for name, run in runs.items()},
    )
    print(evaluation.table(["energy score", "ADE", "APD", "limb stretch"]))
    for name in methods:
        errors, energy = (evaluation.difference(name, "nearest neighbours", score) for score in ("ADE", "energy score"))
        print(f"{name} minus nearest neighbours, in metres: ADE {errors}, energy score {energy}")

    for folder in (out, *runs.values()):
        evaluation.save(folder / "evaluation.json")
    x = test.all()["x"][:1]
    past, future = test.positions(x).split([PROTOCOL.observed, PROTOCOL.predicted], dim=1)
    figure = Figure(figsize=(7, 2.2 * len(models)), layout="constrained")
    for axes, (name, model) in zip(figure.subplots(len(models)), models.items(), strict=True):
        torch.manual_seed(0)
        observed, horizon = {"x": x[:, : PROTOCOL.observed]}, PROTOCOL.predicted
        samples = model.forecast(observed, horizon, samples=10, draw_emission=False)["x"]
        futures(test.skeleton, past[0], test.positions(samples)[:, 0], future[0], ax=axes)
        axes.set_title(name)
    figure.savefig(out / "futures.png", dpi=150)
    print(f"saved {out / 'futures.png'} and {out / 'evaluation.json'}")
    if command(["report", *map(str, runs.values()), "--out", str(report)]):
        raise SystemExit("the report failed")


def fit_or_resume(method: Trainable, data: Dataset, run: Path, training: dvae.Training) -> Fit:
    """Fit a method, or continue a run that was interrupted."""
    if Run(run).exists:
        before = read_config(run)
        if (before.training.steps, before.data.fingerprint) == (training.steps, data.fingerprint):
            return resume(run)
        shutil.rmtree(run)
    return dvae.fit(method, data, out=run, **vars(training))


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        tyro.cli(main, description=__doc__)
    except KeyboardInterrupt:
        print("interrupted; the same command continues", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
