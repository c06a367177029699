"""Two methods on simulated people, from equations to scored forecasts, in a few minutes on a laptop.

`make demo` runs it. It prints the table of scores and saves demo/futures.png. Everything here is the public
interface; copy what you need.
"""

from pathlib import Path

import torch
from matplotlib.figure import Figure
from rich import print

import dvae
from dvae.motion.plot import futures

OUT = Path("demo")
STEPS = {"hit-dvae": 400, "srnn": 700}

people = dvae.motion.simulate(clips=160, frames=150, seed=0)
protocol = dvae.motion.PROTOCOLS["simulated"]
train, validation, test = (dvae.motion.windows(people, protocol, split) for split in ("train", "validation", "test"))

models = {}
for name, steps in STEPS.items():
    loss = {"loss": "evidence"} if name == "hit-dvae" else {}  # its paper's takes longer
    method = dvae.method(name, latent=8, self_feeding=1.0, warm_up=steps // 3, **loss)
    print(f"\n[bold]{name}[/bold]  {method.generative}   {method.inference}", method.source)
    torch.manual_seed(0)
    models[name] = method.build(train)
    rate = {"hit-dvae": 3e-3, "srnn": 1e-3}[name]
    recipe = method.train(train, validation, steps)
    result = recipe.fit(models[name], batch_size=32, learning_rate=rate, decay=0.5)
    print(f"best validation bound: {result.best_bound:.2f} nats a frame at step {result.best_step}")

training = dvae.motion.windows(people, protocol, "train+validation")
evaluation = dvae.evaluate(models, test, scores=dvae.motion.scores, samples=20, training_windows=training)
print(evaluation)

OUT.mkdir(exist_ok=True)
evaluation.save(OUT / "evaluation.json")
x = test.all()["x"][:1]
past, future = test.positions(x).split([protocol.observed, protocol.predicted], dim=1)
figure = Figure(figsize=(9, 2.6 * len(models)), layout="constrained")
for axes, (name, model) in zip(figure.subplots(len(models)), models.items(), strict=True):
    torch.manual_seed(0)
    samples = model.forecast({"x": x[:, : protocol.observed]}, horizon=protocol.predicted, samples=10)["x"]
    futures(test.skeleton, past[0], test.positions(samples)[:, 0], future[0], ax=axes)
    axes.set_title(name, fontsize=9)
figure.savefig(OUT / "futures.png", dpi=150)
print(f"saved {OUT / 'futures.png'} and {OUT / 'evaluation.json'}")
