"""GSPS: its factorization, energies, control of parts, forecasts and runs."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from pyro import poutine

import dvae
from dvae import motion
from dvae.inference.evaluation.metrics import average_pairwise_distance
from dvae.models.motion.gsps import PRESETS, GSPSModel, part_by_part
from dvae.models.registry import metric_model
from dvae.motion.data.protocols import Poses
from dvae.motion.geometry.parts import body_parts
from dvae.motion.scoring import energies
from dvae.networks import GraphConv
from dvae.runs import directory as runs
from dvae.testing import FactorizationContract

SMALL = {"latent": 3, "coefficients": 4, "width": 6, "blocks": 1, "draws": (3, 2), "pose_prior": 0.0}
FIVE = ("torso", "right_leg", "left_leg", "right_arm", "left_arm")


@pytest.fixture(scope="module")
def prior_run(walkers, tmp_path_factory):
    """Return the folder of a pose prior's run of two steps."""
    out = tmp_path_factory.mktemp("prior") / "run"
    method = metric_model("pose-prior", heading=True)
    dvae.fit(method, walkers, out=out, **vars(dvae.Training(steps=2, progress=False, accelerator="cpu")))
    return str(out)


def build(windows, **options):
    method = dvae.method("gsps", **{**SMALL, **options}).resolve_defaults(windows)
    return method.build(windows).double()


def batch(windows, size=4):
    method = dvae.method("gsps", **SMALL)
    sample = method.train(windows).batches.sample(size, torch.Generator().manual_seed(0))
    return {name: v.double() if v.is_floating_point() else v for name, v in sample.items()}


# ------------------------------------------------------------------------------------------------- factorization


def test_the_equations_are_those_of_the_paper():
    model, guide = dvae.method("gsps").equations()
    assert model.text == "p(a) p(lower_t | h_{1:O}, a) p(b) p(upper_t | h_{1:O}, lower_{1:T}, b)"
    assert guide.text == "q(a) q(b)"
    assert (dvae.methods()["gsps"].generative, dvae.methods()["gsps"].inference) == (model.text, guide.text)


@pytest.mark.parametrize(
    ("skeleton", "observed", "length", "parameters"),
    [(motion.HUMAN36M, 25, 125, 1_298_108), (motion.HUMANEVA, 15, 75, None)],
)
def test_the_model_has_the_published_number_of_parameters(skeleton, observed, length, parameters):
    method = dvae.method("gsps", **PRESETS[skeleton.name])
    model = GSPSModel(method, skeleton, observed, length)
    prior = {"human36m": 13_970, "humaneva": 10_710 + 2}[skeleton.name]  # 10,710 omits the two slopes
    assert sum(p.numel() for p in model.pose_prior.parameters()) == prior
    generator = sum(p.numel() for p in model.parameters()) - prior
    nodes, width, into = skeleton.joints - 1, 256, 3 * method.coefficients + 64
    layers = into * width + width + nodes**2 + 8 * (width**2 + nodes**2) + width * into + into + nodes**2
    assert generator == 2 * (layers + 9 * 2 * nodes * width)
    assert parameters in (None, generator)


@pytest.mark.parametrize(
    ("protocol", "skeleton", "options", "count"),
    [
        ("h36m", motion.HUMAN36M, {}, 10),
        ("h36m", motion.HUMAN36M, {"coefficients": "code"}, 10),
        ("h36m", motion.HUMAN36M, {"coefficients": "supplement"}, 20),
        ("h36m", motion.HUMAN36M, {"bandwidth": 1.8}, 10),
        ("h36m", motion.HUMAN36M, {"bandwidth": 3.8}, 20),
        ("humaneva", motion.HUMANEVA, {}, 8),
        ("humaneva", motion.HUMANEVA, {"coefficients": "supplement"}, 8),
        ("humaneva", motion.HUMANEVA, {"bandwidth": 2.8}, 8),
        ("simulated", motion.WALKER, {}, 15),
        ("simulated", motion.WALKER, {"bandwidth": 1.4}, 8),
        ("simulated", motion.WALKER, {"bandwidth": 15.0}, 75),
        ("simulated", motion.WALKER, {"coefficients": 12}, 12),
    ],
)
@pytest.mark.parametrize("name", ["gsps", "bom-parts"])
def test_the_number_of_coefficients_is_published_or_reaches_a_bandwidth(name, protocol, skeleton, options, count):
    schema = Poses.from_data(motion.PROTOCOLS[protocol], skeleton)
    method = dvae.method(name, **options).resolve_defaults(schema)
    assert (method.coefficients, method.bandwidth) == (count, None)
    assert method.resolve_defaults(schema) == method
    if "bandwidth" in options:
        frequencies = torch.arange(schema.frames + 1) * schema.protocol.fps / (2 * schema.frames)
        below = frequencies[: schema.frames] <= options["bandwidth"] + 1e-6
        assert below.sum() == count


def test_numbers_of_coefficients_that_do_not_exist_are_errors():
    walker = Poses.from_data(motion.PROTOCOLS["simulated"], motion.WALKER)
    with pytest.raises(ValueError, match="numbers for human36m and humaneva, not for the skeleton 'walker'"):
        dvae.method("gsps", coefficients="supplement").resolve_defaults(walker)
    with pytest.raises(ValueError, match=r"coefficients is 8 and bandwidth is 2\.8; give only one"):
        dvae.method("gsps", coefficients=8, bandwidth=2.8)
    with pytest.raises(ValueError, match="bandwidth is 16 Hz, but 30 frames per second contain frequencies up to 15"):
        dvae.method("gsps", bandwidth=16.0).resolve_defaults(walker)


def test_gradients_are_clipped_as_those_of_the_published_loss(windows):
    """A step with the clip of the presets moves weights as the public code does: norm 100 of weighted means over B."""
    for name, skeleton in (("h36m", motion.HUMAN36M), ("humaneva", motion.HUMANEVA)):
        protocol = motion.PROTOCOLS[name]
        for length in (protocol.length, 50):
            clip = dvae.method("gsps").training(Poses.from_data(protocol, skeleton, length)).gradient_clip
            assert clip * length == pytest.approx(100)
    for name in ("", "walker"):
        poses = Poses.from_data(motion.PROTOCOLS["simulated"], replace(motion.WALKER, name=name))
        assert dvae.method("gsps").training(poses).gradient_clip == 10

    method = dvae.method("gsps", **SMALL).resolve_defaults(windows)  # windows of 75 frames
    objective, data, steps = method.objective(), batch(windows), {}
    for weight in (0.1, 10.0):  # a norm below the clip, and one above it
        weighted = replace(objective, energy_weights={key: weight * w for key, w in objective.energy_weights.items()})
        for limit in (None, 100 / 75):
            torch.manual_seed(0)
            loop = dvae.SVI(
                method.build(windows).double(), objective=weighted, optimizer="sgd", learning_rate=1.0,
                gradient_clip=limit, steps=1, precision="64-true", accelerator="cpu",
            )  # fmt: skip
            loop.init()
            before = [parameter.detach().clone() for parameter in loop.model.parameters()]
            terms = loop.step(data)
            published = sum(w * terms.energies[key].mean() for key, w in weighted.energy_weights.items())
            assert 75 * weighted(terms, 0) == pytest.approx(published.item(), rel=1e-6)  # terms are float32
            steps[limit] = [old - new.detach() for old, new in zip(before, loop.model.parameters(), strict=True)]
        weights = [torch.zeros_like(gradient).requires_grad_() for gradient in steps[None]]
        for parameter, gradient in zip(weights, steps[None], strict=True):
            parameter.grad = 75 * gradient  # of the published loss
        norm = torch.nn.utils.clip_grad_norm_(weights, max_norm=100)
        assert (norm > 100) == (weight > 1)
        for parameter, step in zip(weights, steps[100 / 75], strict=True):
            torch.testing.assert_close(75 * step, parameter.grad, rtol=1e-5, atol=1e-9)


def test_the_program_runs_in_pyro(windows):
    """A trace has minus the energies as factors, and draws only the latents."""
    model, data = build(windows).eval(), batch(windows)
    torch.manual_seed(0)
    trace = poutine.trace(model.model).get_trace(data)
    trace.compute_log_prob()
    latents = [n for n in trace.stochastic_nodes if not n.startswith("sequences") and n != "windows"]
    assert latents == ["a", "b"]
    truth = model.turned(data["x"])
    values = trace.nodes["_RETURN"]["value"]
    errors = energies.best_of_many(model.to_data_space(values)["x"].unflatten(0, (-1, 4))[:, :, 15:], truth[:, 15:])
    assert torch.allclose(trace.nodes["reconstruction"]["log_prob"], -errors, atol=1e-10)


def test_the_energies_equal_their_formulas(windows):
    """Each term is computed by its formula, in loops over all futures."""
    model, data = build(windows, heading=False, limb=1.0).eval(), batch(windows)
    values = model.to_data_space(model.model(data))
    x, S = data["x"], values["x"].unflatten(0, (-1, 4))
    terms = model.energies(values, x, data)
    future, truth = S[:, :, 15:], x[:, 15:]
    errors = (future - truth).square().sum((2, 3))
    assert torch.allclose(terms["reconstruction"], errors.min(0).values)
    pairs = [(b, m) for b in range(4) for m in range(10) if data["valid"][b, m]]
    best = [min((S[s, b, 15:] - data["pseudo"][b, m, 15:]).square().sum() for s in range(6)) for b, m in pairs]
    assert torch.allclose(terms["multimodal"].mean(), torch.stack(best).mean())
    assert torch.allclose(terms["history"].mean(), (S[:, :, :15] - x[:, :15]).square().sum(-1).mean())
    skeleton = windows.skeleton
    lengths, true_lengths = (skeleton.bone_lengths(windows.positions(v)) for v in (S, x[:, :1]))
    assert torch.allclose(terms["limb"].mean(), (lengths - true_lengths).square().sum(-1).mean())

    def similarity(motions, scale):
        distances = [(motions[i] - motions[j]).abs().sum() for i in range(len(motions)) for j in range(i)]
        return torch.stack([torch.exp(-distance / scale) for distance in distances]).mean()

    tree = {name: values[name].unflatten(0, (2, 3, 4))[..., 15:, :] for name in ("lower", "upper")}
    scales = model.method.diversity_scale
    lower = torch.stack([similarity(tree["lower"][0, :, b], scales[0]) for b in range(4)]).mean()
    upper = torch.stack([similarity(tree["upper"][:, i, b], scales[1]) for i in range(3) for b in range(4)]).mean()
    assert torch.allclose(terms["diversity_lower"].mean(), lower)
    assert torch.allclose(terms["diversity_upper"].mean(), upper)


# ------------------------------------------------------------------------------------------------ forecasts, control


def test_a_fixed_part_is_equal_in_all_futures_and_the_others_vary(windows):
    for heading in (False, True):
        model, past = build(windows, heading=heading), batch(windows)["x"][:, :15]
        free = model.forecast(past, 60, 4)
        fixed = model.forecast(past, 60, 5, fix={"lower": free["lower"][2]})
        assert torch.equal(fixed["lower"], free["lower"][2].expand(5, -1, -1, -1))
        assert torch.equal(fixed["x"][..., model.view.parts["lower"]], fixed["lower"])
        assert (average_pairwise_distance(fixed["lower"].movedim(0, 1)) == 0).all()
        assert (average_pairwise_distance(fixed["upper"].movedim(0, 1)) > 0).all()
        latent = model.forecast(past, 60, 5, fix={"a": free["a"][2]})
        assert torch.allclose(latent["lower"], fixed["lower"], atol=1e-12)


def test_gaps_of_the_past_are_interpolated_linearly(windows):
    model, past = build(windows, heading=True), batch(windows)["x"][:, :15]
    mask = torch.ones_like(past, dtype=torch.bool)
    mask[:, 3:9, 30:36] = False
    straight, share = past.clone(), torch.arange(1, 7)[:, None] / 7
    straight[:, 3:9, 30:36] = past[:, 2:3, 30:36].lerp(past[:, 9:10, 30:36], share.to(past))
    futures = []
    for observed in ({"x": past.masked_fill(~mask, torch.nan), "mask": mask}, straight):
        torch.manual_seed(0)
        futures.append(model.forecast(observed, 60, 2)["x"])
    torch.testing.assert_close(*futures)


def test_wrong_arguments_of_a_forecast_are_an_error(windows):
    model, x = build(windows), batch(windows)["x"]
    for horizon, fix, message in (
        (61, None, "frames"),
        (60, {"legs": x}, "cannot"),
        (5, {"lower": x[:, 15:20, :18]}, r"expected \(4, 60, 18\)"),
    ):
        with pytest.raises(ValueError, match=message):
            model.forecast(x[:, :15], horizon, fix=fix)
    with pytest.raises(ValueError, match="several"):
        body_parts(motion.WALKER, ("lower", "upper", "head=Head"))


# -------------------------------------------------------------------------------------------------------- training


def test_a_run_is_fitted_resumed_loaded_and_scored(tmp_path, walkers, prior_run):
    method = dvae.method("gsps", **{**SMALL, "pose_prior": 0.01, "pose_prior_run": prior_run, "draws": (2, 2)})
    options = {"batch_size": 4, "validate_every": 3, "progress": False, "accelerator": "cpu"}
    uninterrupted = dvae.fit(method, walkers, out=tmp_path / "whole", **vars(dvae.Training(steps=6, **options)))
    dvae.fit(method, walkers, out=tmp_path / "half", **vars(dvae.Training(steps=3, **options)))
    resumed = runs.resume(tmp_path / "half", steps=6, progress=False)
    losses = uninterrupted.series("validation/loss")[1]
    assert uninterrupted.best_bound == -min(losses)
    assert resumed.best_bound == uninterrupted.best_bound
    first, second = runs.load(tmp_path / "whole"), runs.load(tmp_path / "half")
    for (name, value), other_value in zip(
        first.model.state_dict().items(), second.model.state_dict().values(), strict=True
    ):
        assert torch.equal(value, other_value), name
    assert first.method == method.resolve_defaults(walkers.windows("train"))
    test = walkers.windows("test")
    prior = runs.load(prior_run).model
    measures = partial(motion.scores, pose_prior=prior)
    scores = dvae.evaluate({"gsps": first.model}, test, scores=measures, samples=3, progress=False)
    assert {"APD", "ADE", "MMADE", "pose NLL"} <= scores["gsps"].keys()
    assert not {"ELBO", "KL a"} & scores["gsps"].keys()
    last = motion.Heading(test.skeleton, 15).face(test.all()["x"])[:, 14:15]
    stays = energies.pose_prior_energy(last[None], prior, test.skeleton)
    assert scores["zero velocity"]["pose NLL"].mean == pytest.approx(stays.mean().item(), rel=1e-5)


@pytest.mark.parametrize("heading", [False, True])
def test_bones_of_futures_keep_the_observed_lengths(windows, heading):
    """This holds for any weights. Parts are coordinates of positions, and the first part may be fixed."""
    model = build(windows, bones=True, heading=heading, parts=FIVE, draws=(2,), diversity=(1.0,)).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    past = windows.all()["x"][:5, :15].double()

    def lengths(x):
        return windows.skeleton.bone_lengths(windows.positions(x))

    free = model.forecast(past, 60, 3)
    torch.testing.assert_close(lengths(free["x"]), lengths(past).mean(1)[:, None].expand(3, -1, 60, -1))
    first = next(iter(model.view.parts))
    assert torch.equal(free[first], free["x"][..., model.view.parts[first]])
    fixed = model.forecast(past, 60, 3, fix={first: free[first][0]})
    assert torch.equal(fixed[first], free[first][:1].expand(3, -1, -1, -1))
    torch.testing.assert_close(lengths(fixed["x"]), lengths(free["x"]))


# -------------------------------------------------------------------------------------------------------- contract


class TestTheFactorization(FactorizationContract):
    """GSPS's equations and networks, with a density for each part, as the contract requires."""

    steps = 6

    def build(self, size):
        joints = {"h": range(3), "lower": (0, 2), "upper": (1,)}
        return dvae.DynamicalVAE(
            part_by_part(["lower", "upper"], lambda _: 2),
            None,
            {"a": size, "b": size, "h": 9, "lower": 6, "upper": 3},
            {f"p({name})": GraphConv(joints, name, self.steps, 3, 5, 1) for name in ("lower", "upper")},
            {f"p({name})": dvae.distributions.FixedNormal(0.1, project=False) for name in ("lower", "upper")},
            observed=("lower", "upper"),
        )

    def data(self, size):
        sizes = {"h": 9, "lower": 6, "upper": 3}
        return {name: torch.randn(20, self.steps, size) for name, size in sizes.items()}

    test_every_size_may_be_one = test_padding_changes_nothing = None  # the networks output sequences of one length
    test_training_stays_finite = None  # forecasts need the full length; see the tests above
