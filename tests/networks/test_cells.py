"""Recurrent networks that know their gradient in evaluation, on a GPU too."""

import pytest
import torch

from dvae.networks import cells


@pytest.mark.parametrize("kind", [cells.GRU, cells.LSTM, cells.RNN])
def test_what_a_gradient_needs_is_kept_in_evaluation_too(kind, monkeypatch):
    kept = []
    monkeypatch.setattr(kind.__bases__[1], "forward", lambda layer, *_: kept.append(layer.training))
    layer = kind(2, 3).eval()
    layer(torch.zeros(1, 4, 2))
    with torch.no_grad():
        layer.train()(torch.zeros(1, 4, 2))
    assert kept == [True, False]
    assert layer.training
