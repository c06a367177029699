"""Speed of GSPS at the Human3.6M preset: `python -m benchmarks.bench gsps`.

    step      a training step (forward, backward, Adam; 16 windows of 25 + 100 frames with pseudo ground truths, 10 x 10
              futures each), over its matrix products
    energies  share of a step for the energies of given futures, forward and backward
    prior     the pose prior's energy, with the reflections of its layers one after the other over all at once
    memory    peak memory of the process in GB, without the GPU's; the public implementation uses 6.7
    futures   50 futures of 16 windows, over their matrix products

Motion is simulated, on the same tree of joints. Times are the shortest of several; the two sides of a ratio alternate.
"""

from __future__ import annotations

import resource
from dataclasses import replace

import torch

import dvae
from dvae import motion
from dvae.distributions.flow import QRFlowModule
from dvae.models.motion.gsps import PRESETS, GSPSModel

from .speed import fed_step, over_products, seconds

TARGETS = {"energies": ("at most", 0.25), "prior": ("at least", 3.0), "memory": ("under", 6.7)}


def sequential(flow: QRFlowModule, x: torch.Tensor) -> torch.Tensor:
    """Apply the flow to x with one reflection after the other."""
    for layer, (upper, bias) in enumerate(zip(flow.factors()[1], flow.bias, strict=True)):
        if layer:
            x = torch.where(x < 0, flow.log_slope[layer - 1].exp() * x, x)
        x = x @ upper.T
        for v in flow.reflections[layer].flip(0):
            x = x - (2 / (v @ v)) * torch.outer(x @ v, v)
        x = x + bias
    return x


def rows(device: torch.device) -> dict[str, float]:
    protocol = replace(motion.PROTOCOLS["simulated"], observed=25, predicted=100)
    windows = motion.windows(motion.simulate(), protocol, "train")
    method = dvae.method("gsps", **PRESETS["human36m"], pose_prior=0.01)
    model = method.build(windows).train()
    assert isinstance(model, GSPSModel)
    method.train(windows).prepare(model)
    model.to(device)
    step, draw = fed_step(method, model, windows, 16, device)
    for _ in range(5):
        step()
    batch = draw()
    with torch.no_grad():
        values = model.model(batch)
    latents = {name: values[name].requires_grad_() for name in ("lower", "upper")}

    def energy_gradients() -> None:
        futures = model.to_data_space(dict(latents))
        sum(energy.sum() for energy in model.energies(futures, batch["x"], batch).values()).backward()

    past = batch["x"][:, :25]
    futures = lambda: model.forecast(past, 100, 50)  # noqa: E731
    ratios = dict(zip(("step", "futures"), over_products(step, futures, repeat=5), strict=True))
    step_time, energy_time = seconds(step, energy_gradients, repeat=5)
    ratios["energies"] = energy_time / step_time

    flow, poses = model.pose_prior.flow, torch.randn(53_000, 48, device=device, requires_grad=True)
    ways = (lambda: sequential(flow, poses), lambda: flow.to_noise(poses)[0])
    both = seconds(*(lambda way=way: way().square().sum().backward() for way in ways), repeat=3)
    ratios["prior"] = both[0] / both[1]
    if device.type == "cpu":
        ratios["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return ratios
