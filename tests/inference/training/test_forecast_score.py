"""Selection by forecasts: the score's definition, best weights, early stopping, resuming, and errors."""

import importlib
import io

import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors.torch import load_file
from stopping import At, interrupt
from walks import HELD_OUT, TRAIN, build, same

import dvae
from dvae.data.sequences import ArrayWindows, Sequences
from dvae.inference.training import forecast_score as module
from dvae.inference.training.checkpoints import CheckpointError, weights
from dvae.inference.training.fit import Callback, Interrupted
from dvae.inference.training.forecast_score import SAMPLES, WINDOWS, forecast_score, scales
from dvae.inference.training.trackers import Terminal
from dvae.program.protocols import Forecasting

svi_module = importlib.import_module(dvae.SVI.__module__)
OBSERVED = 2
WINDOWS_OF_WALKS = ArrayWindows(TRAIN, OBSERVED), ArrayWindows(HELD_OUT, OBSERVED)


class Spread(torch.nn.Module):
    """A forecaster whose draws are the last value plus fixed steps in units of each column."""

    likelihood, generative, inference = False, None, None

    def __init__(self, units):
        super().__init__()
        self.units = torch.nn.Parameter(torch.as_tensor(units))

    def forecast(self, batch, horizon, samples=1, draw_emission=None):
        assert draw_emission
        steps = torch.linspace(-1, 2, samples).double()[:, None, None, None] * self.units
        return {"x": (batch["x"][:, -1:] + steps).expand(samples, -1, horizon, -1)}


def fit(windows=WINDOWS_OF_WALKS, model=None, **options):
    defaults = {"steps": 60, "batch_size": 8, "validate_every": 5, "progress": False, "learning_rate": 0.02}
    return dvae.fit(model or build(), *windows, select="forecast", **(defaults | options))


@pytest.mark.parametrize("count", [5, WINDOWS, 2 * WINDOWS + 7])
def test_the_score_is_the_mean_crps_of_evenly_spaced_windows_in_mean_absolute_changes(count):
    random, units = np.random.default_rng(0), np.array([1.0, 50.0])
    x = random.normal(size=(count, 6, 2)).cumsum(1) * units
    mask = random.random(x.shape) < 0.8
    mask[:, [3, 5]] = True
    score = forecast_score(Spread(units), ArrayWindows(x, 4, mask=mask), batch_size=7, seed=0)
    every = -(-count // WINDOWS)
    x, mask = x[::every], mask[::every]
    changes = np.abs(np.diff(np.where(mask, x, np.nan)[:, :4], axis=1))
    scale, total = np.nanmean(changes, (0, 1)), 0.0
    for values, is_observed in zip(x, mask, strict=True):
        errors = []
        for t, d in zip(*np.nonzero(is_observed[4:]), strict=True):
            draws = values[3, d] + np.linspace(-1, 2, SAMPLES) * units[d]
            spread = np.abs(draws[:, None] - draws).sum() / (SAMPLES * (SAMPLES - 1))
            errors.append((np.abs(draws - values[4 + t, d]).mean() - spread / 2) / scale[d])
        total += np.mean(errors) / len(x)
    assert score == pytest.approx(total)


def test_columns_without_changes_have_the_scale_of_their_deviations_or_1():
    past = torch.tensor([[[0.0, 2.0, torch.nan], [1.0, 2.0, 5.0]], [[0.0, 4.0, torch.nan], [3.0, 4.0, 5.0]]]).double()
    assert scales(past).tolist() == [2.0, 1.0, 1.0]


def test_the_score_does_not_depend_on_the_unit_of_a_column_or_the_callers_random_state():
    x, unit = torch.randn(9, 6, 2).double(), torch.tensor([1.0, 1000.0]).double()
    first, second = (forecast_score(Spread(u), ArrayWindows(x * u, 3), 4, 0) for u in (torch.ones(2).double(), unit))
    assert first == pytest.approx(second)
    model, before = build(), torch.get_rng_state()
    assert len({forecast_score(model, WINDOWS_OF_WALKS[1], size, 3) for size in (7, 7)}) == 1
    assert torch.equal(torch.get_rng_state(), before)


def test_the_best_forecasts_select_the_weights_and_patience_waits_for_them(monkeypatch):
    values, stored = iter([3.0, 1.0, float("inf"), 2.0, 0.0]), {}

    class Keep(Callback):
        def on_validation(self, state):
            stored[state.step] = weights(state.model)

    monkeypatch.setattr(svi_module, "forecast_score", lambda *_: next(values))
    model = build()
    result = fit(model=model, patience=2, callbacks=[Keep()], scheduled_sampling=dvae.schedules.Ramp(0.0, 1.0, 60))
    assert (result.status, result.step, result.best_step, result.best_bound) == ("stopped early", 20, 10, -1.0)
    assert result.series("validation/CRPS") == ([5, 10, 15, 20], [3.0, 1.0, float("inf"), 2.0])
    assert result.best == "lowest validation CRPS 1.0000 at step 10"
    assert same(weights(model), stored[10])
    assert not same(stored[20], stored[10])


def test_forecasts_that_diverge_have_an_infinite_score(monkeypatch):
    overflow = Spread([float("inf")] * 3)
    assert forecast_score(overflow, WINDOWS_OF_WALKS[1], 4, 0) == float("inf")
    nan = torch.tensor(torch.nan)
    for draw in (
        lambda *_: torch.distributions.Normal(nan, 1.0).sample(),
        lambda *_: torch.distributions.Poisson(nan, validate_args=False).sample(),  # a RuntimeError
    ):
        monkeypatch.setattr(svi_module, "forecast_score", draw)
        result = fit(steps=5)
        assert result.series("validation/CRPS")[1] == [float("inf")]
        assert result.best_step is None
    monkeypatch.setattr(svi_module, "forecast_score", lambda *_: torch.zeros(2) @ torch.zeros(3))
    with pytest.raises(RuntimeError, match="size"):
        fit(steps=5)


def test_a_resumed_run_continues_the_selection_bit_for_bit_and_refuses_another(tmp_path):
    whole = fit(out=tmp_path / "whole")
    with pytest.raises(Interrupted):
        fit(out=tmp_path / "parts", callbacks=[At(33, interrupt)])
    with pytest.raises(CheckpointError, match=r"select='forecast', not 'bound'; resume with the same"):
        dvae.fit(build(), *WINDOWS_OF_WALKS, out=tmp_path / "parts", resume=True, progress=False)
    resumed = fit(model=build(seed=9), out=tmp_path / "parts", resume=True)
    assert resumed.history == whole.history
    assert (resumed.best_step, resumed.best_bound) == (whole.best_step, whole.best_bound)
    for name in ("last.safetensors", "best.safetensors"):
        assert same(load_file(tmp_path / "whole" / name), load_file(tmp_path / "parts" / name))


def test_selection_does_not_change_the_steps():
    by_bound = dvae.fit(build(), *WINDOWS_OF_WALKS, steps=20, batch_size=8, validate_every=5, progress=False, seed=1)
    by_forecast = fit(steps=20, seed=1, learning_rate=1e-3)
    assert by_bound.series("loss") == by_forecast.series("loss")
    assert by_bound.series("validation/bound") == by_forecast.series("validation/bound")


def test_data_without_a_horizon_and_models_that_do_not_forecast_are_errors():
    for windows in ((TRAIN, HELD_OUT), (TRAIN, Sequences({"x": HELD_OUT})), (WINDOWS_OF_WALKS[0],)):
        with pytest.raises(ValueError, match=r'select is "forecast", but got validation data without a horizon'):
            fit(windows)
    other = torch.nn.Linear(1, 1)
    assert not isinstance(other, Forecasting)
    with pytest.raises(ValueError, match=r"Linear, no forecaster; give a model that forecasts"):
        module.observed_steps(other, WINDOWS_OF_WALKS[1])
    with pytest.raises(ValueError, match="select"):
        dvae.Training(select="energy")


def test_progress_names_the_score_that_selects():
    screen = io.StringIO()
    terminal = Terminal(10, Console(file=screen, width=200, no_color=True))
    terminal.start(0)
    terminal.log(10, {"bound": 1.0, "validation/bound": 2.0, "validation/CRPS": 0.25})
    terminal.close()
    assert screen.getvalue() == "step 10/10  bound 1.000  validation bound 2.000  validation CRPS (selects) 0.250\n"


def test_windows_without_an_observed_future_do_not_count():
    mask = torch.ones_like(HELD_OUT, dtype=torch.bool)
    mask[0, OBSERVED:] = False
    some, others = ArrayWindows(HELD_OUT, OBSERVED, mask=mask), ArrayWindows(HELD_OUT[1:], OBSERVED)
    model = build()
    scores = [forecast_score(model, windows, 8, 0) for windows in (some, others)]
    assert all(np.isfinite(scores))
    mask[:, OBSERVED:] = False
    with pytest.raises(ValueError, match="no validation window has an observed future; select by the bound"):
        forecast_score(model, ArrayWindows(HELD_OUT, OBSERVED, mask=mask), 8, 0)
