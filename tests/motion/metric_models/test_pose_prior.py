"""The pose prior as a method: its inputs, fitting, storage and errors."""

import json
from dataclasses import replace

import pytest
import torch

import dvae
from dvae import motion
from dvae.cli import main
from dvae.models.registry import configured, metric_model
from dvae.motion.data.dataset import MotionData
from dvae.motion.metric_models.pose_prior import PosePrior, PosePriorModel, fit_pose_prior

CHAIN = motion.Skeleton(("root", "middle", "end"), (-1, 0, 1), name="chain")
SHORT = replace(motion.PROTOCOLS["simulated"], observed=4, predicted=6)


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "people.npz"
    motion.save(path, motion.simulate(clips=14, frames=90, seed=1))
    return path


@pytest.fixture(scope="module")
def train(people):
    return motion.windows(motion.read_motion(people), SHORT, "train")


@pytest.fixture(scope="module")
def run(people, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "prior"
    assert main(["fit", "pose-prior", "--data", str(people), "--out", str(out), "--steps", "12", *SMALL]) == 0
    return out


SMALL = ["--batch-size", "4", "--validate-every", "4", "--noise", "0.005"]


def model(skeleton=motion.WALKER):
    return PosePriorModel(skeleton).double()


def test_it_reads_the_unit_vectors_of_limbs():
    poses = torch.tensor([[0.0, 2.0, 0.0, 3.0, 2.0, 4.0]], dtype=torch.float64)  # middle and end of the limb
    expected = torch.tensor([[0.0, 1.0, 0.0, 0.6, 0.0, 0.8]], dtype=torch.float64)
    prior = model(CHAIN)
    torch.testing.assert_close(prior.skeleton.directions(poses), expected)
    translated = torch.cat([torch.ones(1, 3), poses.unflatten(-1, (2, 3)).add(1)[0].flatten()[None]], -1)
    torch.testing.assert_close(prior.skeleton.directions(translated), expected)
    stretched = poses * torch.tensor([2.0] * 3 + [1.0] * 3) + torch.tensor([0.0] * 3 + [1.5, 2, 2])  # only limbs
    torch.testing.assert_close(prior.log_prob(stretched), prior.log_prob(poses))
    missing = torch.tensor([[0.0, 1.0, 0.0, 0.0, 1.0, 0.0]], dtype=torch.float64, requires_grad=True)  # no second limb
    prior.log_prob(missing).sum().backward()
    assert torch.isfinite(missing.grad).all()


def test_every_frame_is_an_independent_pose(train):
    prior, x = model(), train.all()["x"][:3].double()
    terms = dvae.SequenceELBO().terms(prior, {"x": x})
    expected = prior.log_prob(x)
    assert expected.shape == x.shape[:2]
    torch.testing.assert_close(terms.steps["d"], expected)
    torch.testing.assert_close(terms.bound, expected.sum(1))
    assert terms.n_steps.tolist() == [10, 10, 10]
    assert terms.kl == {}
    z, log_det = prior(prior.skeleton.directions(x))
    noise = torch.distributions.Normal(0.0, 1.0).log_prob(z).sum(-1)
    torch.testing.assert_close(noise + log_det, expected)
    with pytest.raises(ValueError, match="remove lengths"):
        dvae.SequenceELBO().terms(prior, {"x": x, "lengths": torch.tensor([1, 2, 3])})


def test_samples_follow_its_density(train):
    prior = fit_pose_prior(train, steps=20)
    torch.manual_seed(0)
    draws = prior.sample(2000)
    torch.manual_seed(0)
    assert torch.equal(prior.sample(2000), draws)
    z, _ = prior(draws)
    assert z.shape == (2000, 48)
    assert abs(z.mean()) < 5 / z.numel() ** 0.5
    assert abs(z.square().mean() - 1) < 5 * (2 / z.numel()) ** 0.5


def test_training_poses_are_rotated_and_get_noise(train):
    x = train.sample(200, torch.Generator().manual_seed(3))["x"].unflatten(-1, (-1, 3))
    plain = PosePrior(noise=0.0).train(train).batches.sample(200, torch.Generator().manual_seed(3))["x"]
    assert torch.equal(plain, x.flatten(-2))
    noisy = PosePrior(noise=0.004).train(train).batches.sample(200, torch.Generator().manual_seed(3))["x"]
    error = noisy - plain
    assert error.std().item() == pytest.approx(0.004, rel=0.02)
    assert abs(error.mean()) < 5 * 0.004 / error.numel() ** 0.5
    rotated = PosePrior(noise=0.0, turned=True).train(train).batches.sample(200, torch.Generator().manual_seed(3))["x"]
    old, new = (torch.complex(poses[..., 2], poses[..., 0]) for poses in (x, rotated.unflatten(-1, (-1, 3))))
    angles = (new * old.conj()).sum((1, 2)).angle()  # whole windows are rotated about y
    again = motion.rotate_about_up(x, angles[:, None, None], "y").flatten(-2)
    torch.testing.assert_close(rotated, again, rtol=0, atol=1e-5)
    assert torch.polar(torch.ones(200), angles).mean().abs() < 3 / 200**0.5  # in all directions


def test_a_fitted_prior_is_loaded_and_resumed(run, people, tmp_path, capsys):
    run_contents = dvae.load(run)
    assert isinstance(run_contents.model, PosePriorModel)
    assert run_contents.method == metric_model("pose-prior", noise=0.005) == configured(run_contents.method.config())
    assert not torch.equal(run_contents.model.flow.whitening, torch.eye(48))
    x = run_contents.data.windows("test").all()["x"]
    assert torch.isfinite(run_contents.model.log_prob(x)).all()
    training = replace(run_contents.method.trainings[""], steps=8, batch_size=4, validate_every=4, progress=False)
    dvae.fit(run_contents.method, MotionData.open(people), out=tmp_path / "parts", **vars(training))
    assert main(["resume", str(tmp_path / "parts"), "--steps", "12"]) == 0
    assert "dvae evaluate RUN --pose-prior" in capsys.readouterr().out
    rows = [json.loads(line) for line in (tmp_path / "parts" / "log.jsonl").read_text().splitlines()]
    assert max(row["step"] for row in rows) == 12


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (lambda: PosePrior(layers=0), "layers is 0; it must be at least 1"),
        (lambda: PosePrior(noise=-0.1), "noise is -0.1; it must be at least 0 and below 1"),
        (lambda: PosePrior(turned=True, heading=True), "`heading` fixes the direction that `turned` draws"),
        (lambda: PosePrior().build({"x": 48}), "needs the description of poses, but was given sequences"),
    ],
)
def test_wrong_arguments_are_errors(run, message):
    with pytest.raises(ValueError, match=message):
        run()


def test_a_quick_fit_is_reproducible_and_keeps_the_random_state(train):
    state = torch.get_rng_state()
    first, second, other = (fit_pose_prior(train, steps=5, seed=seed).state_dict() for seed in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(value, second[name]) for name, value in first.items())
    assert any(not torch.equal(value, other[name]) for name, value in first.items())
