"""BoM by parts: the best of ten futures of GSPS's generator is all that counts, and control is GSPS's."""

import pytest
import torch

import dvae

SMALL = {"latent": 3, "coefficients": 4, "width": 6, "blocks": 1}
FIVE = ("torso", "right_leg", "left_leg", "right_arm", "left_arm")


def built(windows, name="bom-parts", **options):
    torch.manual_seed(0)
    return dvae.method(name, **SMALL, **options).suited(windows).build(windows).double().eval()


@pytest.fixture(scope="module")
def batch(windows):
    return {"x": windows.sample(4, torch.Generator().manual_seed(0))["x"].double()}


@pytest.mark.parametrize("parts", [("lower", "upper"), FIVE])
def test_what_is_minimised_is_the_squared_error_of_the_best_of_ten(windows, batch, parts):
    model = built(windows, parts=parts)
    method = dvae.method("bom-parts", **SMALL, parts=parts)
    torch.manual_seed(1)
    terms = dvae.SequenceELBO().terms(model, batch)
    torch.manual_seed(1)
    latents = model.guide(batch)
    draws = [{name: w.unflatten(0, (-1, 4))[i % (len(w) // 4)] for name, w in latents.items()} for i in range(10)]
    made = torch.cat([model.forecast({"x": batch["x"][:, :15]}, 60, fix=each)["x"] for each in draws])
    errors = (made - batch["x"][:, 15:]).square().sum((2, 3))
    assert len(errors.unique()) == 40
    assert {*terms.energies} == {"reconstruction"}
    loss = method.train(windows).objective(terms, 0)
    torch.testing.assert_close(loss, errors.min(0).values.sum() / (4 * 75))


def test_control_is_that_of_gsps_bit_for_bit(windows, batch):
    ours, theirs = built(windows), built(windows, "gsps", angles=0.0, pose_prior=0.0)
    theirs.load_state_dict(ours.state_dict())
    past, results = batch["x"][:, :15], []
    for model in (ours, theirs):
        torch.manual_seed(2)
        free = model.forecast(past, 60, 3)
        held = model.forecast(past, 60, 3, fix={"lower": free["lower"][1]})
        latent = model.forecast(past, 60, 3, fix={"a": free["a"][1]})
        results.append([*free.values(), *held.values(), *latent.values()])
        assert torch.equal(held["lower"], free["lower"][1].expand(3, -1, -1, -1))
        assert (held["upper"].var(0) > 0).all()
    assert all(torch.equal(here, there) for here, there in zip(*results, strict=True))


def test_the_factorization_is_that_of_gsps():
    assert dvae.method("bom-parts").equations()[0].text == dvae.method("gsps").equations()[0].text
    assert dvae.method("bom-parts").equations()[1].text == dvae.method("gsps").equations()[1].text


def test_other_energies_may_be_weighed_too(windows, batch):
    found = dvae.SequenceELBO().terms(built(windows, history=1.0, limb=1.0), batch).energies
    assert {*found} == {"reconstruction", "history", "limb"}
