"""Diffusion and flow matching: exact statements with the optimal denoiser of normal data, and the model contract."""

import math
from dataclasses import replace

import pytest
import torch
from pyro import poutine
from torch.distributions import MultivariateNormal

import dvae
from dvae.distributions import Diffusion, FlowMatching, Normal, Product, Shape
from dvae.distributions.diffusion import _extrapolation, embed_level
from dvae.inference.bounds.predictive import predictive_bound
from dvae.networks import Attention, Denoiser, Recurrent, SelfAttention
from dvae.networks.denoising import BASES
from dvae.testing import FactorizationContract
from dvae.testing.device import move, on_device

COVARIANCE = torch.tensor([[1.0, 0.6], [0.6, 0.5]], dtype=torch.float64)
LOCATION = torch.tensor([0.5, -1.0], dtype=torch.float64)
DATA = MultivariateNormal(LOCATION, COVARIANCE)
COSINE = {"p(x)": Diffusion(denoiser=Denoiser(basis="cosine"))}
JOINT = Denoiser(SelfAttention(width=8, heads=2))


def optimal(z, angle, features, *steps):
    """Return E[v | z] for normal data; with `steps`, the steps are independent."""
    cos, sin = angle.cos(), angle.sin()
    covariance = cos[..., None] ** 2 * COVARIANCE + sin[..., None] ** 2 * torch.eye(2, dtype=z.dtype)
    whitened = torch.linalg.solve(covariance, (z - cos * LOCATION)[..., None])[..., 0]
    return cos * sin * whitened - sin * (LOCATION + cos * whitened @ COVARIANCE)


def build(spec, denoiser=optimal):
    """Return a module without location and scale whose denoiser is known, and a function from rows to parameters."""
    module = spec.build(Shape(2)).double()
    del module.denoiser
    object.__setattr__(module, "denoiser", denoiser)

    def parameters(*rows):
        zeros = torch.zeros(*rows, 2, dtype=torch.float64)
        return zeros, zeros + 1, zeros[..., :0]

    return module, parameters


@pytest.mark.parametrize(("schedule", "shift"), [("learned", 0.0), ("cosine", 0.0), ("cosine", 1.5)])
def test_the_bound_of_normal_data_is_tight(schedule, shift):
    module, parameters = build(Diffusion(schedule=schedule, shift=shift))
    x = DATA.sample((500_000,))
    gap = (DATA.log_prob(x) - module.distribution(parameters(len(x))).log_prob(x)).detach() / 2
    error = gap.std() / math.sqrt(len(x))
    assert error < 0.004
    assert -3 * error < gap.mean() < 0.01 - 2 * error + 3 * error


@pytest.mark.parametrize("spec", [Diffusion(log_snr=(-16.0, 10.0)), FlowMatching()])
def test_the_density_of_the_ode_is_exact_and_its_estimate_is_within_its_error(spec):
    module, parameters = build(spec)
    x = DATA.sample((40,))
    exact = module.distribution(parameters(40)).exact_log_prob(x, steps=100)
    torch.testing.assert_close(exact.log_prob, DATA.log_prob(x), rtol=0, atol=2e-3)
    assert (exact.standard_error == 0).all()
    assert module.distribution(parameters(40)).exact_log_prob(x, steps=2, probes=1).standard_error.isnan().all()
    with pytest.raises(ValueError, match="steps is 0"):
        module.distribution(parameters(40)).exact_log_prob(x, steps=0)
    estimate = module.distribution(parameters(40)).exact_log_prob(x, steps=100, probes=64)
    score = (estimate.log_prob - exact.log_prob) / estimate.standard_error
    assert score.square().mean().sqrt() < 1.5
    assert score.abs().max() < 5


@pytest.mark.parametrize("spec", [Diffusion(sampler="ancestral", steps=400), Diffusion(), FlowMatching()])
def test_draws_follow_the_distribution(spec):
    module, parameters = build(spec)
    draws = module.distribution(parameters(20_000)).sample()
    torch.testing.assert_close(draws.mean(0), LOCATION, rtol=0, atol=0.04)
    torch.testing.assert_close(draws.mT.cov(), COVARIANCE, rtol=0, atol=0.06)
    torch.testing.assert_close(module.mean(parameters(1))[0].detach(), LOCATION, rtol=0, atol=0.02)


def test_pure_noise_is_no_data_in_single_precision():
    """float32(pi / 2) is above pi / 2, so its tangent is negative."""
    module, _ = build(FlowMatching())
    angle = module.angle(torch.ones(1, 1))
    assert angle.tan() < 0
    torch.testing.assert_close(embed_level(angle), embed_level(angle.double()).float())
    assert embed_level(module.angle(torch.zeros(1, 1)))[0, 0] < 0 < embed_level(angle)[0, 0]


def test_the_multistep_sampler_extrapolates_by_half_the_ratio_of_its_steps():
    """Lu et al., 2022: D = u + (u - earlier) / (2 r) with r = h_{i-1} / h_i, the steps of log(cos / sin)."""
    levels = torch.tensor([1.5, 1.2, 0.5, 0.4, 0.1], dtype=torch.float64)
    signal = (levels.cos() / levels.sin()).log()
    expected = [0.0] + [float((signal[i + 1] - signal[i]) / (signal[i] - signal[i - 1]) / 2) for i in (1, 2, 3)]
    torch.testing.assert_close(_extrapolation(levels), torch.tensor(expected, dtype=torch.float64))
    assert _extrapolation(torch.tensor([1.0, 0.5, 0.0]))[-1] == 0
    assert _extrapolation(torch.tensor([1.0, 0.5])).tolist() == [0.0]


@pytest.mark.parametrize(("spec", "steps"), [(Diffusion(), (20, 40)), (FlowMatching(), (80, 160))])
def test_second_order_samplers_converge_faster_than_ddim(spec, steps):
    noise = torch.randn(200, 2, dtype=torch.float64)

    def draws(sampler, steps):
        module, parameters = build(replace(spec, sampler=sampler, steps=steps))
        return module.draw(parameters(200), noise)

    limit = draws("heun", 1000)
    first, *others = (
        [(draws(sampler, n) - limit).square().mean().sqrt() for n in steps] for sampler in ("ddim", "dpm", "heun")
    )
    assert 1.6 < first[0] / first[1] < 2.5
    for errors in others:
        assert errors[0] / errors[1] > 3


@pytest.mark.parametrize("spec", [Diffusion(), FlowMatching(), Diffusion(steps=30)], ids=["40", "flow", "30"])
def test_draws_of_an_exact_denoiser_have_the_deviation_of_the_data(spec):
    """With a normal distribution as data, the best denoiser is known, and draws are linear in the noise."""
    module = spec.build(Shape(5)).double()
    scale = torch.tensor([0.1, 0.2, 0.3, 1.0, 3.0], dtype=torch.float64)

    class Exact(torch.nn.Module):
        def forward(self, z, angle, features):
            return angle.sin() * angle.cos() * z * (1 - scale**2) / ((scale * angle.cos()) ** 2 + angle.sin() ** 2)

    module.denoiser = Exact()
    loc, one = torch.zeros(1, 5, dtype=torch.float64), torch.ones(1, 5, dtype=torch.float64)
    start = module.sampler_angles(torch.ones((), dtype=torch.float64))
    noise = ((scale * start.cos()) ** 2 + start.sin() ** 2).sqrt()[None]  # one deviation at the highest level
    drawn = module.draw((loc, one, loc[:, :0]), noise)
    torch.testing.assert_close(drawn, scale[None], rtol=0.035, atol=0)


def test_without_a_denoiser_it_is_a_normal_distribution():
    module = Diffusion().build(Shape(2, 3)).double()
    torch.nn.init.zeros_(module.denoiser.out.weight)
    torch.nn.init.zeros_(module.denoiser.out.bias)
    parameters = module(torch.randn(6, 3, dtype=torch.float64))
    x, normal = torch.randn(6, 2, dtype=torch.float64), torch.distributions.Normal(*parameters[:2])
    torch.testing.assert_close(
        module.distribution(parameters).log_prob(x), normal.log_prob(x).sum(-1), rtol=0, atol=1e-3
    )


def test_a_change_of_unit_changes_the_density_by_its_jacobian():
    module, x = Diffusion().build(Shape(2, 3)).double(), torch.randn(6, 2, dtype=torch.float64)
    mean, scale = torch.tensor([5.0, -1.0]).double(), torch.tensor([0.1, 30.0]).double()
    parameters = module(torch.randn(6, 3, dtype=torch.float64))
    rescaled, noise = module.rescale(parameters, mean, scale), torch.randn_like(x)
    expected = module.distribution(parameters).exact_log_prob(x).log_prob - scale.log().sum()
    torch.testing.assert_close(module.distribution(rescaled).exact_log_prob(mean + scale * x).log_prob, expected)
    torch.testing.assert_close(module.draw(rescaled, noise), mean + scale * module.draw(parameters, noise))


def bimodal(n):
    """Return draws (n, 1, 1) around -1 and 1, three in ten around -1."""
    signs = torch.where(torch.rand(n, 1, 1) < 0.3, -1.0, 1.0)
    return signs + 0.1 * torch.randn(n, 1, 1)


VELOCITY = Diffusion(hidden=(32, 32), schedule="cosine", loss="velocity")


def test_the_loss_of_v_trains_location_and_scale_by_the_normal_density():
    module = VELOCITY.build(Shape(2, 3)).double()
    features, x = torch.randn(6, 3, dtype=torch.float64), torch.randn(6, 2, dtype=torch.float64)
    gradients = []
    for density in (
        module.distribution,
        lambda p: torch.distributions.Independent(torch.distributions.Normal(*p[:2]), 1),
    ):
        gradients.append(torch.autograd.grad(density(module(features)).log_prob(x).sum(), module.out.weight)[0])
    torch.testing.assert_close(*gradients)
    assert (module.train().present_density, module.eval().present_density) == ("loss", "bound")


@pytest.mark.parametrize("name", ["z", "x"])
def test_a_density_that_is_trained_as_a_loss_is_refused_where_a_density_is_needed(name):
    spec = VELOCITY if name == "z" else Product((((0,), VELOCITY), ((1,), Normal())))
    with pytest.raises(ValueError, match=r"loss in place of a density|has no density"):
        dvae.DynamicalVAE("p(z_t) p(x_t | z_t)", "q(z_t | x_t)", {"z": 2, "x": 2}, distributions={f"p({name})": spec})


@pytest.mark.parametrize("spec", [Diffusion(hidden=(32, 32)), VELOCITY, FlowMatching(hidden=(32, 32))])
def test_training_keeps_the_mass_of_both_modes(spec):
    model = dvae.DynamicalVAE("p(x_t)", "", {"x": 1}, distributions={"p(x)": spec})
    optimiser = torch.optim.Adam(model.parameters(), lr=4e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.0, 1500)
    head = model.generator["x"].head
    for _ in range(1500):
        optimiser.zero_grad()
        (-head.distribution(head(torch.empty(512, 0))).log_prob(bimodal(512)[:, 0]).mean()).backward()
        optimiser.step()
        schedule.step()
    draws = model.eval().sample(2000, length=1)["x"].flatten()
    assert (draws < 0).float().mean() == pytest.approx(0.3, abs=0.05)
    assert ((draws.abs() - 1).abs() < 0.4).float().mean() > 0.95
    x = bimodal(400)
    parts = torch.distributions.Normal(torch.tensor([-1.0, 1.0]), 0.1).log_prob(x) + torch.tensor([0.3, 0.7]).log()
    truth = parts.logsumexp(-1).mean()
    density = model.rollout(x).evaluate("x", x).exact_log_prob(x).log_prob.mean()
    assert density == pytest.approx(truth.item(), abs=0.2)
    if model.likelihood:
        terms = dvae.SequenceELBO(num_particles=20).terms(model, x)
        assert terms.bounded == ("x",)
        assert terms.bound.mean() < truth + 0.1


def freeze(model):
    """Replace the random levels and noise of every denoiser by functions of the value, so that scores can be compared.

    The functions keep gradients. All steps that are denoised jointly have the same level.
    """
    for conditional in model.generator.values():
        head = conditional.head

        def perturb(u, joint=conditional.joint):
            times = 0.5 + 0.4 * (2 * u.sum(-1, keepdim=True)).sin()
            return torch.full_like(times[..., :1, :], 0.4) if joint else times, (3 * u).sin()

        if hasattr(head, "perturb"):
            head.perturb = perturb
    return model


class TestAllGenerativeFactorsAreDiffusions(FactorizationContract):
    """Static prior, transition and emission."""

    missing = {}  # noqa: RUF012
    training_steps = 20

    def build(self, size):
        spec = Diffusion(hidden=(4,), steps=3)
        return freeze(
            dvae.DynamicalVAE(
                "p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)",
                "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{t:T}, w)",
                {"w": size, "z": size, "x": size},
                network=Recurrent(width=5),
                distributions={"p(w)": spec, "p": spec},
            )
        )


class TestItsEmissionReadsItsOwnPast(FactorizationContract):
    """An emission with a residual and a fixed schedule."""

    training_steps = 20

    def build(self, size):
        spec = Diffusion(hidden=(4,), steps=3, residual=1.0, schedule="cosine")
        pair = "p(z_t | z_{t-1}) p(x_t | x_{<t}, z_t)", "q(z_t | x_{1:T})"
        sizes = {"z": size, "x": size}
        return freeze(dvae.DynamicalVAE(*pair, sizes, network=Recurrent(width=5), distributions={"p(x)": spec}))


class TestItsEmissionIsTrainedByFlowMatching(FactorizationContract):
    """The loss is declared a density here, so that every test of a density applies to it."""

    training_steps = 20

    def build(self, size):
        pair, spec = ("p(w) p(x_t | x_{<t}, w)", "q(w | x_{1:T})"), FlowMatching(hidden=(4,), steps=3)
        sizes = {"w": size, "x": size}
        model = freeze(dvae.DynamicalVAE(*pair, sizes, network=Recurrent(width=5), distributions={"p(x)": spec}))
        model.generator["x"].head.density = "exact"
        return model


class OneDistributionOfAllSteps(FactorizationContract):
    """Base of contracts of emissions that are drawn jointly."""

    training_steps = 20
    spec = Diffusion(denoiser=JOINT, steps=3)

    def test_the_log_joint_is_that_of_the_per_step_program(self):
        pytest.skip("the shares of the steps in a joint bound are not conditional densities")

    def test_every_size_may_be_one(self):
        model = self._model(1)
        data = self._data(model, 1, 1)
        assert dvae.SequenceELBO().terms(model, data).bound.isfinite().all()
        context = {name: data[name] for name in model.context}
        assert model.sample(1, length=1, batch=context)["x"].isfinite().all()

    def test_a_bound_stays_on_its_device(self):
        """As in the contract, with draws in place of a forecast given past steps."""
        model = self._model()
        data = self._data(model)
        with on_device() as traffic:
            move(model)
            device_data = {name: value.to("cuda") for name, value in data.items()}
            for _ in range(2):
                traffic.clear()
                dvae.SequenceELBO().terms(model, device_data).bound.sum().backward()
            assert not traffic.uploads
            model.sample(batch={name: device_data[name] for name in model.context}, length=4)

    def test_training_stays_finite(self):
        pytest.skip("this test forecasts given past steps, which a distribution of all steps does not support")


@pytest.mark.parametrize("network", [SelfAttention(width=8, heads=2), Recurrent(width=4)])
def test_cosine_coefficients_are_another_basis_of_the_same_noise(network):
    """Padding changes nothing, and the basis of each sequence is orthonormal."""
    spec = Diffusion(denoiser=Denoiser(network, basis="cosine"), steps=2)
    model = freeze(dvae.DynamicalVAE("p(x_{1:T})", "", {"x": 2}, distributions={"p(x)": spec}).double())
    x, lengths = torch.randn(3, 5, 2).double(), torch.tensor([5, 3, 1])
    logs = model.log_joint({"x": x, "lengths": lengths}, {})["x"]
    for i, n in enumerate(lengths):
        torch.testing.assert_close(logs[i : i + 1], model.log_joint(x[i : i + 1, :n], {})["x"])
    identity = (torch.arange(5) < lengths[:, None]).double().diag_embed()
    for basis in BASES.values():
        matrix = basis(lengths, 5, torch.float64)
        torch.testing.assert_close(matrix @ matrix.mT, identity, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", BASES)
def test_coefficients_that_the_network_does_not_change_are_independent_normal_variables(name):
    spec = Diffusion(denoiser=Denoiser(basis=name, coefficients=2), log_snr=(-16.0, 16.0))
    model = dvae.DynamicalVAE("p(x_{1:T})", "", {"x": 2}, distributions={"p(x)": spec}).double()
    denoiser = model.generator["x"].head.denoiser
    for parameter in denoiser.out.parameters():
        torch.nn.init.zeros_(parameter)
    denoiser.log_scale.data = torch.tensor([0.3, -0.2]).double()
    x = torch.randn(3, 5, 2).double()
    rollout = model.rollout(x)
    loc, scale, *_ = rollout.parameters("x", x)
    deviations = torch.exp(denoiser.log_scale - denoiser.slope * torch.arange(1, 6).log()[:, None])
    basis = BASES[name](torch.tensor([5]), 5, torch.float64)
    coefficients = torch.distributions.Normal(0.0, deviations).log_prob(basis @ ((x - loc) / scale))
    exact = rollout.evaluate("x", x).exact_log_prob(x, steps=200).log_prob
    torch.testing.assert_close(exact, (coefficients - scale.log()).sum((1, 2)).detach(), rtol=0, atol=2e-3)


class TestItsEmissionIsOneDiffusion(OneDistributionOfAllSteps):
    """p(w) p(x_{1:T} | w, h)."""

    missing = {}  # noqa: RUF012

    def build(self, size):
        pair = "p(w) p(x_{1:T} | w, h)", "q(w | x_{1:T}, h)"
        distributions = {"p(x)": self.spec}
        sizes = {"w": size, "x": size, "h": size}
        return freeze(dvae.DynamicalVAE(*pair, sizes, network=Recurrent(width=5), distributions=distributions))


class TestItsLatentsAreOneDiffusion(OneDistributionOfAllSteps):
    """A prior of all steps of a latent, given a static latent with a prior of its own."""

    def build(self, size):
        pair = "p(w) p(z_{1:T} | w) p(x_t | z_t)", "q(w | x_{1:T}) q(z_t | z_{t-1}, x_{t:T}, w)"
        distributions = {"p(w)": Diffusion(hidden=(4,), steps=3), "p(z)": self.spec}
        sizes = {"w": size, "z": size, "x": size}
        return freeze(dvae.DynamicalVAE(*pair, sizes, network=Recurrent(width=5), distributions=distributions))


@pytest.mark.parametrize("network", [Attention(8, 2), SelfAttention(8, 2), Recurrent(width=8)])
@pytest.mark.parametrize(("steps", "causal"), [("{<=t}", True), ("{1:T}", False)])
def test_the_masks_hold_at_every_level_and_for_draws(network, steps, causal):
    factor = f"p(x_t | x_{{<t}}, h_{steps})"
    distributions = {"p(x)": Diffusion(denoiser=Denoiser(network), steps=3)}
    model = dvae.DynamicalVAE(factor, "", {"x": 2, "h": 1}, Attention(8, 2), distributions).double()
    z, noise, h = torch.randn(1, 5, 2).double(), torch.randn(1, 5, 2).double(), torch.randn(1, 5, 1).double()
    conditional = model.generator["x"]

    def depends(function, value):
        jacobian = torch.autograd.functional.jacobian(function, value)  # (1, T, D, 1, S, D)
        return (jacobian != 0).any(-1).any(2)[0, :, 0]

    expected = torch.ones(5, 5).bool().tril() if causal else torch.ones(5, 5).bool()
    for angle in (0.01, 0.8, 1.55):
        level = torch.full((1, 1, 1), angle).double()

        def velocity(h, z=z, level=level):
            _, _, features, observed = conditional({"h": h}, 1, 5)
            return conditional.head.denoiser(z, level, features, observed)

        assert torch.equal(depends(velocity, h), expected)
        assert torch.equal(depends(lambda z: velocity(h, z), z), expected)
    assert torch.equal(depends(lambda h: conditional.draw(conditional({"h": h}, 1, 5), noise), h), expected)


@pytest.mark.parametrize("kind", [Diffusion, FlowMatching])
def test_missing_steps_and_padding_change_nothing_else(kind):
    spec = kind(denoiser=JOINT, steps=2)
    model = freeze(dvae.DynamicalVAE("p(x_{1:T} | s)", "", {"x": 2, "s": 1}, distributions={"p(x)": spec}).double())
    x, s = torch.randn(2, 5, 2).double(), torch.randn(2, 1).double()

    def score(x, **options):
        terms = dvae.SequenceELBO().terms(model, {"x": x, "s": s, **options})
        return (terms.log_likelihood | terms.energies)["x"]

    ragged = x.clone()
    ragged[:, 3:] = math.nan
    torch.testing.assert_close(score(ragged, lengths=torch.tensor([3, 3])), score(x[:, :3]))
    mask = torch.ones_like(x).bool()
    mask[:, 1] = False
    hidden = torch.where(mask, x, math.nan)
    other = torch.where(mask, x, 7.0)
    torch.testing.assert_close(score(hidden, mask=mask), score(other, mask=mask))
    assert not torch.allclose(score(hidden, mask=mask), score(x))
    run = model.rollout({"x": other, "s": s, "mask": mask})
    value = run.values["x"]
    density = run.evaluate("x", value).exact_log_prob(value, steps=5)
    assert density.log_prob.shape == (2,)
    for draw in (True, False):
        with pytest.raises(ValueError, match="cannot be imputed"):
            model.impute({"x": other, "s": s, "mask": mask}, draw=draw)
    with pytest.raises(ValueError, match="jointly, and not given some"):
        model.forecast({"x": x, "s": s}, 2)


def test_a_predictor_forecasts_whole_futures():
    pair, spec = ("p(x_{1:T} | s)", ""), Diffusion(denoiser=JOINT, steps=2)
    view = dvae.data.views.Past("s", 3)
    model = dvae.DynamicalVAE(*pair, {"x": 2, "s": 6}, distributions={"p(x)": spec}, view=view)
    assert model.forecast(torch.randn(4, 3, 2), 5, samples=2)["x"].shape == (2, 4, 5, 2)
    latent = dvae.DynamicalVAE(
        "p(w) p(x_{1:T} | w, s)", "q(w | x_{1:T}, s)", {"w": 1, "x": 2, "s": 6}, distributions={"p(x)": spec}, view=view
    )
    windows = dvae.ArrayWindows(torch.randn(6, 8, 2), observed=3)
    for each in (model, latent):
        with pytest.raises(ValueError, match="stochastic lower bound"):
            dvae.iwae_bound(each, torch.randn(4, 8, 2))
    plain = dvae.DynamicalVAE("p(x_t | s)", "", {"x": 2, "s": 6}, view=view)
    models = {"model": freeze(model), "latent": latent, "plain": plain}
    scores = dvae.evaluate(models, windows, samples=3, bound_particles=4, progress=False)
    assert {name for name in models if "IWAE bound" in scores[name]} == {"plain"}
    assert {name for name in models if "k-hat" in scores[name]} == {"plain"}
    result = dvae.compare(models, windows, particles=4, contrasts=0, samples=2, progress=False)
    assert result.particles == 1
    for name in models:
        assert math.isnan(result.rows[name].unreliable) == (name != "plain")
        assert any("stochastic lower bound" in note for note in result.rows[name].notes) == (name != "plain")
    assert scores["model"]["ELBO"].mean == pytest.approx(result["model"]["IWAE bound"].mean)
    assert len([note for note in scores.notes if "stochastic lower bound" in note]) == 2


def test_the_log_score_of_one_factor_is_its_density():
    spec, view = Diffusion(denoiser=JOINT, steps=2), dvae.data.views.Past("s", 3)
    whole = dvae.DynamicalVAE("p(x_{1:T} | s)", "", {"x": 2, "s": 6}, distributions={"p(x)": spec}, view=view)
    step, flow = (
        dvae.DynamicalVAE("p(x_t | x_{<t})", "", {"x": 2}, distributions={"p(x)": each})
        for each in (Diffusion(hidden=(4,)), FlowMatching(hidden=(4,)))
    )
    x = torch.randn(4, 8, 2)
    for model, given in ((whole, {"x": x[:, 3:], "s": x[:, :3].flatten(1)}), (step, {"x": x}), (flow, {"x": x})):
        run = model.rollout(given)
        density = run.evaluate("x", given["x"]).exact_log_prob(given["x"]).log_prob
        expected = density if model is whole else density[:, 3:].sum(1)
        torch.testing.assert_close(predictive_bound(model, x, 3).bound, expected)
    joint = dvae.DynamicalVAE("p(x_{1:T})", "", {"x": 2}, distributions={"p(x)": spec})
    with pytest.raises(ValueError, match="make the past context"):
        predictive_bound(joint, x, 3)
    row = dvae.evaluate({"flow": flow}, dvae.ArrayWindows(x, observed=3), samples=2, log_score_particles=1)["flow"]
    assert row["log score"].mean == pytest.approx(predictive_bound(flow, x, 3).bound.mean().item() / 5)
    assert "ELBO" not in row
    guided = Diffusion(hidden=(4,), drop=0.1, guidance=2.0)
    with pytest.raises(ValueError, match=r"guidance=2.0 do not follow a known density; omit the log score"):
        predictive_bound(dvae.DynamicalVAE("p(x_t | x_{<t})", "", {"x": 2}, distributions={"p(x)": guided}), x, 3)


@pytest.mark.parametrize("spec", [Diffusion(hidden=(4,)), FlowMatching(hidden=(4,))])
def test_a_random_energy_has_no_mode(spec):
    model = dvae.DynamicalVAE("p(w) p(x_t | w)", "q(w | x_{1:T})", {"w": 1, "x": 2}, distributions={"p(x)": spec})
    with pytest.raises(ValueError, match="x has a random bound or loss"):
        dvae.posterior(model.model, {"x": torch.randn(2, 4, 2)})


def test_per_step_emissions_forecast_and_impute():
    for spec in (Diffusion(hidden=(4,), steps=2), FlowMatching(hidden=(4,), steps=2)):
        model = dvae.DynamicalVAE("p(x_t | x_{<t})", "", {"x": 2}, distributions={"p(x)": spec})
        x, mask = torch.randn(3, 6, 2), torch.ones(3, 6, 2).bool()
        assert model.forecast(x, 3, samples=2)["x"].shape == (2, 3, 3, 2)
        mask[:, 2] = False
        filled = model.impute({"x": x, "mask": mask}, samples=2)["x"]
        assert torch.equal(filled[:, mask], x[mask].expand(2, -1))
        assert (filled[0, :, 2] != filled[1, :, 2]).all()


def test_motion_is_completed_along_paths_and_parts_are_controlled():
    torch.manual_seed(0)
    spec = {"denoiser": Denoiser(SelfAttention(16, 2)), "steps": 4}
    path = torch.randn(600, 5, 1).cumsum(1)
    x = torch.cat([path, -path], 2) + 0.1 * torch.randn(600, 5, 2)
    options = {"steps": 100, "learning_rate": 5e-3, "decay": 0.5, "progress": False}
    pair, sizes = ("p(x_{1:T} | y_{1:T})", ""), {"x": 2, "y": 1}
    along = dvae.DynamicalVAE(*pair, sizes, distributions=Diffusion(**spec))
    dvae.fit(along, {"x": x[:500], "y": path[:500]}, **options)
    drawn = along.sample(length=5, batch={"y": path[500:]})["x"]
    error, other = (drawn - x[500:]).square().mean(), (drawn - x[500:].roll(1, 0)).square().mean()
    assert error < 0.2 * other
    parts = dvae.DynamicalVAE(
        "p(lower_{1:T}) p(upper_{1:T} | lower_{1:T})",
        "",
        {"lower": 1, "upper": 1},
        observed=("lower", "upper"),
        distributions=Diffusion(**spec),
    )
    dvae.fit(parts, {"lower": x[:500, :, :1], "upper": x[:500, :, 1:]}, **options)
    lower = x[500:, :, :1]
    upper = poutine.condition(parts.model, data={"lower": lower})({}, length=5, size=100)["upper"]
    assert (upper + lower).square().mean() < 0.2 * (upper + lower.roll(1, 0)).square().mean()


def test_guidance_moves_draws_away_from_the_unconditional_denoiser():
    spec = Diffusion(drop=0.5, guidance=1.0, steps=5)
    plain, guided = spec.build(Shape(2, 3)), Diffusion(drop=0.5, guidance=3.0, steps=5).build(Shape(2, 3))
    guided.load_state_dict(plain.state_dict())
    parameters, noise = plain(torch.randn(6, 3)), torch.randn(6, 2)
    hidden = (*parameters[:2], torch.zeros_like(parameters[2]))
    assert not torch.allclose(plain.draw(parameters, noise), guided.draw(parameters, noise))
    torch.testing.assert_close(plain.draw(hidden, noise), guided.draw(hidden, noise))
    loc = plain(torch.randn(6, 3))[0]
    assert torch.equal(loc[:1].expand_as(loc), loc)  # otherwise location and scale would reveal the parents


def test_a_loss_is_an_energy_and_has_no_bound():
    spec = FlowMatching(hidden=(4,))
    model = dvae.DynamicalVAE("p(z) p(x_t | z)", "q(z | x_{1:T})", {"z": 1, "x": 2}, distributions={"p(x)": spec})
    terms = dvae.SequenceELBO().terms(model, torch.randn(3, 4, 2))
    assert not model.likelihood
    assert not terms.likelihood
    assert (terms.energies["x"] > 0).all()
    with pytest.raises(ValueError, match="no log joint"):
        model.log_joint(torch.randn(3, 4, 2), {"z": torch.randn(3, 1)})


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Diffusion(steps=0).build(Shape(2)), "steps is 0; it must be at least 1"),
        (lambda: Diffusion(min_scale=0.0).build(Shape(2)), "min_scale is 0.0; it must be finite and above 0"),
        (
            lambda: joint("p(z) p(x_{1:T} | z)", "q(z | x_{1:T})").forecast(torch.randn(1, 3, 2), 2),
            "so the model cannot forecast",
        ),
        (lambda: Diffusion(schedule="linear").build(Shape(2)), "schedule"),
        (lambda: Diffusion(shift=1.0).build(Shape(2)), "a learned schedule has none"),
        (lambda: Diffusion(loss="velocity").build(Shape(2)), "'velocity' with schedule='cosine'"),
        (lambda: Diffusion(log_snr=(3.0, 1.0)).build(Shape(2)), "increasing"),
        (lambda: Diffusion(guidance=2.0).build(Shape(2, 1)), "set `drop` above 0"),
        (lambda: Diffusion(drop=0.1).build(Shape(2)), "no parents"),
        (lambda: FlowMatching(sampler="ancestral").build(Shape(2)), "'ddim', 'dpm' or 'heun'"),
        (lambda: Diffusion(denoiser=JOINT).build(Shape(2)), "denoiser=None"),
        (lambda: joint("p(x_t | x_{<t}, z_{<=t}) p(z_t)", "q(z_t | x_{1:T})", COSINE), "basis=None"),
        (lambda: Product([((0,), FlowMatching()), ((1,), Normal())]).build(Shape(2)), "no density"),
        (lambda: joint("p(x_t | z_t) p(z_t)", "q(z_t | x_{1:T})"), "needs a factor such as"),
        (lambda: joint("p(x_t | x_{<t}, z_t) p(z_t)", "q(z_t | x_{1:T})"), "needs a factor such as"),
        (lambda: joint("p(z) p(x_t | z)", "q(z | x_{1:T})", {"q(z)": Diffusion()}), "bound in place of a density"),
        (lambda: joint("p(z) p(x_t | z)", "q(z | x_{1:T})", {"p(z)": FlowMatching()}), "loss in place of a density"),
        (
            lambda: switching(Diffusion()),
            r"p\(x_t \| k_t\) has a bound in place of a density, so k cannot be summed out",
        ),
        (lambda: switching(FlowMatching()), "loss in place of a density, so k cannot be summed out"),
    ],
)
def test_mistakes_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_network_is_not_a_denoiser():
    with pytest.raises(TypeError, match="tuple of widths"):
        Diffusion(hidden=32).build(Shape(2))
    with pytest.raises(TypeError, match="such as networks"):
        joint("p(z) p(x_{1:T} | z)", "q(z | x_{1:T})", {"p(x)": Diffusion(denoiser=SelfAttention())})


def test_one_diffusion_is_the_prior_of_a_latent_sequence():
    pair, spec = ("p(z_{1:T}) p(x_t | z_t)", "q(z_t | x_{1:T})"), Diffusion(denoiser=JOINT, steps=2)
    model = dvae.DynamicalVAE(*pair, {"z": 2, "x": 3}, distributions={"p(z)": spec})
    terms = dvae.SequenceELBO().terms(model, torch.randn(3, 5, 3))
    assert terms.bounded == ("z",)
    assert terms.kl["z"].isfinite().all()
    assert model.sample(2, length=4)["x"].shape == (2, 4, 3)


def joint(generative, inference, distributions=None):
    distributions = distributions or {"p(x)": Diffusion(denoiser=JOINT)}
    return dvae.DynamicalVAE(generative, inference, {"x": 2, "z": 1}, distributions=distributions)


def switching(emission):
    sizes = {"k": dvae.Discrete(2), "x": 1}
    return dvae.DynamicalVAE("p(k_t | k_{t-1}) p(x_t | k_t)", "", sizes, distributions={"p(x)": emission})
