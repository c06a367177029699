import inspect
import math
from itertools import combinations

import pytest
import torch
from torch.autograd import gradcheck

from dvae.motion import HUMAN36M, HUMANEVA, WALKER, AngleLimits, Skeleton, estimate_angle_limits
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

STICK = Skeleton(("hip", "knee", "foot"), (-1, 0, 1), name="stick")
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
    def test_is_held_to_these_laws(self):
        found = inspect.getmembers(energies, inspect.isfunction)
        own = {name for name, function in found if function.__module__ == energies.__name__}
        assert set(ENERGIES) == {name for name in own if not name.startswith("_")}

    @every_energy
    def test_is_one_number_a_sequence_in_the_precision_of_the_samples(self, energy):
        for dtype in (torch.float32, torch.float64):
            given = {name: x.to(dtype) if x.is_floating_point() else x for name, x in SEQUENCES.items()}
            values = energy(normal(S, B, T, D).to(dtype), **given)
            assert values.shape == (B,)
            assert values.dtype == dtype

    @every_energy
    def test_gradient(self, energy):
        samples = normal(2, B, 2, D).requires_grad_()
        given = SEQUENCES | {"truth": SEQUENCES["truth"][:, :2], "pseudo": SEQUENCES["pseudo"][:, :, :2]}
        assert gradcheck(lambda x: energy(x, **given), samples, fast_mode=True)
        assert gradient(energy(samples, **given), samples).any()

    @every_energy
    def test_moves_with_the_sequences(self, energy):
        samples, order = normal(S, B, T, D), torch.tensor([2, 0, 1])
        values = energy(samples, **SEQUENCES)
        permuted = energy(samples[:, order], **{name: x[order] for name, x in SEQUENCES.items()})
        torch.testing.assert_close(permuted, values[order])

    @every_energy
    def test_does_not_know_the_order_of_the_samples(self, energy):
        samples = normal(S, B, T, D)
        torch.testing.assert_close(energy(samples.flip(0), **SEQUENCES), energy(samples, **SEQUENCES))

    @every_energy
    def test_limbs_without_length_give_no_nan(self, energy):
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
        found = []
        for block in (1, 10**9):
            monkeypatch.setattr(energies, "BLOCK", block)
            values = energy(samples, **SEQUENCES)
            found.append((values, torch.autograd.grad((values * torch.arange(1, B + 1)).sum(), samples)[0]))
        torch.testing.assert_close(*found)

    @every_energy
    def test_sizes_of_one(self, energy):
        samples = normal(1, 1, 1, D).requires_grad_()
        given = {"truth": normal(1, 1, D), "pseudo": normal(1, 1, 1, D), "reference": normal(1, D)}
        values = energy(samples, **given, valid=torch.ones(1, 1).bool())
        assert values.shape == (1,)
        assert gradient(values, samples).isfinite().all()

    @every_energy
    def test_needs_no_gradient(self, energy):
        samples = normal(S, B, T, D)
        values = energy(samples, **SEQUENCES)
        assert not values.requires_grad
        with torch.inference_mode():
            torch.testing.assert_close(energy(samples, **SEQUENCES), values)
        assert gradient(energy(samples.requires_grad_(), **SEQUENCES), samples).isfinite().all()

    @every_energy
    def test_refuses_other_shapes(self, energy):
        with pytest.raises(ValueError, match=r"samples have shape \(5, 4, 48\), expected \(S, B, T, D\)"):
            energy(normal(S, T, D), **SEQUENCES)
        with pytest.raises(ValueError, match="with no size 0"):
            energy(normal(0, B, T, D), **SEQUENCES)
        if energy not in [ENERGIES[name] for name in OF_SAMPLES]:
            with pytest.raises(ValueError, match="beside samples"):
                energy(normal(S, B + 1, T, D), **SEQUENCES)


class TestBestOfMany:
    def test_by_hand(self):
        samples = torch.tensor([[[0.0, 0.0], [1.0, 0.0]], [[2.0, 1.0], [3.0, 3.0]]])[:, None]  # 2 samples, 2 frames
        assert best_of_many(samples, torch.tensor([[[1.0, 0.0], [1.0, 0.0]]])).tolist() == [1]
        assert best_of_many(samples, torch.tensor([[[2.0, 1.0], [3.0, 1.0]]])).tolist() == [4]

    def test_is_the_naive_form_and_its_gradient(self):
        samples, truth = normal(S, B, T, D).requires_grad_(), normal(B, T, D)
        naive = (samples - truth).square().sum((2, 3)).amin(0)
        found = best_of_many(samples, truth)
        torch.testing.assert_close(found, naive, rtol=0, atol=1e-12)
        torch.testing.assert_close(gradient(found, samples), gradient(naive, samples), rtol=0, atol=1e-12)

    def test_only_the_best_sample_has_a_gradient(self):
        samples = normal(S, B, T, D).requires_grad_()
        found = gradient(best_of_many(samples, normal(B, T, D)), samples)
        assert (found.flatten(2).any(2).sum(0) == 1).all()


class TestMultimodalBestOfMany:
    def naive(self, samples, pseudo, valid):
        errors = (samples[:, :, None] - pseudo).square().sum((3, 4)).amin(0)
        return torch.where(valid, errors, 0).sum(1) * len(valid) / valid.sum()

    def test_by_hand(self):
        samples = torch.tensor([0.0, 4.0]).expand(2, 2).T[:, :, None, None]  # samples 0 and 4, for both sequences
        pseudo = torch.tensor([[1.0, 6.0], [3.0, torch.nan]])[:, :, None, None]
        valid = torch.tensor([[True, True], [True, False]])
        # errors 1, 4 and 1: mean 2 over three futures
        energy = multimodal_best_of_many(samples, pseudo, valid)
        assert energy.mean().item() == pytest.approx(2)
        assert energy.tolist() == pytest.approx([10 / 3, 2 / 3])

    def test_is_the_naive_form_and_its_gradient(self):
        samples = normal(S, B, T, D).requires_grad_()
        pseudo, valid = SEQUENCES["pseudo"], SEQUENCES["valid"]
        naive = self.naive(samples, pseudo, valid)
        found = multimodal_best_of_many(samples, pseudo, valid)
        torch.testing.assert_close(found, naive)
        torch.testing.assert_close(gradient(found, samples), gradient(naive, samples))

    def test_finds_the_best_among_close_samples_far_from_the_origin(self):
        """In single precision the squared norms alone, 10^9, would hide differences of a millimetre."""
        samples = 1000 + 0.001 * torch.randn(20, B, T, D)
        pseudo = 1000 + 0.001 * torch.randn(B, M, T, D)
        valid = torch.ones(B, M).bool()
        naive = self.naive(samples.double(), pseudo.double(), valid)
        torch.testing.assert_close(multimodal_best_of_many(samples, pseudo, valid).double(), naive, rtol=1e-5, atol=0)

    @pytest.mark.parametrize("filler", [torch.nan, torch.inf, 0.0, 1e30])
    def test_invalid_futures_do_not_leak(self, filler):
        samples, valid = normal(S, B, T, D).requires_grad_(), SEQUENCES["valid"]
        pseudo = SEQUENCES["pseudo"].where(valid[..., None, None], filler)
        expected = multimodal_best_of_many(samples, SEQUENCES["pseudo"], valid)
        found = multimodal_best_of_many(samples, pseudo, valid)
        torch.testing.assert_close(found, expected, rtol=0, atol=0)
        torch.testing.assert_close(gradient(found, samples), gradient(expected, samples), rtol=0, atol=0)

    @pytest.mark.parametrize("futures", [0, M])
    def test_without_any_future_it_is_zero(self, futures):
        samples = normal(S, B, T, D).requires_grad_()
        pseudo = torch.full((B, futures, T, D), torch.nan)
        found = multimodal_best_of_many(samples, pseudo, torch.zeros(B, futures).bool())
        assert found.tolist() == [0] * B
        assert not gradient(found, samples).any()

    def test_refuses_a_mask_of_numbers(self):
        with pytest.raises(ValueError, match=r"valid has dtype torch.float32, expected torch.bool"):
            multimodal_best_of_many(normal(S, B, T, D), SEQUENCES["pseudo"], SEQUENCES["valid"].float())


class TestPairwiseDiversity:
    def test_by_hand(self):
        samples = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, -2.0]])[:, None, None]  # L1 distances 1, 3, 2
        expected = sum(math.exp(-d / 2) for d in (1, 3, 2)) / 3
        assert pairwise_diversity(samples, scale=2).tolist() == pytest.approx([expected])

    def test_is_the_naive_form_and_its_gradient(self):
        samples = normal(S, B, T, D).requires_grad_()
        pairs = [(a - b).abs().sum((1, 2)) for a, b in combinations(samples, 2)]
        naive = torch.stack([(-d / 90).exp() for d in pairs]).mean(0)
        found = pairwise_diversity(samples, 90)
        torch.testing.assert_close(found, naive)
        torch.testing.assert_close(gradient(found, samples), gradient(naive, samples))

    def test_equal_samples_are_not_diverse_and_one_sample_has_no_pair(self):
        assert pairwise_diversity(normal(1, B, T, D).expand(S, B, T, D), 1).tolist() == pytest.approx([1] * B)
        samples = normal(1, B, T, D).requires_grad_()
        found = pairwise_diversity(samples, 1)
        assert found.tolist() == [0] * B
        assert not gradient(found, samples).any()

    @pytest.mark.parametrize("scale", [0, -1, math.nan])
    def test_refuses_a_scale_that_is_no_distance(self, scale):
        samples = normal(S, B, T, D)
        for energy in (pairwise_diversity, gaussian_diversity):
            with pytest.raises(ValueError, match=f"scale is {scale}"):
                energy(samples, scale)
        with pytest.raises(ValueError, match=f"scale is {scale}"):
            determinantal_diversity(samples, torch.ones(S, B), scale)


class TestGaussianDiversity:
    def test_is_the_naive_form_and_its_gradient(self):
        samples = normal(S, B, T, D).requires_grad_()
        pairs = [(a - b).square().sum((1, 2)) for a, b in combinations(samples, 2)]
        naive = torch.stack([(-d / 300).exp() for d in pairs]).mean(0)
        found = gaussian_diversity(samples, 300)
        torch.testing.assert_close(found, naive)
        torch.testing.assert_close(gradient(found, samples), gradient(naive, samples))

    def test_distances_of_what_is_far_away_lose_no_digits(self):
        near = 0.01 * normal(S, B, T, D)
        expected = gaussian_diversity(near, 0.04)
        found = gaussian_diversity((near + 100).float(), 0.04)
        torch.testing.assert_close(found, expected.float(), rtol=1e-3, atol=0)

    def test_equal_samples_are_not_diverse_and_one_sample_has_no_pair(self):
        assert gaussian_diversity(normal(1, B, T, D).expand(S, B, T, D), 1).tolist() == pytest.approx([1] * B)
        assert gaussian_diversity(normal(1, B, T, D), 1).tolist() == [0] * B


class TestDeterminantalDiversity:
    def test_is_minus_the_expected_size_of_a_random_subset_of_the_samples(self):
        """P(A) = det L_A / det (L + I), over all subsets A."""
        samples, quality = normal(S, 1, T, D), 1 + torch.rand(S, 1).double()
        apart = (samples[:, None] - samples[None]).square().sum((3, 4))[..., 0]
        kernel = quality * quality.T * (-apart / 300).exp()
        subsets = [torch.tensor(c, dtype=torch.long) for n in range(S + 1) for c in combinations(range(S), n)]
        weights = torch.stack([torch.linalg.det(kernel[c][:, c]) for c in subsets])
        torch.testing.assert_close(weights.sum(), torch.linalg.det(kernel + torch.eye(S)))
        expected = (weights * torch.tensor([len(c) for c in subsets])).sum() / weights.sum()
        torch.testing.assert_close(-determinantal_diversity(samples, quality, 300)[0], expected)

    def test_samples_that_are_far_apart_count_by_their_quality_and_equal_ones_as_one(self):
        quality = torch.tensor([1.0, 2.0, 0.0]).double()[:, None]
        apart = 1e3 * torch.arange(3).double()[:, None, None, None].expand(3, 1, T, D)
        assert determinantal_diversity(apart, quality, 1).tolist() == pytest.approx([-(1 / 2 + 4 / 5)])
        together = determinantal_diversity(apart[:1].expand(3, 1, T, D), quality, 1)
        assert together.tolist() == pytest.approx([-5 / 6])  # the one eigenvalue is 1 + 4

    def test_refuses_qualities_of_other_samples(self):
        with pytest.raises(ValueError, match=r"quality has shape \(3, 5\), expected \(5, 3\)"):
            determinantal_diversity(normal(S, B, T, D), torch.ones(B, S), 1.0)


def test_history_error_by_hand():
    samples = torch.tensor([[[1.0, 2.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 3.0]]])[:, None]  # 2 samples of 2 frames
    assert history_error(samples, torch.zeros(1, 2, 2)).tolist() == [(5 + 0 + 0 + 9) / 4]


class TestLimbLength:
    def test_by_hand(self):
        # a knee and a foot; thighs of 1 and 2 m, shanks of 5 and 0 m, where 1 and 3 are expected
        samples = torch.tensor([[1.0, 0, 0, 1, 3, 4], [0, 2, 0, 0, 2, 0]])[:, None, None]
        reference = torch.tensor([[0.0, 0, 1, 3, 0, 1]])
        assert limb_length(samples, reference, STICK).tolist() == pytest.approx([((0 + 4) + (1 + 9)) / 2])

    @pytest.mark.parametrize("skeleton", [HUMAN36M, HUMANEVA, WALKER], ids=lambda s: s.name)
    def test_agrees_with_the_skeleton(self, skeleton):
        samples, reference = normal(S, B, T, skeleton.joints, 3), normal(B, skeleton.joints, 3)
        samples, reference = (x - x[..., :1, :] for x in (samples, reference))
        errors = skeleton.bone_lengths(samples) - skeleton.bone_lengths(reference)[:, None]
        expected = errors.square().sum(-1).mean((0, 2))
        torch.testing.assert_close(limb_length(samples.flatten(3), reference.flatten(1), skeleton), expected)
        dropped = limb_length(samples[..., 1:, :].flatten(3), reference[:, 1:].flatten(1), skeleton)
        torch.testing.assert_close(dropped, expected)

    def test_turning_a_pose_costs_nothing(self):
        reference = normal(B, 16, 3)
        turn, _ = torch.linalg.qr(normal(S, 1, T, 3, 3))
        samples = (reference[:, None] @ turn).flatten(3)
        assert limb_length(samples, reference.flatten(1), WALKER).tolist() == pytest.approx([0] * B, abs=1e-24)


class TestJointAngles:
    def naive(self, samples, limits, skeleton):
        """The term as the paper's code has it, a scalar."""
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

    def test_by_hand(self):
        """Head2Neck of three poses: the head turned back, forward by a right angle, and upright."""
        places = {"Spine": (0, 0.2, 0), "Thorax": (0, 0.4, 0)}
        poses = []
        for neck in [(0, 0.3, 0), (0, 0.4, 0.1), (0, 0.5, 0)]:
            at = places | {"Neck": neck}
            poses.append([x for name in WALKER.names[1:] for x in at.get(name, (0, 0, 0))])
        samples = torch.tensor(poses, dtype=torch.float64)[None, :, None]  # cosines -1, 0, 1
        low, high = (torch.full((len(LIMITS.names),), x, dtype=torch.float64) for x in (-1.0, 1.0))
        column = LIMITS.names.index("Head2Neck")
        low[column], high[column] = 0.5, 0.75
        # below: 1.5 and .5, mean of squares 1.25; above: .25
        energy = joint_angles(samples, AngleLimits(LIMITS.names, low, high), WALKER)
        assert energy.mean().item() == pytest.approx(1.25 + 0.25**2)
        assert energy.tolist() == pytest.approx([3 * 2.25 / 2, 3 * 0.25 / 2, 3 * 0.25**2])
        low[column], high[column] = -0.99, 0.99
        assert joint_angles(samples, AngleLimits(LIMITS.names, low, high), WALKER).tolist() == [0, 0, 0]

    @pytest.mark.parametrize("skeleton", [HUMAN36M, HUMANEVA], ids=lambda s: s.name)
    @pytest.mark.parametrize("spread", [0.3, 0.001])
    def test_mean_and_gradient_are_those_of_the_naive_form(self, skeleton, spread):
        people = normal(1, 1, 1, 3 * (skeleton.joints - 1))
        limits = estimate_angle_limits(people + 0.05 * normal(500, people.shape[-1]), skeleton, 0.02)
        samples = (people + spread * normal(S, B, T, 1)).requires_grad_()
        naive, found = self.naive(samples, limits, skeleton), joint_angles(samples, limits, skeleton).mean()
        torch.testing.assert_close(found, naive)
        if spread == 0.3:
            torch.testing.assert_close(gradient(found, samples), gradient(naive, samples))
            assert found > 0

    def test_within_the_limits_nothing_costs(self):
        poses = normal(S, B, T, D)
        limits = estimate_angle_limits(poses, WALKER)
        samples = poses.requires_grad_()
        found = joint_angles(samples, limits, WALKER)
        assert found.tolist() == [0] * B
        assert not gradient(found, samples).any()

    def test_refuses_limits_of_another_skeleton(self):
        with pytest.raises(
            ValueError, match=r"limits of the angles Spine2Hip, .* expected those of skeleton 'humaneva'"
        ):
            joint_angles(normal(S, B, T, 42), LIMITS, HUMANEVA)


class TestPosePriorEnergy:
    def test_by_hand(self):
        """The prior sees unit directions, whatever the limbs' lengths; its log-determinant does not count."""
        samples = torch.tensor([[2.0, 0, 0, 2, 0, 0.5], [0, 3, 0, 0, 3, 0]])[:, None, None]  # the second has no shank
        directions = []

        def prior(d):
            directions.append(d)
            return 2 * d, torch.full(d.shape[:-1], 100.0)

        energy = pose_prior_energy(samples, prior, STICK)
        assert directions[0].flatten(0, 2).tolist() == [[1, 0, 0, 0, 0, 1], [0, 1, 0, 0, 0, 0]]
        # squares of z: 8 and 4
        assert energy.tolist() == pytest.approx([0.5 * (8 + 4) / 2 + 3 * math.log(2 * math.pi)])

    def test_is_the_normal_density_of_z(self):
        samples = normal(S, B, T, D)
        limbs = WALKER.limbs(samples)
        z, _ = linear_prior((limbs / limbs.norm(dim=-1, keepdim=True)).flatten(-2))
        expected = -torch.distributions.Normal(0.0, 1.0).log_prob(z).sum(-1).mean((0, 2))
        torch.testing.assert_close(pose_prior_energy(samples, linear_prior, WALKER), expected)

    def test_the_prior_learns_too(self):
        weight = torch.ones((), dtype=torch.float64, requires_grad=True)
        pose_prior_energy(normal(S, B, T, D), lambda d: (weight * d, d.sum(-1)), WALKER).sum().backward()
        assert weight.grad > 0


class TestLimbs:
    def test_by_hand(self):
        poses = torch.tensor([1.0, 2, 3, 1, 2, 0])
        assert STICK.limbs(poses).tolist() == [[1, 2, 3], [0, 0, -3]]
        assert STICK.limbs(torch.cat([torch.ones(3), poses])).tolist() == [[0, 1, 2], [0, 0, -3]]

    def test_a_root_that_is_not_first(self):
        skeleton = Skeleton(("hand", "chest", "head"), (1, -1, 1))
        hand, chest, head = normal(2, 3), normal(2, 3), normal(2, 3)
        expected = torch.stack([hand - chest, head - chest], 1)
        torch.testing.assert_close(skeleton.limbs(torch.cat([hand, chest, head], 1)), expected)
        torch.testing.assert_close(skeleton.limbs(torch.cat([hand, head], 1) - chest.repeat(1, 2)), expected)

    def test_refuses_other_sizes(self):
        with pytest.raises(ValueError, match=r"poses have 7 numbers, expected 9 \(3 joints of skeleton 'stick'\) or 6"):
            STICK.limbs(torch.zeros(4, 7))

    def test_keep_their_digits_in_a_lower_precision_region(self):
        poses = normal(4, D).float()
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert WALKER.limbs(poses).dtype == torch.float32
