"""The program with missing entries, custom masks, threads, other engines and arrays."""

import os
import subprocess
import sys
import threading
import time
from typing import Any

import numpy as np
import pyro
import pytest
import torch
from pyro.infer import SVI, Trace_ELBO

import dvae
from dvae import DynamicalVAE, SequenceELBO
from dvae.inference.training.fit import Callback
from dvae.locking import serialized
from dvae.models.method import LatentMethod
from dvae.networks import Attention, Recurrent
from dvae.program import conditional
from dvae.program.particles import Particles
from dvae.testing import FactorizationContract

SRNN = ("p(z_t | x_{<t}, z_{t-1}) p(x_t | x_{<t}, z_t)", "q(z_t | z_{t-1}, x_{1:T})")


def srnn(**options) -> DynamicalVAE:
    return DynamicalVAE(*SRNN, sizes={"z": 2, "x": 3}, network=Recurrent(8, hidden=(8,)), **options).double()


# ------------------------------------------------------------------------------------------------- missing entries


def with_gap(x: torch.Tensor, *steps: int) -> dict[str, torch.Tensor]:
    mask = torch.ones_like(x, dtype=torch.bool)
    mask[:, list(steps)] = False
    return {"x": x.masked_fill(~mask, torch.nan), "mask": mask}


def test_the_model_reads_its_own_mean_instead_of_a_missing_entry():
    model = srnn()
    x, z = torch.randn(4, 6, 3).double(), torch.randn(4, 6, 2).double()
    batch = with_gap(x, 2)
    with torch.no_grad():
        conditional = model.generator["x"]
        mean = conditional({"x": x, "z": z}, 4, 6)[0][:, 2]
        completed = x.clone()
        completed[:, 2] = mean
        loc, scale = conditional({"x": completed, "z": z}, 4, 6)
        log_prob = torch.distributions.Normal(loc, scale).log_prob(x)
        expected = log_prob.sum((1, 2)) - log_prob[:, 2].sum(-1)
    torch.testing.assert_close(model.log_joint(batch, {"z": z})["x"], expected)


# ------------------------------------------------------------------------------------------------------ custom masks


def test_a_custom_mask_that_reads_the_future_at_a_length_is_an_error_there():
    def leak(length: int) -> np.ndarray:
        mask = np.tri(length, k=-1, dtype=bool)
        if length == 12:
            mask[0, 8] = True
        return mask

    model = DynamicalVAE(
        "p(z_t) p(x_t | z_t, x_{leak})", "q(z_t | x_t)", {"z": 1, "x": 1}, network=Attention(8, 2), masks={"leak": leak}
    )
    SequenceELBO().terms(model, torch.randn(2, 8, 1))
    with pytest.raises(ValueError, match="reads"):
        SequenceELBO().terms(model, torch.randn(2, 12, 1))
    with pytest.raises(ValueError, match="direction"):
        model.sample(2, length=12)


def first(length: int) -> np.ndarray:
    """Return a mask with the same row for every t."""
    return np.arange(length)[None] < 1


class TestRowMaskOfAttention(FactorizationContract):
    """x_t reads z_1 at every t, and z_t reads x_{t-1}: a loop with a mask of one row."""

    def build(self, size: int) -> DynamicalVAE:
        equations = "p(z_t | x_{t-1}) p(x_t | x_{t-1}, z_{first})", "q(z_t | z_{<t}, x_{1:T})"
        return DynamicalVAE(*equations, {"z": size, "x": size}, Attention(8, 2), masks={"first": first})

    def test_particles_move_through_the_loop(self) -> None:
        """Their weights equal the densities of the programs."""
        model = self._model()
        data = self._data(model)
        particles = Particles(model, model.rollout(data), 1)
        with torch.no_grad():
            bound = particles.run(0.0)[0]
        latents = particles.drawn
        guide = pyro.poutine.trace(pyro.poutine.condition(model.guide, data=latents)).get_trace(data)
        guide.compute_log_prob()
        expected = sum(model.log_joint(data, latents).values()) - guide.nodes["z"]["log_prob"]
        torch.testing.assert_close(bound, expected, rtol=0, atol=1e-8)


# ------------------------------------------------------------------------------------------------------------ threads


class _PauseUntilForecast(Callback):
    """Pause a fit between two steps until another thread has forecast."""

    def __init__(self) -> None:
        self.began, self.forecast = threading.Event(), threading.Event()

    def on_step(self, state: Any) -> None:
        self.began.set()
        assert self.forecast.wait(60), "the fit has kept the lock between its steps"


def test_a_forecast_during_a_fit_does_not_change_the_fit():
    x = torch.randn(8, 6, 3).double()
    torch.manual_seed(0)
    undisturbed, concurrent, other = srnn(), srnn(), srnn()
    concurrent.load_state_dict(undisturbed.state_dict())
    dvae.fit(undisturbed, x, steps=2, batch_size=4, progress=False)
    waiting, quiet = _PauseUntilForecast(), {"steps": 2, "batch_size": 4, "progress": False}
    fit = threading.Thread(target=lambda: dvae.fit(concurrent, x, callbacks=[waiting], **quiet))
    fit.start()
    assert waiting.began.wait(60)
    assert other.forecast(x[:, :4], 2, 3)["x"].shape == (3, 8, 2, 3)
    waiting.forecast.set()
    fit.join()
    for name, value in undisturbed.state_dict().items():
        torch.testing.assert_close(concurrent.state_dict()[name], value, rtol=0, atol=0)


def test_bounds_and_the_construction_of_models_wait_for_the_lock():
    model, x = srnn(), torch.randn(4, 6, 3).double()
    results: list[float] = []

    def work() -> None:
        results.append(SequenceELBO().loss_and_grads(model, model.guide, x))
        srnn()
        results.append(0.0)

    threads = [threading.Thread(target=work) for _ in range(4)]
    with serialized:
        for thread in threads:
            thread.start()
        time.sleep(0.2)
        assert not results
    for thread in threads:
        thread.join()
    assert len(results) == 8


FORK = """
import os, signal, sys, threading, time
import dvae, pyro, torch
from dvae.locking import serialized

def fit(steps):
    sizes, network = {"z": 1, "x": 1}, dvae.networks.Recurrent(4)
    model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", sizes, network)
    dvae.fit(model, torch.randn(8, 5, 1), steps=steps, progress=False)

def hold():
    with serialized, pyro.plate("sequences", 8):
        began.set()
        ended.wait()

began, ended = threading.Event(), threading.Event()
if sys.argv[1] == "imports":
    thread = threading.Thread(target=fit, args=(10,))
    thread.start()
    while "lightning_fabric" not in sys.modules:  # whose import takes a second
        time.sleep(0.01)
else:
    fit(1)
    thread = threading.Thread(target=hold)
    thread.start()
    began.wait()
child = os.fork()
if not child:
    signal.alarm(60)  # ends it if it waits for a lock
    fit(1)
    os._exit(0)
ended.set()
thread.join()
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system does not fork")
@pytest.mark.parametrize("moment", ["imports", "a program"])
def test_a_process_forked_during_a_fit_of_another_thread_can_fit(moment):
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORK, moment], check=True, timeout=120)


# ---------------------------------------------------------------------------------------------------------- engines


def test_pyros_svi_trains_all_parameters_of_separate_models():
    models = [srnn(), srnn()]
    x = torch.randn(4, 6, 3).double()
    before = [[p.detach().clone() for p in model.parameters()] for model in models]
    for model in models:
        svi = SVI(model.model, model.guide, pyro.optim.Adam({"lr": 1e-2}), Trace_ELBO())
        for _ in range(2):
            svi.step(x)
    for model, old in zip(models, before, strict=True):
        assert all((a != b).any() for a, b in zip(old, model.parameters(), strict=True))
    assert not torch.equal(next(models[0].parameters()), next(models[1].parameters()))


@pytest.mark.parametrize(
    "name", [n for n, m in dvae.methods().items() if issubclass(m, LatentMethod) and n != "equations"]
)
def test_mixed_precision_trains(name):
    model = dvae.method(name).build({"x": 3})
    with torch.autocast("cpu", torch.bfloat16):
        bound = SequenceELBO().terms(model, torch.randn(4, 6, 3), scheduled_sampling=0.5).bound.mean()
    bound.backward()
    assert torch.isfinite(bound)
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)


@pytest.mark.parametrize("name", ["srnn", "dkf", "vrnn", "rvae-causal"])
def test_chains_run_in_float32_under_mixed_precision(name, monkeypatch):
    model, x = dvae.method(name).build({"x": 3}), torch.randn(4, 6, 3)
    calls, chain = [], conditional.gaussian_chain

    def recorded(base, noise, *arguments, **options):
        results = chain(base, noise, *arguments, **options)
        calls.append([base, noise, *results[:3]])
        return results

    monkeypatch.setattr(conditional, "gaussian_chain", recorded)
    bounds = []
    for mixed in (False, True):
        torch.manual_seed(0)
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            bounds.append(SequenceELBO().terms(model, x).bound)
    assert torch.equal(calls[0][1], calls[1][1])  # the same noise
    assert {tensor.dtype for tensor in calls[1]} == {torch.float32}
    torch.testing.assert_close(*bounds, rtol=2**-6, atol=0)  # bfloat16 has 8 bits


# ------------------------------------------------------------------------------------------------------------ inputs


def test_arrays_are_converted_to_the_precision_of_the_model():
    model = srnn()
    x = np.random.default_rng(0).normal(size=(2, 4, 3))
    assert model.forecast(x, 2)["x"].dtype == torch.float64
    assert model.float().forecast({"x": x}, 2)["x"].dtype == torch.float32
    frames = SequenceELBO().terms(model, {"x": x, "lengths": [4, 2]}).n_steps
    assert frames.tolist() == [4, 2]
