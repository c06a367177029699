"""DLow and DSF: their contract, their published size, what they minimise, and whose decoder they have."""

import copy
import json
import math
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
from dvae.models.motion.modes import GROUP
from dvae.runs import directory as runs
from dvae.testing import FactorizationContract

OF_CVAE = {"latent": 4, "width": 8, "hidden": (6, 5)}
SMALL = {**OF_CVAE, "modes": 3, "sampler_width": 8, "sampler_hidden": (7, 6)}
NAMES = ("dlow", "dsf")
PAST, FUTURE = 5, 7


def small(name, **options):
    return dvae.method(name, **{**SMALL, **options})


class Contract(FactorizationContract):
    """That of the factorization, of which all is trained."""

    name = ""
    waits = 2  # for whether the rows are some histories over and over
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
    """A run of a CVAE, of two steps."""
    out = tmp_path_factory.mktemp("modes") / "cvae"
    training = dvae.Training(steps=2, batch_size=4, progress=False, accelerator="cpu")
    runs.fit_run(dvae.method("cvae", **OF_CVAE), people, out, training)
    return str(out)


def built(windows, name, **options):
    torch.manual_seed(0)
    return small(name, **options).suited(windows).build(windows).double()


def batch_of(windows, size=4):
    batch = windows.sample(size, torch.Generator().manual_seed(0))
    return {**batch, "x": batch["x"].double()}


def past_of(batch):
    return {"x": batch["x"][:, :PAST]}


def decoder_of(model, windows):
    """A CVAE with the decoder of a model."""
    cvae = dvae.method("cvae", **OF_CVAE).build(windows).double()
    cvae.generator["x"].network.load_state_dict(model.generator["x"].network.decoder.state_dict())
    cvae.generator["x"].law.load_state_dict(model.generator["x"].law.state_dict())
    return cvae


def codes(model, batch):
    """What the network says of each mode, (B, K, L)."""
    with torch.no_grad():
        return model.sampler(model.read(batch)["h"])


@pytest.mark.parametrize(("modes", "published"), [(10, 2_038_528), (50, 7_291_648)])
def test_the_model_of_human36m_has_the_published_size(modes, published):
    model, decoder = dvae.method("dlow", modes=modes).build({"x": 48}), CVAE().build({"x": 48}).generator["x"]
    trained, still = ([p.numel() for p in model.parameters() if p.requires_grad is told] for told in (True, False))
    assert sum(trained) == published
    assert sum(still) == sum(parameter.numel() for parameter in decoder.parameters())


def test_the_papers_have_fifty_modes_and_others_ten(windows):
    assert {name: method["modes"] for name, method in dvae.methods()["dlow"].presets.items()} == {
        **{"human36m": 50, "humaneva": 50},
        "": 10,
    }
    assert dvae.method("dsf").suited(windows).modes == 10


def test_the_loss_of_dlow_is_the_papers(windows):
    """Each future is what the CVAE makes of a_k e + b_k; windows are turned where models see them, as distances are."""
    options = {"held": ("lower", "Head"), "hold": 0.5, "join": 3.0, "beta": 0.7, "diversity_scale": 2.0}
    model, batch = built(windows, "dlow", **options), batch_of(windows)
    objective = small("dlow", **options).train(windows).objective
    torch.manual_seed(1)
    terms = dvae.SequenceELBO().terms(model, batch, self_feeding=1.0, draws=objective.draws)
    torch.manual_seed(1)
    noise = model.guide(batch, draws=objective.draws)["e"]
    assert torch.equal(noise, noise[:4].repeat(3, 1))
    a, b = codes(model, batch).chunk(2, -1)
    cvae = decoder_of(model, windows)
    latents = [a[:, k] * noise[:4] + b[:, k] for k in range(3)]
    made = torch.stack([cvae.forecast(past_of(batch), FUTURE, fix={"w": w})["x"][0] for w in latents])
    truth = batch["x"][:, PAST:]
    best = (made - truth).square().sum((2, 3)).min(0).values
    prior = torch.distributions.Normal(torch.zeros_like(a), 1)
    divergence = torch.distributions.kl_divergence(torch.distributions.Normal(b, a.abs()), prior).sum(2).mean(1)
    held = [c for joint in (0, 1, 2, 3, 4, 5, 9) for c in range(3 * joint, 3 * joint + 3)]
    free = [c for c in range(48) if c not in held]
    pairs = [(made[i] - made[j])[..., free].square().sum((1, 2)) for i, j in ((0, 1), (0, 2), (1, 2))]
    alike = torch.stack([(-apart / 2).exp() for apart in pairs]).mean(0)
    fixed = torch.stack([(made[k] - made[0])[..., held].square().sum((1, 2)) for k in (1, 2)]).mean(0)
    steps = (made[:, :, 0] - batch["x"][:, PAST - 1]).square().sum(2).mean(0)
    expected = 2 * best + 0.7 * divergence + 50 * alike + 0.5 * fixed + 3 * steps
    assert terms.frames.tolist() == [FUTURE] * 4
    assert objective(terms, 0).item() == pytest.approx((expected.sum() / (4 * FUTURE)).item(), rel=1e-9)
    assert not terms.kl["e"].any()


def test_the_loss_of_dsf_is_the_papers(windows):
    options = {"diversity_scale": 0.01, "quality": 2.0, "radius": 0.2, "beta": 0.3}
    model, batch = built(windows, "dsf", **options), batch_of(windows)
    with torch.no_grad():
        model.sampler.heads.bias.mul_(3)  # some latents are outside of the radius
    objective = small("dsf", **options).train(windows).objective
    terms = dvae.SequenceELBO().terms(model, batch, self_feeding=1.0, draws=objective.draws)
    w, cvae = codes(model, batch), decoder_of(model, windows)
    made = torch.stack([cvae.forecast(past_of(batch), FUTURE, fix={"w": w[:, k]})["x"][0] for k in range(3)])
    excess = (w.square().sum(2) - chi2.ppf(0.2, 4)).clamp_min(0)
    assert 0 < (excess > 0).sum() < excess.numel()
    quality = 2 * (-excess).exp()
    apart = (made[:, None] - made[None]).square().sum((3, 4)).movedim(2, 0)
    spectrum = torch.linalg.eigvalsh(quality[:, :, None] * quality[:, None] * (-apart / 0.01).exp())
    expected = -(spectrum / (1 + spectrum)).sum(1) + 0.3 * w.square().sum(2).mean(1) / 2
    assert objective(terms, 0).item() == pytest.approx((expected.sum() / (4 * FUTURE)).item(), rel=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_gradients_reach_the_sampler_alone(windows, name):
    model, objective = built(windows, name), small(name).train(windows).objective
    terms = dvae.SequenceELBO().terms(model, batch_of(windows), self_feeding=1.0, draws=objective.draws)
    objective(terms, 0).backward()
    learning = {name for name, parameter in model.named_parameters() if parameter.grad is not None}
    assert learning == {f"generator.x.network.sampler.{name}" for name, _ in model.sampler.named_parameters()}
    assert all(parameter.grad.any() for parameter in model.sampler.parameters())


@pytest.mark.parametrize("name", NAMES)
def test_entries_that_are_missing_in_the_future_do_not_count(windows, name):
    model, batch = built(windows, name), batch_of(windows)
    draws = small(name).train(windows).objective.draws
    mask = torch.ones_like(batch["x"], dtype=torch.bool)
    mask[:, PAST + 2 :, :6] = False

    def energies(x):
        torch.manual_seed(1)
        return dvae.SequenceELBO().terms(model, {"x": x, "mask": mask}, self_feeding=1.0, draws=draws).energies

    whole, other = energies(batch["x"]), energies(torch.where(mask, batch["x"], torch.nan))
    assert all(torch.equal(value, other[name]) for name, value in whole.items())


# ------------------------------------------------------------------------------------------------------------- futures


def test_the_modes_of_a_set_have_one_noise_and_sets_have_others(windows):
    model, past = built(windows, "dlow"), past_of(batch_of(windows))
    made = model.forecast(past, FUTURE, 9)
    noise = made["e"].unflatten(0, (3, 3))
    assert torch.equal(noise, noise[:, :1].expand_as(noise))
    assert len(noise[:, 0].flatten(0, 1).unique(dim=0)) == 3 * 4
    for k in range(3):
        data = {**past, "k": torch.eye(3)[k].expand(4, -1).double()}
        alone = model.forecast(data, FUTURE, fix={"e": noise[1, 0]})["x"][0]
        torch.testing.assert_close(made["x"][3 + k], alone)


@pytest.mark.parametrize("samples", [1, 2, 3, 5])
def test_samples_that_fill_no_set_are_some_of_its_modes(windows, samples):
    model, past = built(windows, "dsf"), past_of(batch_of(windows))
    every = model.forecast(past, FUTURE, 3)["x"]
    made = model.forecast(past, FUTURE, samples)["x"]
    assert made.shape == (samples, *every.shape[1:])
    which = [[k for k in range(3) if torch.allclose(one, every[k])] for one in made]
    assert all(len(found) == 1 for found in which)
    assert len({found[0] for found in which[3 * (samples // 3) :]}) == samples % 3
    assert [found[0] for found in which[: 3 * (samples // 3)]] == [0, 1, 2] * (samples // 3)


def test_a_random_part_of_a_set_is_not_always_the_same(windows):
    model, past = built(windows, "dsf"), past_of(batch_of(windows, 1))
    torch.manual_seed(0)
    assert len({model.forecast(past, 1)["x"].sum().item() for _ in range(20)}) == 3


def test_dsf_has_as_many_futures_as_modes_and_no_noise(windows):
    model, past = built(windows, "dsf"), past_of(batch_of(windows))
    made = model.forecast(past, FUTURE, 6)["x"]
    torch.testing.assert_close(made[:3], made[3:])
    assert (made[:3].std(0) > 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_chunks_change_no_shape_and_no_order(windows, name):
    model, past = built(windows, name), past_of(batch_of(windows))
    noise = {"fix": {"e": torch.ones(4, 4)}} if name == "dlow" else {}
    whole, parts = (model.forecast(past, FUTURE, 6, chunk=chunk, **noise)["x"] for chunk in (2048, 1))
    torch.testing.assert_close(whole, parts)
    with pytest.raises(ValueError, match="samples is 0; it must be at least 1"):
        model.forecast(past, FUTURE, 0)


@pytest.mark.parametrize("name", NAMES)
def test_a_forecast_goes_on_from_frames_of_the_future_too(windows, name):
    model, batch = built(windows, name), batch_of(windows)
    made = model.forecast({"x": batch["x"][:, : PAST + 2]}, FUTURE - 2, 4)["x"]
    assert made.shape == (4, 4, FUTURE - 2, 48)
    assert len(made[:3, 0, 0, 0].unique()) == 3


@pytest.mark.parametrize("name", NAMES)
def test_gaps_are_filled_by_futures_of_modes(windows, name):
    model, batch = built(windows, name), batch_of(windows)
    mask = torch.ones_like(batch["x"], dtype=torch.bool)
    mask[:, PAST + 1, :3] = False
    filled = model.impute({**batch, "mask": mask}, 4)["x"]
    assert torch.equal(filled[:, mask], batch["x"][mask].expand(4, -1))
    assert len(filled[:, 0, PAST + 1, 0].unique()) >= 3


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_that_says_no_mode_is_scored_in_one_at_random(windows, name):
    model, batch = built(windows, name), batch_of(windows, 1)
    torch.manual_seed(0)
    noise = {"e": torch.ones(1, 4).double()} if name == "dlow" else {}
    known = [model.log_joint({**batch, "k": k[None]}, noise)["x"].item() for k in torch.eye(3).double()]
    found = [model.log_joint(batch, noise)["x"].item() for _ in range(20)]
    assert {min(range(3), key=lambda k: abs(known[k] - one)) for one in found} == {0, 1, 2}
    assert all(min(abs(one - each) for each in known) < 1e-9 for one in found)
    assert math.isfinite(dvae.importance_bound(model, batch, particles=4).bound.item())


@pytest.mark.parametrize("name", NAMES)
def test_rows_of_one_past_are_seen_once_and_are_those_that_each_would_be(windows, name):
    model = built(windows, name)
    data = model.in_sets(batch_of(windows))
    assert data[GROUP].tolist() == [0, 1, 2, 3] * 3
    network, order = model.generator["x"].network, torch.randperm(12, generator=torch.Generator().manual_seed(3))
    parents = {name: data[name] for name in ("h", "k", "x")} | {"e": torch.ones(12, 4).double()}
    assert len(network.sampler(parents["h"])) == 4
    assert len(network.sampler(parents["h"][order])) == 12
    mixed = network({name: value[order] for name, value in parents.items()}, FUTURE)
    torch.testing.assert_close(mixed, network(parents, FUTURE)[order])


# ---------------------------------------------------------------------------------------------------- whose decoder


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "skeleton", [dvae.motion.HUMAN36M, dvae.motion.HUMANEVA, dvae.motion.WALKER], ids=lambda s: s.name
)
def test_windows_are_turned_where_those_of_the_cvae_are(name, skeleton):
    assert dvae.method(name).preset(skeleton)["heading"] == dvae.method("cvae").preset(skeleton)["heading"]


@pytest.mark.parametrize("name", NAMES)
def test_a_run_has_the_decoder_of_the_cvae_and_does_without_its_run(people, cvae_run, tmp_path, name):
    own = shutil.copytree(cvae_run, tmp_path / "cvae")
    method = dvae.method(name, cvae_run=str(own), modes=3, sampler_width=8, sampler_hidden=(7, 6))
    training = dvae.Training(steps=2, batch_size=4, progress=False, accelerator="cpu")
    runs.fit_run(method, people, tmp_path / "run", training)
    cvae = runs.load(own).model.generator["x"]
    shutil.rmtree(own)
    run = runs.load(tmp_path / "run")
    assert {option: getattr(run.method, option) for option in OF_CVAE} == OF_CVAE
    assert run.method.heading
    for ours, theirs in (
        (run.model.generator["x"].network.decoder, cvae.network),
        (run.model.generator["x"].law, cvae.law),
    ):
        assert all(torch.equal(value, theirs.state_dict()[key]) for key, value in ours.state_dict().items())
    assert run.model.forecast(past_of(people.windows("test").all()), FUTURE, 3)["x"].isfinite().all()


@pytest.mark.parametrize("name", NAMES)
def test_without_a_run_a_cvae_is_fitted_first(windows, name):
    method = small(name).suited(windows)
    decoders = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        model = method.build(windows)
        before = copy.deepcopy(model.generator["x"].network.decoder.state_dict())
        method.train(windows, steps=2).prepare(model)
        decoders.append(model.generator["x"].network.decoder.state_dict())
        assert all(not torch.equal(value, before[key]) for key, value in decoders[-1].items())
    first, again, other = decoders
    assert all(torch.equal(value, again[key]) for key, value in first.items())
    assert not all(torch.equal(value, other[key]) for key, value in first.items())


def started(windows, run, **options):
    method = dvae.method("dlow", cvae_run=str(run), modes=3, **options).suited(windows)
    method.train(windows).prepare(method.build(windows))


def test_the_run_of_something_else_is_refused(windows, people, cvae_run, tmp_path):
    with pytest.raises(ValueError, match=r"width is 9, but .* was fitted with 8; leave it out, and dlow takes it from"):
        started(windows, cvae_run, width=9)
    with pytest.raises(CheckpointError, match="is no run directory"):
        started(windows, tmp_path)
    other = windows.with_protocol(replace(windows.protocol, predicted=6))
    with pytest.raises(
        ValueError, match=r"was fitted on other windows: protocol.predicted is 7, not 6; fit one on these"
    ):
        started(other, cvae_run)
    training = dvae.Training(steps=1, batch_size=4, progress=False, accelerator="cpu")
    others = {"vae": {"latent": 2, "warm_up": 0}, "cvae": {**OF_CVAE, "components": 2}}
    for n, (name, options) in enumerate(others.items()):
        runs.fit_run(dvae.method(name, **options), people, tmp_path / str(n), training)
        with pytest.raises(
            ValueError, match=r"holds no cvae whose latent is near N\(0, I\); fit one first, by `dvae fit"
        ):
            started(windows, tmp_path / str(n))


@pytest.mark.parametrize(
    "change",
    [
        {"method": {"method": "cvae", "latent": 10**9}},
        {"method": {"method": "nothing"}},
        {"method": [1, 2]},
        {"schema": {"kind": "poses"}},
        {"schema": 3},
        {"schema": {"kind": "poses", "skeleton": {"names": ["a"]}, "protocol": {}, "length": None}},
    ],
)
def test_a_config_that_is_none_of_a_cvae_is_refused(windows, cvae_run, tmp_path, change):
    run = Path(shutil.copytree(cvae_run, tmp_path / "cvae"))
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**config, **change}))
    with pytest.raises(ValueError, match=r"config\.json is none of a cvae: "):
        started(windows, run)


def test_weights_that_are_not_those_of_the_config_are_refused(windows, cvae_run, tmp_path):
    run = Path(shutil.copytree(cvae_run, tmp_path / "cvae"))
    config = json.loads((run / "config.json").read_text())
    for width, message in ((9, "holds the weights of another model"), (16384, "asks for a model that is larger than")):
        (run / "config.json").write_text(json.dumps({**config, "method": {**config["method"], "width": width}}))
        with pytest.raises(CheckpointError, match=message):
            started(windows, run)


@pytest.mark.parametrize(
    ("held", "message"),
    [
        (("hands",), "has no part or joint 'hands'; it has lower, upper"),
        (("lower", "upper"), "held are lower, upper, all"),
    ],
)
def test_what_cannot_be_held_is_refused(windows, held, message):
    with pytest.raises(ValueError, match=message):
        built(windows, "dlow", held=held)
