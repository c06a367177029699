"""Draws docs/img/overview.png, the picture of the README, from a run:

    dvae fit hit-dvae --loss evidence --latent 8 --steps 350 --warm-up 110 --learning-rate 2e-3 --batch-size 32 \\
        --out runs/overview
    python docs/overview.py runs/overview
"""

import sys
from pathlib import Path

import torch
from matplotlib.figure import Figure

import dvae
from dvae.motion.plot import futures

run = dvae.load(sys.argv[1])
figure = Figure(figsize=(9, 5.6), layout="constrained")
top, bottom = figure.subfigures(2, 1, height_ratios=(3, 2.4))

model, guide = top.subplots(1, 2)
run.model.generative.draw(4, ax=model).set_title("model", fontsize=10)
dvae.audit(run.model.generative, run.model.inference).draw(4, ax=guide).set_title("guide", fontsize=10)

windows = run.data.windows("test")
observed = windows.protocol.observed
window = windows.labels("activity").index("wave-both")
x = windows.all()["x"][window : window + 1]
torch.manual_seed(0)
samples = run.model.forecast({"x": x[:, :observed]}, horizon=windows.protocol.predicted, samples=10)["x"]
past, future = windows.positions(x)[0, :observed], windows.positions(x)[0, observed:]
futures(windows.skeleton, past, windows.positions(samples)[:, 0], future, ax=bottom.subplots())

path = Path(__file__).parent / "img" / "overview.png"
figure.savefig(path, dpi=120)
