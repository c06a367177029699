"""Recurrent networks that know their gradient in evaluation, on a GPU too."""

import copy

import pytest
import torch
from torch import nn

from dvae.networks import cells

KINDS = [(cells.GRU, nn.GRU), (cells.LSTM, nn.LSTM), (cells.RNN, nn.RNN)]


@pytest.mark.parametrize(("kind", "base"), KINDS)
def test_what_a_gradient_needs_is_kept_in_evaluation_too(kind, base, monkeypatch):
    kept = []
    monkeypatch.setattr(base, "forward", lambda layer, *_: kept.append(layer.training))
    layer = kind(2, 3).eval()
    layer(torch.zeros(1, 4, 2))
    assert not layer.training
    with torch.no_grad():
        layer.train()(torch.zeros(1, 4, 2))
    assert layer.training
    assert kept == [True, False]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU is here")
@pytest.mark.parametrize(("kind", "base"), KINDS)
def test_a_gradient_in_evaluation_is_the_processors(kind, base):
    layer, x = kind(2, 3).double().eval(), torch.randn(4, 5, 2, dtype=torch.float64)
    there = copy.deepcopy(layer).to("cuda")
    found, expected = (
        torch.autograd.grad(each(x.to(each.weight_hh_l0.device))[0].square().sum(), list(each.parameters()))
        for each in (there, layer)
    )
    torch.testing.assert_close([value.cpu() for value in found], list(expected))


def test_an_lstm_under_autocast_computes_in_float32_where_the_processor_needs_it(monkeypatch):
    precision, layer, x = torch.bfloat16, cells.LSTM(2, 3, batch_first=True), torch.randn(4, 5, 2)
    states = tuple(torch.randn(1, 4, 3).to(precision) for _ in range(2))
    monkeypatch.setattr(cells, "_runs_lstm", lambda precision, training: False)
    for given in (None, states):
        with torch.autocast("cpu", precision):
            found = layer(x.to(precision), given)[0]
        expected = layer(x.to(precision).float(), given and tuple(each.float() for each in given))[0]
        assert torch.equal(found, expected)
        found.sum().backward()
    assert layer.weight_hh_l0.grad.isfinite().all()


@pytest.mark.parametrize("grad", [True, False])
def test_recurrent_networks_run_under_autocast_on_any_processor(grad):
    precision, before = torch.bfloat16, torch.get_rng_state()
    cells._runs_lstm.cache_clear()
    cells._runs_lstm(precision, grad)
    assert torch.equal(before, torch.get_rng_state())
    for kind, _ in KINDS:
        with torch.autocast("cpu", precision), torch.set_grad_enabled(grad):
            assert kind(2, 3)(torch.randn(4, 1, 2))[0].isfinite().all()


@pytest.mark.parametrize(("kind", "base"), KINDS)
def test_dropout_is_refused(kind, base):
    with pytest.raises(ValueError, match="dropout must be 0"):
        kind(2, 3, 2, dropout=0.5)
