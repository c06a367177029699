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


@pytest.mark.parametrize(("kind", "base"), KINDS)
def test_dropout_is_refused(kind, base):
    with pytest.raises(ValueError, match=r"dropout is 0\.5; a recurrent network here has none"):
        kind(2, 3, 2, dropout=0.5)
