"""DLow and DSF: their contract, published size, losses, and the decoder of their CVAE."""

import copy
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from scipy.stats import chi2

import dvae
from dvae import motion
from dvae.inference.training.checkpoints import CheckpointError
from dvae.models.baselines.cvae import CVAE
from dvae.runs import directory as runs
from dvae.testing import FactorizationContract

OF_CVAE = {"latent": 4, "width": 8, "hidden": (6, 5)}
SMALL = {**OF_CVAE, "modes": 3, "sampler_width": 8, "sampler_hidden": (7, 6)}
NAMES = ("dlow", "dsf")
PAST, FUTURE = 5, 7


def small(name, **options):
    return dvae.method(name, **{**SMALL, **options})


class Contract(FactorizationContract):
    """The contract, with all parameters trained."""

    name = ""
    waits = 2  # checks whether rows repeat a few histories
    missing: ClassVar = {}

    def build(self, size):
        return small(self.name).build({"x": size}).requires_grad_()


class TestDLow(Contract):
    name = "dlow"
    missing: ClassVar = {"e": ("h", "k", "x_{1:T}")}


class TestDSF(Contract):
    name = "dsf"


@pytest.fixture(scope="module")
def people():
    protocol = replace(motion.PROTOCOLS["simulated"], observed=PAST, predicted=FUTURE, train_stride=3, test_stride=6)
    return motion.MotionData("simulated", motion.simulate(clips=8, frames=40, test=0.3), protocol)


@pytest.fixture(scope="module")
def windows(people):
    return people.windows("train")


@pytest.fixture(scope="module")
def cvae_run(people, tmp_path_factory):
    """Return the folder of a CVAE's run of two steps."""
    out = tmp_path_factory.mktemp("modes") / "cvae"
    training = dvae.Training(steps=2, batch_size=4, progress=False, accelerator="cpu")
    dvae.fit(dvae.method("cvae", **OF_CVAE), people, out=out, **vars(training))
    return str(out)


def built(windows, name, **options):
    torch.manual_seed(0)
    return small(name, **options).resolve_defaults(windows).build(windows).double()


def batch_of(windows, size=4):
    batch = windows.sample(size, torch.Generator().manual_seed(0))
    return {**batch, "x": batch["x"].double()}


def past_of(batch):
    return {"x": batch["x"][:, :PAST]}


def decoder_of(model, windows):
    """Return a CVAE with the decoder of a model."""
    cvae = dvae.method("cvae", **OF_CVAE).build(windows).double()
    cvae.generator["x"].network.load_state_dict(model.generator["x"].network.decoder.state_dict())
    cvae.generator["x"].head.load_state_dict(model.generator["x"].head.state_dict())
    return cvae


def codes(model, batch):
    """Return the output of the sampler for each mode, (B, K, L)."""
    with torch.no_grad():
        return model.sampler(model.read(batch)["h"])


@pytest.mark.parametrize(("modes", "published"), [(10, 2_038_528), (50, 7_291_648)])
def test_the_model_of_human36m_has_the_published_size(modes, published):
    model, decoder = dvae.method("dlow", modes=modes).build({"x": 48}), CVAE().build({"x": 48}).generator["x"]
    trained, frozen = (
        [p.numel() for p in model.parameters() if p.requires_grad is requires_grad] for requires_grad in (True, False)
    )
    assert sum(trained) == published
    assert sum(frozen) == sum(parameter.numel() for parameter in decoder.parameters())


def test_the_loss_of_dlow_equals_the_one_of_the_paper(windows):
    """The CVAE decodes each future from a_k e + b_k. The model rotates windows, which keeps distances."""
    options = {"fixed": ("lower", "Head"), "fixed_weight": 0.5, "join": 3.0, "beta": 0.7, "diversity_scale": 2.0}
    model, batch = built(windows, "dlow", **options), batch_of(windows)
    objective = small("dlow", **options).train(windows).objective
    torch.manual_seed(1)
    terms = dvae.SequenceELBO().terms(model, batch, scheduled_sampling=1.0, draws=objective.draws)
    torch.manual_seed(1)
    noise = model.guide(batch, draws=objective.draws)["e"]
    assert torch.equal(noise, noise[:4].repeat(3, 1))
    a, b = codes(model, batch).chunk(2, -1)
    cvae = decoder_of(model, windows)
    latents = [a[:, k] * noise[:4] + b[:, k] for k in range(3)]
    futures = torch.stack([cvae.forecast(past_of(batch), FUTURE, fix={"w": w})["x"][0] for w in latents])
    truth = batch["x"][:, PAST:]
    best = (futures - truth).square().sum((2, 3)).min(0).values
    prior = torch.distributions.Normal(torch.zeros_like(a), 1)
    divergence = torch.distributions.kl_divergence(torch.distributions.Normal(b, a.abs()), prior).sum(2).mean(1)
    fixed_coordinates = [c for joint in (0, 1, 2, 3, 4, 5, 9) for c in range(3 * joint, 3 * joint + 3)]
    free_coordinates = [c for c in range(48) if c not in fixed_coordinates]
    pairs = [(futures[i] - futures[j])[..., free_coordinates].square().sum((1, 2)) for i, j in ((0, 1), (0, 2), (1, 2))]
    similarity = torch.stack([(-distance / 2).exp() for distance in pairs]).mean(0)
    fixed = torch.stack([(futures[k] - futures[0])[..., fixed_coordinates].square().sum((1, 2)) for k in (1, 2)]).mean(
        0
    )
    steps = (futures[:, :, 0] - batch["x"][:, PAST - 1]).square().sum(2).mean(0)
    expected = 2 * best + 0.7 * divergence + 50 * similarity + 0.5 * fixed + 3 * steps
    assert terms.n_steps.tolist() == [FUTURE] * 4
    assert objective(terms, 0).item() == pytest.approx((expected.sum() / (4 * FUTURE)).item(), rel=1e-9)
    assert not terms.kl["e"].any()


def test_the_loss_of_dsf_equals_the_one_of_the_paper(windows):
    options = {"diversity_scale": 0.01, "quality": 2.0, "radius": 0.2, "beta": 0.3}
    model, batch = built(windows, "dsf", **options), batch_of(windows)
    with torch.no_grad():
        model.sampler.heads.bias.mul_(3)  # some latents are outside of the radius
    objective = small("dsf", **options).train(windows).objective
    terms = dvae.SequenceELBO().terms(model, batch, scheduled_sampling=1.0, draws=objective.draws)
    w, cvae = codes(model, batch), decoder_of(model, windows)
    futures = torch.stack([cvae.forecast(past_of(batch), FUTURE, fix={"w": w[:, k]})["x"][0] for k in range(3)])
    excess = (w.square().sum(2) - chi2.ppf(0.2, 4)).clamp_min(0)
    assert 0 < (excess > 0).sum() < excess.numel()
    quality = 2 * (-excess).exp()
    distances = (futures[:, None] - futures[None]).square().sum((3, 4)).movedim(2, 0)
    spectrum = torch.linalg.eigvalsh(quality[:, :, None] * quality[:, None] * (-distances / 0.01).exp())
    expected = -(spectrum / (1 + spectrum)).sum(1) + 0.3 * w.square().sum(2).mean(1) / 2
    assert objective(terms, 0).item() == pytest.approx((expected.sum() / (4 * FUTURE)).item(), rel=1e-6)


# ------------------------------------------------------------------------------------------- the decoder of the CVAE


@pytest.mark.parametrize("name", NAMES)
def test_a_run_stores_the_decoder_of_its_cvae(people, cvae_run, tmp_path, name):
    cvae_copy = shutil.copytree(cvae_run, tmp_path / "cvae")
    method = dvae.method(name, cvae_run=str(cvae_copy), modes=3, sampler_width=8, sampler_hidden=(7, 6))
    training = dvae.Training(steps=2, batch_size=4, progress=False, accelerator="cpu")
    dvae.fit(method, people, out=tmp_path / "run", **vars(training))
    cvae = runs.load(cvae_copy).model.generator["x"]
    shutil.rmtree(cvae_copy)
    run = runs.load(tmp_path / "run")
    assert {option: getattr(run.method, option) for option in OF_CVAE} == OF_CVAE
    assert run.method.heading
    for module, cvae_module in (
        (run.model.generator["x"].network.decoder, cvae.network),
        (run.model.generator["x"].head, cvae.head),
    ):
        assert all(torch.equal(value, cvae_module.state_dict()[key]) for key, value in module.state_dict().items())
    assert run.model.forecast(past_of(people.windows("test").all()), FUTURE, 3)["x"].isfinite().all()


@pytest.mark.parametrize("name", NAMES)
def test_without_a_run_a_cvae_is_fitted_first(windows, name):
    method = small(name).resolve_defaults(windows)
    decoders = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        model = method.build(windows)
        before = copy.deepcopy(model.generator["x"].network.decoder.state_dict())
        method.train(windows, steps=2).prepare(model)
        decoders.append(model.generator["x"].network.decoder.state_dict())
        assert all(not torch.equal(value, before[key]) for key, value in decoders[-1].items())
    first, repeated, other = decoders
    assert all(torch.equal(value, repeated[key]) for key, value in first.items())
    assert not all(torch.equal(value, other[key]) for key, value in first.items())


def prepare(windows, run, **options):
    method = dvae.method("dlow", cvae_run=str(run), modes=3, **options).resolve_defaults(windows)
    method.train(windows).prepare(method.build(windows))


@pytest.mark.parametrize(
    "change",
    [
        {"method": {"method": "cvae", "latent": 10**9}},
        {"method": [1, 2]},
        {"schema": {"kind": "poses", "skeleton": {"names": ["a"]}, "protocol": {}, "length": None}},
    ],
)
def test_the_run_of_another_method_is_an_error(windows, cvae_run, tmp_path, change):
    run = Path(shutil.copytree(cvae_run, tmp_path / "cvae"))
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**config, **change}))
    with pytest.raises(ValueError, match="not the configuration of a cvae"):
        prepare(windows, run)


def test_weights_of_another_model_are_an_error(windows, cvae_run, tmp_path):
    run = Path(shutil.copytree(cvae_run, tmp_path / "cvae"))
    config = json.loads((run / "config.json").read_text())
    for width, message in ((9, "holds the weights of another model"), (16384, "describes a model that is larger than")):
        (run / "config.json").write_text(json.dumps({**config, "method": {**config["method"], "width": width}}))
        with pytest.raises(CheckpointError, match=message):
            prepare(windows, run)
