"""The transformers of TrajeVAE against their published definition, with scipy's cosine transform."""

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


def encoded(size):
    """Sinusoidal positions as Vaswani et al. define them."""
    found = np.zeros((LENGTH, size))
    for t in range(LENGTH):
        for i in range(0, size, 2):
            found[t, i] = math.sin(t / 10000 ** (i / size))
            found[t, i + 1] = math.cos(t / 10000 ** (i / size))
    return torch.from_numpy(found)


@pytest.mark.parametrize("cosine", [True, False])
def test_the_encoder_is_the_published_one(cosine):
    net, given = encoder(cosine=cosine), values()
    body = net.static(given["s"])[:, None].expand(-1, LENGTH, -1)
    hidden = net.before(torch.cat([net.over_time(given["y"]), body], -1) + encoded(12))
    if cosine:
        hidden = torch.from_numpy(dct(hidden.detach().numpy(), axis=1, norm="ortho"))
    assert torch.allclose(net(given, LENGTH), net.after(net.between(hidden)), atol=1e-10, rtol=0)


@pytest.mark.parametrize("components", [0, 3])
def test_the_decoder_adds_offsets_to_the_first_pose(components):
    net, given = decoder(components=components), values()
    z = given["z"].clone()
    if components:
        z[:, components:] = 0
    in_time = torch.from_numpy(idct(z.numpy(), axis=1, norm="ortho"))
    body = net.static(given["s"])[:, None].expand(-1, LENGTH, -1)
    offsets = net.offsets(net.transformer(net.into(torch.cat([body, in_time], -1)) + encoded(12)))
    pose, expected = given["s"], []
    for t in range(LENGTH):
        pose = pose + offsets[:, t]
        expected.append(pose)
    assert torch.allclose(net(given, LENGTH), torch.stack(expected, 1), atol=1e-10, rtol=0)


def test_dropout_leaves_out_the_share_that_it_says():
    """Each unit apart, whatever their number, scaled to keep the mean; the same ones in the gradient."""
    torch.manual_seed(0)
    for share, count in ((0.1, 200_000), (0.1, 200_003), (0.73, 200_002)):
        x = torch.rand(count) + 1
        x.requires_grad_()
        out = Dropout(share)(x)
        gone = out == 0
        assert binomtest(int(gone.sum()), count, share).pvalue > 0.001
        together = (gone[:-1] & gone[1:]).sum() + (gone[:-3] & gone[3:]).sum()
        assert int(together) == pytest.approx(2 * count * share**2, abs=6 * (2 * count * share**2) ** 0.5)
        torch.testing.assert_close(out[~gone], x[~gone] / (1 - share), rtol=1e-4, atol=0)
        (gradient,) = torch.autograd.grad(out.sum(), x)
        assert torch.equal(gradient == 0, gone)
    for share, kept in ((0.0, 1), (1.0, 0)):
        assert torch.equal(Dropout(share)(x), kept * x)
    assert torch.equal(Dropout(0.5).eval()(x), x)
