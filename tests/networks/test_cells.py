"""Recurrent networks have gradients in evaluation mode, also on a GPU."""

import copy

import pytest
import torch
from torch import nn

from dvae.networks import cells

KINDS = [(cells.GRU, nn.GRU), (cells.LSTM, nn.LSTM), (cells.RNN, nn.RNN)]


@pytest.mark.parametrize(("kind", "base"), KINDS)
def test_layers_run_in_training_mode_if_gradients_are_needed(kind, base, monkeypatch):
    is_training = []
    monkeypatch.setattr(base, "forward", lambda layer, *_: is_training.append(layer.training))
    layer = kind(2, 3).eval()
    layer(torch.zeros(1, 4, 2))
    assert not layer.training
    with torch.no_grad():
        layer.train()(torch.zeros(1, 4, 2))
    assert layer.training
    assert is_training == [True, False]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU is available")
@pytest.mark.parametrize(("kind", "base"), KINDS)
def test_gradients_in_evaluation_on_a_gpu_equal_the_cpu(kind, base):
    layer, x = kind(2, 3).double().eval(), torch.randn(4, 5, 2, dtype=torch.float64)
    on_gpu = copy.deepcopy(layer).to("cuda")
    gradients, expected = (
        torch.autograd.grad(each(x.to(each.weight_hh_l0.device))[0].square().sum(), list(each.parameters()))
        for each in (on_gpu, layer)
    )
    torch.testing.assert_close([value.cpu() for value in gradients], list(expected))


def test_an_lstm_under_autocast_uses_float32_if_the_processor_requires_it(monkeypatch):
    precision, layer, x = torch.bfloat16, cells.LSTM(2, 3, batch_first=True), torch.randn(4, 5, 2)
    states = tuple(torch.randn(1, 4, 3).to(precision) for _ in range(2))
    monkeypatch.setattr(cells, "_runs_lstm", lambda precision, training: False)
    for initial in (None, states):
        with torch.autocast("cpu", precision):
            output = layer(x.to(precision), initial)[0]
        expected = layer(x.to(precision).float(), initial and tuple(each.float() for each in initial))[0]
        assert torch.equal(output, expected)
        output.sum().backward()
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
def test_dropout_is_an_error(kind, base):
    with pytest.raises(ValueError, match="dropout must be 0"):
        kind(2, 3, 2, dropout=0.5)
