"""The diversity of codes: of what a forecast starts from, zero where noise has no way in, and watched over training."""

import numpy as np
import pytest
import torch

import dvae
from dvae.models.motion.codes import CodeDiversity, codes

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


def test_it_is_written_into_the_log_as_a_model_learns_and_changes_nothing(windows, tmp_path):
    method = dvae.method("mix-and-match", width=8)
    recipe = method.train(windows["train"], windows["test"], steps=6)
    options = {"batch_size": 4, "validate_every": 3, "log_every": 3, "progress": False, "accelerator": "cpu"}

    def fitted(**more):
        torch.manual_seed(0)
        return recipe.fit(method.build(windows["train"]), **options, **more)

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
