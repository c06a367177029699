import inspect
import math
from itertools import combinations

import pytest
import torch
from torch.autograd import gradcheck

from dvae.motion import HUMAN36M, HUMANEVA, WALKER, estimate_angle_limits
from dvae.motion.geometry.angles import cosines
from dvae.motion.scoring import energies
from dvae.motion.scoring.energies import (
    best_of_many,
    determinantal_diversity,
    gaussian_diversity,
    history_error,
    joint_angles,
    limb_length,
    multimodal_best_of_many,
    pairwise_diversity,
    pose_prior_energy,
)

S, B, T, M = 5, 3, 4, 6
D = 3 * (WALKER.joints - 1)


def normal(*shape):
    return torch.randn(*shape, dtype=torch.float64)


def linear_prior(directions):
    weights = torch.linspace(-1, 1, directions.shape[-1] ** 2, dtype=directions.dtype)
    return directions @ weights.view(directions.shape[-1], -1) + 0.3, directions.sum(-1)


LIMITS = estimate_angle_limits(
    0.4 * torch.randn(300, D, generator=torch.Generator().manual_seed(0)).double(), WALKER, 0.2
)
SEQUENCES = {"truth": normal(B, T, D), "pseudo": normal(B, M, T, D), "reference": normal(B, D)}
SEQUENCES["valid"] = torch.tensor([[1, 0, 1, 1, 0, 0], [0] * 6, [0, 1, 0, 0, 0, 0]]).bool()

ENERGIES = {
    "best_of_many": lambda x, truth, **_: best_of_many(x, truth),
    "multimodal_best_of_many": lambda x, pseudo, valid, **_: multimodal_best_of_many(x, pseudo, valid),
    "pairwise_diversity": lambda x, **_: pairwise_diversity(x, scale=100.0),
    "gaussian_diversity": lambda x, **_: gaussian_diversity(x, scale=500.0),
    "determinantal_diversity": lambda x, **_: determinantal_diversity(x, x.new_full(x.shape[:2], 0.7), scale=500.0),
    "history_error": lambda x, truth, **_: history_error(x, truth),
    "limb_length": lambda x, reference, **_: limb_length(x, reference, WALKER),
    "joint_angles": lambda x, **_: joint_angles(x, LIMITS, WALKER),
    "pose_prior_energy": lambda x, **_: pose_prior_energy(x, linear_prior, WALKER),
}
OF_SAMPLES = (
    *("pairwise_diversity", "gaussian_diversity", "determinantal_diversity"),
    *("joint_angles", "pose_prior_energy"),
)
every_energy = pytest.mark.parametrize("energy", ENERGIES.values(), ids=list(ENERGIES))


def gradient(value, samples):
    return torch.autograd.grad(value.sum(), samples)[0]


class TestEveryEnergy:
    def test_all_energies_are_in_the_table(self):
        functions = inspect.getmembers(energies, inspect.isfunction)
        names = {name for name, function in functions if function.__module__ == energies.__name__}
        assert set(ENERGIES) == {name for name in names if not name.startswith("_")}

    @every_energy
    def test_is_one_number_per_sequence_in_the_precision_of_the_samples(self, energy):
        for dtype in (torch.float32, torch.float64):
            arguments = {name: x.to(dtype) if x.is_floating_point() else x for name, x in SEQUENCES.items()}
            values = energy(normal(S, B, T, D).to(dtype), **arguments)
            assert values.shape == (B,)
            assert values.dtype == dtype

    @every_energy
    def test_gradient(self, energy):
        samples = normal(2, B, 2, D).requires_grad_()
        arguments = SEQUENCES | {"truth": SEQUENCES["truth"][:, :2], "pseudo": SEQUENCES["pseudo"][:, :, :2]}
        assert gradcheck(lambda x: energy(x, **arguments), samples, fast_mode=True)
        assert gradient(energy(samples, **arguments), samples).any()

    @every_energy
    def test_limbs_of_length_zero_give_no_nan(self, energy):
        samples = torch.zeros(S, B, T, D, dtype=torch.float64)
        samples[:, 0] = normal(T, D)
        samples[:, 0, :, 3:6] = samples[:, 0, :, :3]  # the right thigh
        samples.requires_grad_()
        values = energy(samples, **SEQUENCES | {"reference": torch.zeros(B, D).double()})
        assert values.isfinite().all()
        assert gradient(values, samples).isfinite().all()

    @every_energy
    def test_blocks_change_nothing(self, energy, monkeypatch):
        samples = normal(S, B, T, D).requires_grad_()
        results = []
        for block in (1, 10**9):
            monkeypatch.setattr(energies, "BLOCK", block)
            values = energy(samples, **SEQUENCES)
            results.append((values, torch.autograd.grad((values * torch.arange(1, B + 1)).sum(), samples)[0]))
        torch.testing.assert_close(*results)

    @every_energy
    def test_wrong_shapes_are_errors(self, energy):
        with pytest.raises(ValueError, match=r"samples have shape \(5, 4, 48\), expected \(S, B, T, D\)"):
            energy(normal(S, T, D), **SEQUENCES)
        with pytest.raises(ValueError, match="with no size 0"):
            energy(normal(0, B, T, D), **SEQUENCES)
        if energy not in [ENERGIES[name] for name in OF_SAMPLES]:
            with pytest.raises(ValueError, match="for samples of shape"):
                energy(normal(S, B + 1, T, D), **SEQUENCES)

    @pytest.mark.parametrize(
        ("call", "message"),
        [
            (lambda x: gaussian_diversity(x, math.nan), "scale is nan"),
            (lambda x: pairwise_diversity(x, -1), "scale is -1"),
            (lambda x: determinantal_diversity(x, torch.ones(S, B), 0), "scale is 0"),
            (
                lambda x: determinantal_diversity(x, torch.ones(B, S), 1.0),
                r"quality has shape \(3, 5\), expected \(5, 3",
            ),
            (
                lambda x: multimodal_best_of_many(x, SEQUENCES["pseudo"], SEQUENCES["valid"].float()),
                "valid has dtype torch.float32, expected torch.bool",
            ),
            (
                lambda x: joint_angles(x[..., :42], LIMITS, HUMANEVA),
                "`limits` has the angles Spine2Hip, .* expected the angles of skeleton 'humaneva'",
            ),
        ],
    )
    def test_wrong_options_are_errors(self, call, message):
        with pytest.raises(ValueError, match=message):
            call(normal(S, B, T, D))


def squared(first, second):
    return (first - second).square().sum((1, 2))


NAIVE = {
    "best_of_many": lambda x: torch.stack([squared(one, SEQUENCES["truth"]) for one in x]).amin(0),
    "history_error": lambda x: torch.stack([squared(one, SEQUENCES["truth"]) for one in x]).mean(0) / T,
    "pairwise_diversity": lambda x: torch.stack(
        [(-(a - b).abs().sum((1, 2)) / 100).exp() for a, b in combinations(x, 2)]
    ).mean(0),
    "gaussian_diversity": lambda x: torch.stack([(-squared(a, b) / 500).exp() for a, b in combinations(x, 2)]).mean(0),
}


@pytest.mark.parametrize("name", NAIVE)
def test_an_energy_is_its_formula_and_has_its_gradient(name):
    samples = normal(S, B, T, D).requires_grad_()
    value, naive = ENERGIES[name](samples, **SEQUENCES), NAIVE[name](samples)
    torch.testing.assert_close(value, naive)
    torch.testing.assert_close(gradient(value, samples), gradient(naive, samples))


@pytest.mark.parametrize("diversity", [pairwise_diversity, gaussian_diversity])
def test_equal_samples_are_not_diverse_and_one_sample_has_no_pair(diversity):
    assert diversity(normal(1, B, T, D).expand(S, B, T, D), 1).tolist() == pytest.approx([1] * B)
    samples = normal(1, B, T, D).requires_grad_()
    value = diversity(samples, 1)
    assert value.tolist() == [0] * B
    assert not gradient(value, samples).any()


class TestMultimodalBestOfMany:
    def naive(self, samples, pseudo, valid):
        errors = (samples[:, :, None] - pseudo).square().sum((3, 4)).amin(0)
        return torch.where(valid, errors, 0).sum(1) * len(valid) / valid.sum()

    def test_equals_the_naive_form_and_its_gradient(self):
        samples = normal(S, B, T, D).requires_grad_()
        pseudo, valid = SEQUENCES["pseudo"], SEQUENCES["valid"]
        naive = self.naive(samples, pseudo, valid)
        value = multimodal_best_of_many(samples, pseudo, valid)
        torch.testing.assert_close(value, naive)
        torch.testing.assert_close(gradient(value, samples), gradient(naive, samples))

    def test_finds_the_best_among_close_samples_far_from_the_origin(self):
        """In single precision, squared norms of 1e9 would hide differences of a millimetre."""
        samples = 1000 + 0.001 * torch.randn(20, B, T, D)
        pseudo = 1000 + 0.001 * torch.randn(B, M, T, D)
        valid = torch.ones(B, M).bool()
        naive = self.naive(samples.double(), pseudo.double(), valid)
        torch.testing.assert_close(multimodal_best_of_many(samples, pseudo, valid).double(), naive, rtol=1e-5, atol=0)

    @pytest.mark.parametrize("filler", [torch.nan, 1e30])
    def test_invalid_futures_change_nothing(self, filler):
        samples, valid = normal(S, B, T, D).requires_grad_(), SEQUENCES["valid"]
        pseudo = SEQUENCES["pseudo"].where(valid[..., None, None], filler)
        expected = multimodal_best_of_many(samples, SEQUENCES["pseudo"], valid)
        value = multimodal_best_of_many(samples, pseudo, valid)
        torch.testing.assert_close(value, expected, rtol=0, atol=0)
        torch.testing.assert_close(gradient(value, samples), gradient(expected, samples), rtol=0, atol=0)

    @pytest.mark.parametrize("futures", [0, M])
    def test_without_any_future_it_is_zero(self, futures):
        samples = normal(S, B, T, D).requires_grad_()
        pseudo = torch.full((B, futures, T, D), torch.nan)
        value = multimodal_best_of_many(samples, pseudo, torch.zeros(B, futures).bool())
        assert value.tolist() == [0] * B
        assert not gradient(value, samples).any()


class TestGaussianDiversity:
    def test_distances_far_from_the_origin_keep_their_digits(self):
        near = 0.01 * normal(S, B, T, D)
        expected = gaussian_diversity(near, 0.04)
        value = gaussian_diversity((near + 100).float(), 0.04)
        torch.testing.assert_close(value, expected.float(), rtol=1e-3, atol=0)


class TestDeterminantalDiversity:
    def test_equals_minus_the_expected_size_of_a_random_subset(self):
        """P(A) = det L_A / det (L + I), over all subsets A."""
        samples, quality = normal(S, 1, T, D), 1 + torch.rand(S, 1).double()
        differences = (samples[:, None] - samples[None]).square().sum((3, 4))[..., 0]
        kernel = quality * quality.T * (-differences / 300).exp()
        subsets = [torch.tensor(c, dtype=torch.long) for n in range(S + 1) for c in combinations(range(S), n)]
        weights = torch.stack([torch.linalg.det(kernel[c][:, c]) for c in subsets])
        torch.testing.assert_close(weights.sum(), torch.linalg.det(kernel + torch.eye(S)))
        expected = (weights * torch.tensor([len(c) for c in subsets])).sum() / weights.sum()
        torch.testing.assert_close(-determinantal_diversity(samples, quality, 300)[0], expected)


class TestLimbLength:
    @pytest.mark.parametrize("skeleton", [HUMAN36M, WALKER], ids=lambda s: s.name)
    def test_agrees_with_the_skeleton(self, skeleton):
        samples, reference = normal(S, B, T, skeleton.joints, 3), normal(B, skeleton.joints, 3)
        samples, reference = (x - x[..., :1, :] for x in (samples, reference))
        errors = skeleton.bone_lengths(samples) - skeleton.bone_lengths(reference)[:, None]
        expected = errors.square().sum(-1).mean((0, 2))
        torch.testing.assert_close(limb_length(samples.flatten(3), reference.flatten(1), skeleton), expected)
        dropped = limb_length(samples[..., 1:, :].flatten(3), reference[:, 1:].flatten(1), skeleton)
        torch.testing.assert_close(dropped, expected)


class TestJointAngles:
    def naive(self, samples, limits, skeleton):
        """Return the term as in the paper's code, a scalar."""
        values = cosines(samples, skeleton).flatten(0, 2)
        total = samples.new_zeros(())
        for name in dict.fromkeys(limits.names):
            same = [i for i, other in enumerate(limits.names) if other == name]
            cos, low, high = values[:, same].flatten(), limits.low[same[0]], limits.high[same[0]]
            if low >= -0.98 and (cos < low).any():
                total = total + (cos[cos < low] - low).square().mean()
            if high <= 0.98 and (cos > high).any():
                total = total + (cos[cos > high] - high).square().mean()
        return total

    @pytest.mark.parametrize(("skeleton", "spread"), [(HUMAN36M, 0.3), (HUMANEVA, 0.3), (HUMANEVA, 0.001)])
    def test_mean_and_gradient_equal_those_of_the_naive_form(self, skeleton, spread):
        people = normal(1, 1, 1, 3 * (skeleton.joints - 1))
        limits = estimate_angle_limits(people + 0.05 * normal(500, people.shape[-1]), skeleton, 0.02)
        samples = (people + spread * normal(S, B, T, 1)).requires_grad_()
        naive, value = self.naive(samples, limits, skeleton), joint_angles(samples, limits, skeleton).mean()
        torch.testing.assert_close(value, naive)
        if spread == 0.3:
            torch.testing.assert_close(gradient(value, samples), gradient(naive, samples))
            assert value > 0


class TestPosePriorEnergy:
    def test_is_the_normal_density_of_z(self):
        samples = normal(S, B, T, D)
        limbs = WALKER.limbs(samples)
        z, _ = linear_prior((limbs / limbs.norm(dim=-1, keepdim=True)).flatten(-2))
        expected = -torch.distributions.Normal(0.0, 1.0).log_prob(z).sum(-1).mean((0, 2))
        torch.testing.assert_close(pose_prior_energy(samples, linear_prior, WALKER), expected)
