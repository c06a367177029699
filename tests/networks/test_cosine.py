"""The transformers of TrajeVAE equal their published definition, with scipy's cosine transform."""

import math

import numpy as np
import pytest
import torch
from scipy.fft import dct, idct
from scipy.stats import binomtest

from dvae.factorization.relations import Relation
from dvae.networks import CosineDecoder, CosineEncoder
from dvae.networks.base import Input
from dvae.networks.cosine import Dropout

ALL, LENGTH = Relation.parse("1:T"), 7
SMALL = {"width": 6, "feedforward": 10, "heads": 2, "layers": 2}


def encoder(**options):
    spec = CosineEncoder(**{**SMALL, **options})
    return spec.build([Input("y", 9, ALL), Input("s", 9)], True, 4).double().eval()


def decoder(**options):
    inputs = [Input("z", 4, ALL), *options.pop("others", ()), Input("s", 9)]
    return CosineDecoder(hidden=12, **{**SMALL, **options}).build(inputs, True, 9).double().eval()


def values(**sizes):
    shapes = {"y": (3, LENGTH, 9), "z": (3, LENGTH, 4), "s": (3, 9), **sizes}
    return {name: torch.randn(shape, dtype=torch.float64) for name, shape in shapes.items()}


def positions(size):
    """Return sinusoidal positions as defined by Vaswani et al."""
    table = np.zeros((LENGTH, size))
    for t in range(LENGTH):
        for i in range(0, size, 2):
            table[t, i] = math.sin(t / 10000 ** (i / size))
            table[t, i + 1] = math.cos(t / 10000 ** (i / size))
    return torch.from_numpy(table)


@pytest.mark.parametrize("cosine", [True, False])
def test_the_encoder_equals_its_published_definition(cosine):
    net, parents = encoder(cosine=cosine), values()
    body = net.static(parents["s"])[:, None].expand(-1, LENGTH, -1)
    hidden = net.before(torch.cat([net.over_time(parents["y"]), body], -1) + positions(12))
    if cosine:
        hidden = torch.from_numpy(dct(hidden.detach().numpy(), axis=1, norm="ortho"))
    assert torch.allclose(net(parents, LENGTH), net.after(net.between(hidden)), atol=1e-10, rtol=0)


@pytest.mark.parametrize("components", [0, 3])
def test_the_decoder_adds_offsets_to_the_first_pose(components):
    net, parents = decoder(components=components), values()
    z = parents["z"].clone()
    if components:
        z[:, components:] = 0
    in_time = torch.from_numpy(idct(z.numpy(), axis=1, norm="ortho"))
    body = net.static(parents["s"])[:, None].expand(-1, LENGTH, -1)
    offsets = net.offsets(net.transformer(net.into(torch.cat([body, in_time], -1)) + positions(12)))
    pose, expected = parents["s"], []
    for t in range(LENGTH):
        pose = pose + offsets[:, t]
        expected.append(pose)
    assert torch.allclose(net(parents, LENGTH), torch.stack(expected, 1), atol=1e-10, rtol=0)


def test_dropout_drops_its_share_of_units():
    """Units are dropped independently, scaled to keep the mean; gradients have the same units dropped."""
    torch.manual_seed(0)
    for share, count in ((0.1, 200_000), (0.1, 200_003), (0.73, 200_002)):
        x = torch.rand(count) + 1
        x.requires_grad_()
        out = Dropout(share)(x)
        is_dropped = out == 0
        assert binomtest(int(is_dropped.sum()), count, share).pvalue > 0.001
        n_pairs = (is_dropped[:-1] & is_dropped[1:]).sum() + (is_dropped[:-3] & is_dropped[3:]).sum()
        assert int(n_pairs) == pytest.approx(2 * count * share**2, abs=6 * (2 * count * share**2) ** 0.5)
        torch.testing.assert_close(out[~is_dropped], x[~is_dropped] / (1 - share), rtol=1e-4, atol=0)
        (gradient,) = torch.autograd.grad(out.sum(), x)
        assert torch.equal(gradient == 0, is_dropped)
    for share, factor in ((0.0, 1), (1e-12, 1), (1.0, 0)):
        assert torch.equal(Dropout(share)(x), factor * x)
    assert torch.equal(Dropout(0.5).eval()(x), x)
