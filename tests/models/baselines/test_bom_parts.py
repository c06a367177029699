"""BoM by parts: the loss is the error of the best of ten futures of GSPS's generator."""

import pytest
import torch

import dvae

SMALL = {"latent": 3, "coefficients": 4, "width": 6, "blocks": 1}
FIVE = ("torso", "right_leg", "left_leg", "right_arm", "left_arm")


def built(windows, name="bom-parts", **options):
    torch.manual_seed(0)
    return dvae.method(name, **SMALL, **options).resolve_defaults(windows).build(windows).double().eval()


@pytest.fixture(scope="module")
def batch(windows):
    return {"x": windows.sample(4, torch.Generator().manual_seed(0))["x"].double()}


@pytest.mark.parametrize("parts", [("lower", "upper"), FIVE])
def test_the_loss_is_the_squared_error_of_the_best_of_ten(windows, batch, parts):
    model = built(windows, parts=parts)
    method = dvae.method("bom-parts", **SMALL, parts=parts)
    torch.manual_seed(1)
    terms = dvae.SequenceELBO().terms(model, batch)
    torch.manual_seed(1)
    latents = model.guide(batch)
    draws = [{name: w.unflatten(0, (-1, 4))[i % (len(w) // 4)] for name, w in latents.items()} for i in range(10)]
    futures = torch.cat([model.forecast({"x": batch["x"][:, :15]}, 60, fix=each)["x"] for each in draws])
    errors = (futures - batch["x"][:, 15:]).square().sum((2, 3))
    assert len(errors.unique()) == 40
    assert {*terms.energies} == {"reconstruction"}
    loss = method.train(windows).objective(terms, 0)
    torch.testing.assert_close(loss, errors.min(0).values.sum() / (4 * 75))
