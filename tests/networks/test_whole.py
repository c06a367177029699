"""Perceptrons over whole sequences: their contract, shared evaluations and errors."""

import pytest
import torch

import dvae
from dvae.distributions import FixedNormal
from dvae.networks import WholeDecoder, WholeEncoder
from dvae.networks.base import share_modules
from dvae.networks.loop import memoizing
from dvae.testing import FactorizationContract

NAMES = ("a", "b", "c")


def build(size, inference="q(z | a_{1:T}, b_{1:T}, c_{1:T})", length=10):
    sizes = dict.fromkeys(NAMES, size)
    networks = {f"p({name})": WholeDecoder(length, (8,), "tanh", sizes=sizes, name=name) for name in NAMES}
    model = dvae.DynamicalVAE(
        "p(z) p(a_t | z, s) p(b_t | z, s) p(c_t | z, s)",
        inference,
        {**sizes, "z": 3, "s": 2},
        network={**networks, "q(z)": WholeEncoder(length, (8,), "tanh")},
        distributions={f"p({name})": FixedNormal(0.1, project=False) for name in NAMES},
        observed=NAMES,
    )
    share_modules([model.generator[name].network for name in NAMES], "trunk")
    return model


class TestWhole(FactorizationContract):
    def build(self, size):
        return build(size)


def test_a_shared_trunk_is_evaluated_once_for_a_latent():
    model, calls = build(2), []
    model.generator["a"].network.trunk.register_forward_hook(lambda *_: calls.append(1))
    data = {**{name: torch.randn(4, 10, 2) for name in NAMES}, "s": torch.randn(4, 2)}
    with memoizing():
        dvae.SequenceELBO().terms(model, data)
    assert len(calls) == 1
    assert model.generator["b"].network.trunk is model.generator["a"].network.trunk


def test_sequences_longer_than_the_network_are_an_error():
    model = build(2, length=5)
    data = {**{name: torch.randn(4, 6, 2) for name in NAMES}, "s": torch.randn(4, 2)}
    with pytest.raises(ValueError, match="steps"):
        dvae.SequenceELBO().terms(model, data)
