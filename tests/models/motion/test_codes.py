"""The diversity of codes: of what a forecast starts from, zero where noise has no way in, and watched over training."""

import numpy as np
import pytest
import torch

import dvae
from dvae.models.motion.codes import CodeDiversity, code_diversity, codes

WAYS = ("mix", "concatenate", "add", "step")


@pytest.fixture
def windows(quaternions):
    return quaternions


def made(windows, **options):
    torch.manual_seed(0)
    return dvae.method("mix-and-match", **{"width": 24, **options}).build(windows["train"]).eval()


def past(windows, rows=4):
    return {"x": windows["test"].all()["x"][:rows, :5]}


@pytest.mark.parametrize("noise", WAYS)
def test_codes_are_those_that_futures_are_made_of(windows, noise):
    """A first pose is linear in the code of a latent for each step; elsewhere the decoder goes on from the code."""
    model = made(windows, noise=noise)
    torch.manual_seed(1)
    found = codes(model, past(windows), 3)
    torch.manual_seed(1)
    forecast = model.forecast(past(windows), 1, 3)
    assert found.shape == (3, 4, 24)
    network, data = model.generator["x"].network, model.read(past(windows))
    last = data["h"][:, -model.sizes["x"] :]
    for code, x in zip(found, forecast["x"], strict=True):
        state = code if noise == "step" else network.cell(last[:, None], code[None].contiguous())[0][:, 0]
        shown = model.shown({"x": network.out(state)[:, None]}, data)["x"]
        torch.testing.assert_close(shown, x, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("noise", WAYS)
def test_the_diversity_is_the_mean_distance_of_pairs(windows, noise):
    model = made(windows, noise=noise)
    torch.manual_seed(1)
    found = codes(model, past(windows), 4)
    torch.manual_seed(1)
    pairs = [(found[i] - found[j]).norm(dim=-1) for i in range(4) for j in range(i)]
    torch.testing.assert_close(code_diversity(model, past(windows), 4), torch.stack(pairs).mean(0))
    assert all(distance.min() > 0 for distance in pairs)


def test_noise_that_nothing_reads_has_no_diversity(windows):
    deaf = made(windows, noise="add")
    torch.nn.init.zeros_(deaf.generator["x"].network.noise.layer.weight)
    for model in (deaf, made(windows, alpha=0.0)):
        torch.testing.assert_close(code_diversity(model, past(windows), 4), torch.zeros(4))


def test_drawn_indices_alone_make_codes_differ_and_are_told_from_z(windows):
    model = made(windows, latent=5)
    assert code_diversity(model, model.read(past(windows)), 4).min() > 0
    layer = model.generator["x"].network.noise.layer  # through which z goes
    torch.nn.init.zeros_(layer.weight)
    assert code_diversity(model, past(windows), 4).min() > 0
    torch.testing.assert_close(code_diversity(model, model.read(past(windows)), 4), torch.zeros(4))


def test_what_cannot_be_told_is_refused(windows):
    with pytest.raises(ValueError, match="samples is 1; codes differ where there are two"):
        code_diversity(made(windows), past(windows), 1)
    for options in ({"every": 0}, {"samples": 1}, {"batch": past(windows, 1)}):
        with pytest.raises(ValueError, match="give at least two pasts, two samples and one step"):
            CodeDiversity(**{"batch": past(windows), **options})


def test_it_is_written_into_the_log_as_a_model_learns_and_changes_nothing(windows, tmp_path):
    method = dvae.method("mix-and-match", width=8)
    recipe = method.train(windows["train"], windows["test"], steps=6)
    options = {"batch_size": 4, "validate_every": 3, "log_every": 3, "progress": False, "accelerator": "cpu"}

    def fitted(**more):
        torch.manual_seed(0)
        return dvae.fit(method.build(windows["train"]), recipe, **options, **more)

    watch = CodeDiversity(past(windows), every=2, samples=5)
    plain, watched = fitted(), fitted(out=tmp_path / "run", callbacks=[watch])
    steps, means = watched.series("codes/diversity")
    assert steps == [2, 4, 6]
    assert min(watched.series("codes/latent")[1]) > 0
    assert [row for row in watched.history if "codes/diversity" not in row] == plain.history
    log = (tmp_path / "run" / "log.jsonl").read_text()
    assert log.count("codes/deviation") == 3
    assert np.isfinite(means).all()
    assert min(means) > 0


def test_a_model_without_such_a_decoder_has_no_codes(windows):
    model = dvae.method("vae", latent=2).build({"x": 48})
    with pytest.raises(TypeError, match="codes are of a decoder with an entrance"):
        codes(model, past(windows))
