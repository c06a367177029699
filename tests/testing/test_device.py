"""Steps and evaluations of every method on a GPU, or without one on a stand-in device."""

import warnings
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import ClassVar

import pytest
import torch
from lightning_fabric.accelerators import CPUAccelerator
from lightning_fabric.strategies import SingleDeviceStrategy
from torch.utils._pytree import tree_leaves

import dvae
from dvae import motion
from dvae.capture import WARM_UP, Captured
from dvae.data.batch import Batch
from dvae.distributions.chain import gaussian_chain
from dvae.distributions.kalman import LinearGaussianChain
from dvae.inference.bounds.predictive import predictive_bound
from dvae.inference.evaluation.evaluation_windows import on_device_of
from dvae.inference.training.checkpoints import Run
from dvae.inference.training.resuming import restore, store
from dvae.inference.training.svi import NonFiniteError
from dvae.models.motion.motion_latent import MotionLatent
from dvae.models.motion.trajectories import TrajectoryMethod
from dvae.models.registry import METHODS
from dvae.motion import bodies
from dvae.motion.segments.embodied import Segments
from dvae.testing.device import OnDevice, SameNoise, Tape, move, on_device

DENSE = {"latent": 4, "width": 8, "hidden": (8,)}
SMALL = {
    "hit-dvae": {"samples": 2, "width": 8, "heads_count": 2, "decoder": 8, "pose_width": 2, "pose_prior": 0.0},
    "gsps": {"width": 8, "blocks": 1, "draws": (2, 2), "coefficients": 4, "pose_prior": 0.0},
    "denoiser": {"width": 8, "heads_count": 2, "layers": 1, "coefficients": 4, "sampler_steps": 2},
    "csdi": {"width": 8, "heads_count": 2, "layers": 1, "sampler_steps": 2},
    "trajevae": {"width": 8, "feedforward": 8, "components": 4, "layers": 1},
    "erd": {"width": 4, "encoder": (5,), "decoder": (6,)},
    "aclstm": {"width": 4},
    "autoregressive": {"width": 4},
    "moglow": {"width": 4, "flow_steps": 1},
    "moglow-paths": {"width": 4, "flow_steps": 1},
    "cvae-rnn": {"latent": 4, "summary": 4, "width": 8, "hidden": (8,)},
    "motion-infilling": {"maps": (4, 6)},
    "mt-vae": {"latent": 4, "width": 8},
    "bom-parts": {"width": 8, "blocks": 1, "coefficients": 4},
    "mix-and-match": {"width": 8},
    "motion-latent": {"latent": 4, "widths": (8, 8)},
    "equations": {"latent": 4, "warm_up": 1, "width": 8},
    **dict.fromkeys(("cvae", "bom", "pose-knows", "rhp"), DENSE),
    **{n: {**DENSE, "modes": 3, "sampler_width": 8, "sampler_hidden": (8,)} for n in ("dlow", "dsf")},
}
STEP = {
    "program/batch.py": 1,  # one check of the whole batch: finite values in the support, valid lengths
    "training/svi.py": 1,  # loss and gradient norm decide whether a step is taken, clipped or an error
}
"""Number of synchronisations of each step, by file."""
BESIDE = {
    "moglow": {"distributions/conditional_flow.py": 2},  # zuko looks up both halves of each coupling
    "moglow-paths": {"distributions/conditional_flow.py": 2},
    "hit-dvae": {"scoring/energies.py": 1},  # the number of admissible futures is a shape
    "gsps": {"scoring/energies.py": 1},
    "mix-and-match": {"program/rollout.py": 1},  # which frames are sampled, so that a loop skips the others
    "motion-latent": {"training/gradnorm.py": 1},  # losses and gradient norms, which determine the weights
}


on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU is here")


@pytest.fixture(scope="module")
def people():
    return motion.simulate(clips=6, frames=60, seed=1)


@pytest.fixture(scope="module")
def segments():
    return Segments(motion.gait_cycles(bodies.fit_to_body(motion.simulate(clips=4, frames=90, seed=1), bodies.human())))


@pytest.fixture
def small_method(request, people):
    """Return a function of a method's name: a small model, its recipe, training windows and test windows."""

    def make(name, steps=4):
        torch.manual_seed(0)
        if name == "motion-latent":
            method, train = MotionLatent(**SMALL[name]), request.getfixturevalue("segments")
            return method.build(train), method.train(train, None, steps), train, None
        of_paths = issubclass(dvae.methods()[name], TrajectoryMethod)
        protocol = motion.PROTOCOLS["simulated-trajectories" if of_paths else "simulated"]
        cut = {"predicted": 8, "observed": min(protocol.observed, 6), "train_stride": 15, "test_stride": 25}
        cut |= {"representation": "quaternion"} if name == "mix-and-match" else {}
        data = motion.MotionData("simulated", people, replace(protocol, **cut))
        train = data.windows("train")
        method = dvae.method(name, **SMALL.get(name, {"latent": 4, "warm_up": 1})).resolve_defaults(train)
        model, recipe = method.build(data.schema), method.train(train, None, steps)
        recipe.prepare(model)
        return model, recipe, train, data.windows("test")

    return make


def two_steps(model, recipe, before_the_second=lambda: None, accelerator="cpu"):
    """Return the terms of two steps of the recipe, the number of tensors in the batch, and the SVI loop."""
    options = {"steps": 4, "scheduled_sampling": recipe.feeding, "accelerator": accelerator, "progress": False}
    svi = dvae.SVI(model, stages=recipe.stages, **options)
    svi.init()
    batch = recipe.batches.sample(3, torch.Generator().manual_seed(1))
    first = svi.step(batch)
    before_the_second()
    return (first, svi.step(batch)), len(Batch(batch).leaves()), svi


@contextmanager
def simulated_gpu():
    """Simulate a GPU that lightning-fabric uses."""
    with pytest.MonkeyPatch.context() as patch, on_device() as traffic:
        patch.setattr(SingleDeviceStrategy, "root_device", OnDevice.device)
        patch.setattr(CPUAccelerator, "setup_device", lambda *_: None)
        yield traffic


def numbers(terms):
    tables = ((kind, getattr(terms, kind)) for kind in ("log_likelihood", "kl", "energies", "steps"))
    return {(kind, name): value for kind, table in tables for name, value in table.items()}


@pytest.mark.parametrize("name", METHODS)
def test_a_step_on_a_device_equals_the_cpu_with_the_listed_synchronizations(name, small_method):
    """Training, validation, forecasts and scores equal those on the CPU."""
    model, recipe, _, _ = small_method(name)
    expected, _, _ = two_steps(model.double(), recipe)
    model, recipe, train, test = small_method(name)
    with simulated_gpu() as traffic:
        terms, tensors, svi = two_steps(move(model.double()), recipe, traffic.clear)
        places = [entry.partition(":")[0] for entry in traffic.reads]
        assert {place: places.count(place) for place in places} == STEP | BESIDE.get(name, {}), traffic.reads
        assert len(traffic.uploads) == tensors, traffic.uploads
        validate_and_score(svi, train, test)
        assert_same(terms, expected)


def validate_and_score(svi, train, test):
    svi.evaluate(train.sample(3, torch.Generator()))
    if test is not None:
        options = {"scores": motion.displacements, "samples": 2, "references": False, "progress": False}
        dvae.evaluate(svi.model, test, batch_size=500, bound_particles=2 * svi.model.likelihood, **options)


def assert_same(terms, expected):
    """Compare the terms of steps on the device and on the CPU."""
    for on_device_terms, here in zip(terms, expected, strict=True):
        got = {key: value.cpu() for key, value in numbers(on_device_terms).items()}
        torch.testing.assert_close(got, numbers(here), rtol=1e-9, atol=1e-9)


@pytest.mark.gpu
@on_gpu
@pytest.mark.parametrize("name", METHODS)
def test_a_step_on_a_gpu_equals_the_cpu(name, small_method):
    """Compare in double precision, with the noise of the CPU."""
    model, recipe, _, _ = small_method(name)
    expected, _, _ = two_steps(model.double(), recipe)
    model, recipe, train, test = small_method(name)
    with SameNoise():
        terms, _, svi = two_steps(model.double(), recipe, accelerator="cuda")
    validate_and_score(svi, train, test)
    assert_same(terms, expected)


@pytest.mark.gpu
@on_gpu
@pytest.mark.parametrize("name", METHODS)
def test_a_gpu_synchronizes_as_often_as_the_stand_in(name, small_method):
    """CUDA reports synchronisations, including those for uploaded tensors other than the batch."""
    model, recipe, _, _ = small_method(name)

    def listen():
        waited.clear()
        torch.cuda.set_sync_debug_mode("warn")

    with warnings.catch_warnings(record=True) as waited:
        warnings.simplefilter("always")
        try:
            two_steps(model, recipe, listen, accelerator="cuda")
        finally:
            torch.cuda.set_sync_debug_mode("default")
    synchronizations = [
        f"{warning.filename}:{warning.lineno}" for warning in waited if "synchronizing CUDA" in str(warning.message)
    ]
    assert len(synchronizations) == sum((STEP | BESIDE.get(name, {})).values()), synchronizations


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, on_gpu])])
@pytest.mark.parametrize("name", METHODS)
def test_terms_have_the_precision_of_the_model_under_autocast(name, device, small_method):
    """The error in mixed precision is at most the error due to rounding the weights to bfloat16."""
    model, recipe, _, _ = small_method(name)
    model.train(name == "gsps").requires_grad_(False).to(device)  # gsps normalises over a batch
    batch = on_device_of(model, recipe.batches.sample(3, torch.Generator().manual_seed(1)))
    drawing = {"draws": recipe.objective.draws} if getattr(recipe.objective, "draws", None) else {}

    def terms():
        torch.manual_seed(3)
        return dvae.SequenceELBO().terms(model, batch, **drawing)

    def value(result_terms):
        return float((result_terms.bound - sum(result_terms.energies.values())).double().sum())

    exact = value(terms())
    with torch.autocast(device, torch.bfloat16):
        mixed_terms = terms()
    assert {part.dtype for part in (mixed_terms.bound, mixed_terms.n_steps, *numbers(mixed_terms).values())} == {
        torch.float32
    }
    weights, squares = [parameter.clone() for parameter in model.parameters()], []
    for seed in range(4):
        torch.manual_seed(seed)
        for parameter, weight in zip(model.parameters(), weights, strict=True):
            parameter.copy_(weight * (1 + 2**-8 * torch.randn_like(weight)))
        squares.append((value(terms()) - exact) ** 2)
    assert abs(value(mixed_terms) - exact) <= 4 * (sum(squares) / len(squares)) ** 0.5


def recurrent_chain(cell):
    """Return the chain of an SRNN's guide, or of a VRNN's guide with its LSTM, and its inputs."""
    base, noise, gates = (torch.randn(5, 2, size).to("cuda") for size in (4, 3, 24))
    sizes = (24, 9), (4, 6 if cell else 3), (6, 4), (6,)
    recurrent, first, out, bias = (torch.randn(*shape).to("cuda") for shape in sizes)
    inputs = [value.requires_grad_() for value in (base, gates, recurrent, first, out, bias)]
    layers, state = [(first, None), (out, bias)], (gates, recurrent) if cell else None
    return lambda: gaussian_chain(base, noise, layers, cell=state), inputs


def kalman_filter(steps):
    """Return a Kalman filter over so many steps, and its inputs."""
    one, mean = torch.eye(2).to("cuda"), torch.zeros(1, 2).to("cuda")
    transition, information = (0.5 * one.expand(n, 1, 2, 2) for n in (steps - 1, steps))
    offset, potential = (torch.randn(n, 1, 2).to("cuda") for n in (steps - 1, steps))
    inputs = [value.requires_grad_() for value in (transition, offset, potential)]
    chain = LinearGaussianChain(transition, offset, one, mean, one[None], information, potential)
    return lambda: replace(chain).predicted, inputs


@pytest.mark.parametrize(
    ("loop", "option"),
    [(recurrent_chain, False), (recurrent_chain, True), (kalman_filter, 6), (kalman_filter, 200)],
    ids=["chain", "chain with a cell", "filter", "filter in blocks"],
)
def test_a_loop_over_time_neither_synchronizes_nor_uploads(loop, option):
    """Capture as a CUDA graph requires this, forward and backward."""
    with on_device() as traffic:
        run, inputs = loop(option)
        traffic.clear()
        torch.autograd.grad(sum(part.sum() for part in run() if part is not None), inputs, allow_unused=True)
        assert not traffic.reads
        assert not traffic.uploads


# ------------------------------------------------------------------------------------------------------ CUDA graphs


UNCAPTURED = dict.fromkeys(("moglow", "moglow-paths"), "conditional_flow.py")
"""Methods whose steps run without a graph, and where they read a value of the GPU."""


def steps_of(svi, recipe, count):
    """Return the terms and the loss of each step."""
    results = []
    for _ in range(count):
        terms = svi.step(recipe.batches.sample(3, svi.generator))
        loss = {("loss", ""): torch.tensor(svi.row()["loss"])}
        results.append({key: value.cpu().double() for key, value in (numbers(terms) | loss).items()})
    return results


@pytest.mark.filterwarnings("ignore:the training step runs without a CUDA graph")
@pytest.mark.filterwarnings("ignore:validation runs without a CUDA graph")
@pytest.mark.parametrize("name", METHODS)
def test_replayed_steps_equal_steps_on_the_cpu(name, small_method):
    """Draws are equal bit for bit, and terms up to rounding."""
    # a curriculum has a graph only once it is constant, and motion-latent has two stages, with a graph each
    count, runs = 12 if name in ("mix-and-match", "motion-latent") else 7, []
    for simulated in (False, True):
        model, recipe, train, _ = small_method(name, count)
        held_out = train.sample(3, torch.Generator().manual_seed(1))
        options = {"steps": count, "scheduled_sampling": recipe.feeding, "progress": False}
        options["learning_rate"] = 2**-10  # graphs read it in float32, which represents it exactly
        with simulated_gpu() if simulated else nullcontext():
            model = move(model.double()) if simulated else model.double()
            svi = dvae.SVI(model, stages=recipe.stages, cuda_graph=simulated, **options)
            svi.init()
            steps = steps_of(svi, recipe, count - 1)
            rows = [svi.evaluate(held_out) for _ in range(WARM_UP + 1)]
            steps += steps_of(svi, recipe, 1)
            runs.append((steps, [*rows, svi.evaluate(held_out)], svi.random["torch"]))
    torch.testing.assert_close(runs[1][:2], runs[0][:2], rtol=1e-7, atol=1e-7)
    assert torch.equal(runs[1][2], runs[0][2])
    captured = svi.captured, svi.captured_validation
    obstacles = [place for each in captured for places in each.obstacles.values() for place in places]
    if name in UNCAPTURED:
        assert obstacles
        assert all(UNCAPTURED[name] in place for place in obstacles)
    else:
        assert not obstacles
        assert all(each.graphs for each in captured)


@pytest.mark.gpu
@on_gpu
@pytest.mark.filterwarnings("ignore:the training step runs without a CUDA graph")
@pytest.mark.filterwarnings("ignore:validation runs without a CUDA graph")
@pytest.mark.parametrize("precision", ["64-true", "32-true", "bf16-mixed"])
@pytest.mark.parametrize("name", METHODS)
def test_replayed_steps_on_a_gpu_equal_steps_without_graphs(name, precision, small_method, monkeypatch):
    """Over 50 steps in float32, with validations; the random states are equal. Only bfloat16 may round differently."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    count, runs = 50 if precision == "32-true" else 15, []
    for cuda_graph in (False, True):
        model, recipe, train, _ = small_method(name, count)
        model = model.double() if precision == "64-true" else model
        held_out = train.sample(3, torch.Generator().manual_seed(1))
        options = {"steps": count, "scheduled_sampling": recipe.feeding, "progress": False, "accelerator": "cuda"}
        options |= {"learning_rate": 2**-10, "precision": precision}  # graphs read it in float32, which represents it
        svi = dvae.SVI(model, stages=recipe.stages, cuda_graph=cuda_graph, **options)
        svi.init()
        steps = steps_of(svi, recipe, count)
        runs.append((steps, [svi.evaluate(held_out) for _ in range(WARM_UP + 2)], svi.random))
    assert all(bool(each.graphs) == (name not in UNCAPTURED) for each in (svi.captured, svi.captured_validation))
    tolerance = 0.1 if precision == "bf16-mixed" else 1e-5
    torch.testing.assert_close(runs[1][:2], runs[0][:2], rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(runs[1][2], runs[0][2], rtol=0, atol=0)


def test_a_refused_step_changes_no_buffers(small_method):
    """Normalisation over a batch with NaN would otherwise store NaN."""
    model, recipe, _, _ = small_method("gsps", 7)
    batch = recipe.batches.sample(3, torch.Generator())
    invalid = Batch(batch) | {"x": torch.where(torch.arange(len(batch["x"][0, 0])) == 0, torch.nan, batch["x"])}
    with simulated_gpu():
        svi = dvae.SVI(move(model), stages=recipe.stages, steps=7, cuda_graph=True, progress=False)
        svi.init()
        for _ in range(6):
            svi.step(batch)
        before = {name: buffer.cpu().clone() for name, buffer in model.named_buffers()}
        with pytest.raises(ValueError, match="NaN"):
            svi.step(invalid)
        torch.testing.assert_close(
            {n: b.cpu() for n, b in model.named_buffers()}, before, rtol=0, atol=0, equal_nan=True
        )


@pytest.mark.parametrize("name", ["srnn", "hit-dvae", "gsps", "trajevae", "mix-and-match", "dlow"])
def test_replayed_forecasts_have_the_same_scores(name, small_method, monkeypatch):
    model, _, windows, _ = small_method(name)
    options = {"scores": motion.displacements, "samples": 2, "references": False, "progress": False, "batch_size": 1}
    expected = dvae.evaluate(model.double().eval(), windows, **options)
    replays, replay = [], Tape.replay
    monkeypatch.setattr(Tape, "replay", lambda tape: replays.append(replay(tape)))
    with simulated_gpu():
        result = dvae.evaluate(move(model), windows, cuda_graph=True, **options)
    for score, value in expected["model"].items():
        assert result["model"][score].mean == pytest.approx(value.mean, 1e-9)
    kinds = 2 if model.likelihood else 1  # forecasts and the ELBO
    assert len(replays) == kinds * (len(windows.keys) - WARM_UP)


def test_replayed_bounds_and_log_scores_are_those_of_a_processor(monkeypatch):
    model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 1, "x": 2}).double()
    windows = dvae.ArrayWindows(torch.randn(6, 8, 2), observed=3)
    options = {"samples": 2, "batch_size": 1, "bound_particles": 30, "log_score_particles": 3, "references": False}
    expected = dvae.evaluate(model, windows, **options, progress=False)["model"]
    replays, replay = [], Tape.replay
    monkeypatch.setattr(Tape, "replay", lambda tape: replays.append(replay(tape)))
    with simulated_gpu():
        result = dvae.evaluate(move(model), windows, cuda_graph=True, **options, progress=False)["model"]
    for score in ("ELBO", "IWAE bound", "k-hat", "log score"):
        assert result[score].mean == pytest.approx(expected[score].mean, 1e-9)
    assert len(replays) == 4 * (6 - WARM_UP)  # forecasts too


def test_graphs_of_chunks_that_are_recorded_first_do_not_overwrite_the_bound():
    model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 1, "x": 2}).double()
    windows = dvae.ArrayWindows(torch.randn(500, 4, 2), observed=2)
    # ten chunks of 40 particles in each batch of 100
    options = {"samples": 2, "batch_size": 100, "bound_particles": 400, "references": False, "progress": False}
    expected = dvae.evaluate(model, windows, **options)["model"]
    with simulated_gpu():
        result = dvae.evaluate(move(model), windows, cuda_graph=True, **options)["model"]
    for score in ("ELBO", "IWAE bound", "KL z"):
        assert result[score].mean == pytest.approx(expected[score].mean, 1e-9)


def test_a_log_score_has_a_graph_for_each_number_of_observed_steps():
    model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 1, "x": 2}).double()
    x = torch.randn(3, 8, 2).double()
    scores = []
    for simulated in (False, True):
        with simulated_gpu() if simulated else nullcontext():
            model = move(model) if simulated else model
            graphs = Captured("scores", OnDevice.device) if simulated else None
            batch = Batch(x=x.to(OnDevice.device) if simulated else x)
            for observed in (3, 5):
                torch.manual_seed(0)
                for _ in range(5):
                    last = predictive_bound(model, batch, observed, 4, graphs=graphs).bound
                scores.append(last.cpu())
    torch.testing.assert_close(scores[2:], scores[:2])


class TestCapturedStep:
    """Steps of a small model, replayed as a graph."""

    def svi(self, cuda_graph, **options):
        torch.manual_seed(0)
        model = dvae.DynamicalVAE(
            "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 2, "x": 3}
        ).double()
        svi = dvae.SVI(move(model) if cuda_graph else model, steps=20, progress=False, cuda_graph=cuda_graph, **options)
        svi.init()
        return svi

    def batches(self, count=10):
        return torch.randn(count, 4, 5, 3, generator=torch.Generator().manual_seed(1)).double()

    def weights(self, svi):
        return {name: value.cpu().clone() for name, value in svi.model.state_dict().items()}

    @pytest.mark.parametrize(
        "options",
        [
            {},
            {"optimizer": "sgd", "momentum": 0.9},
            {"optimizer": "adamw", "weight_decay": 0.1, "decay": 1.0, "gradient_clip": 0.1},
            {"objective": dvae.Evidence(kl_weight={"z": dvae.schedules.Ramp(0.0, 1.0, steps=10)}, free_bits=0.1)},
            {"scheduled_sampling": dvae.schedules.Ramp(0.1, 0.9, steps=10)},
            {"particles": 3},
        ],
    )
    def test_it_follows_the_schedules_of_a_step_on_the_cpu(self, options):
        expected = self.svi(False, **options)
        losses = [(expected.step(batch), expected.row()["loss"])[1] for batch in self.batches()]
        with simulated_gpu():
            svi = self.svi(True, **options)
            assert [(svi.step(batch), svi.row()["loss"])[1] for batch in self.batches()] == pytest.approx(losses, 1e-6)
            assert len(svi.captured.graphs) == 1
            torch.testing.assert_close(self.weights(svi), self.weights(expected), rtol=1e-6, atol=1e-6)

    def test_a_step_that_is_refused_changes_no_weights(self):
        *batches, last = self.batches()
        with simulated_gpu():
            svi = self.svi(True)
            for batch in batches:
                svi.step(batch)
            before = self.weights(svi)
            with pytest.raises(NonFiniteError, match="step 10: the log likelihood of x is -inf"):
                svi.step(1e200 * last)
            with pytest.raises(ValueError, match="x has NaN or infinite values"):
                svi.step(torch.full_like(last, torch.nan))
            torch.testing.assert_close(self.weights(svi), before, rtol=0, atol=0)
            svi.step(last)
            assert svi.state.step == 10

    def test_it_continues_after_a_checkpoint(self, tmp_path):
        data = self.batches().flatten(0, 1)
        options = {"batch_size": 8, "validate_every": 6, "progress": False, "cuda_graph": True}

        def model():
            torch.manual_seed(0)
            sizes = {"z": 2, "x": 3}
            return move(
                dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_t)", sizes).double()
            )

        with simulated_gpu():
            whole = dvae.fit(model(), data, steps=12, **options)
            dvae.fit(model(), data, steps=6, out=tmp_path / "run", **options)
            resumed = dvae.fit(model(), data, steps=12, out=tmp_path / "run", resume=True, **options)
            loss = [row["loss"] for row in (whole.history[-1], resumed.history[-1])]
        assert loss[1] == pytest.approx(loss[0], 1e-6)

    def test_each_shape_of_batch_has_its_graph(self):
        expected, batches = self.svi(False), self.batches()
        mixed = [part for batch in batches for part in (batch, batch[:2, :4])]
        losses = [(expected.step(batch), expected.row()["loss"])[1] for batch in mixed]
        with simulated_gpu():
            svi = self.svi(True)
            assert [(svi.step(batch), svi.row()["loss"])[1] for batch in mixed] == pytest.approx(losses, 1e-6)
            assert len(svi.captured.graphs) == 2

    def test_each_stage_has_its_graphs(self):
        """The graphs of an earlier stage are dropped, and their memory is free."""
        stages = [dvae.Stage(steps, dvae.Evidence(kl_weight=w)) for steps, w in ((6, 0.1), (14, 2.0))]
        stages[1] = replace(stages[1], frozen=("encoder.",))
        runs, batches = [], self.batches(12)
        for cuda_graph in (False, True):
            with simulated_gpu() if cuda_graph else nullcontext():
                svi = self.svi(cuda_graph, stages=stages)
                rows = []
                for step, batch in enumerate(batches):
                    rows.append((svi.step(batch), svi.row()["loss"])[1])
                    rows += [svi.evaluate(batches[0])["bound"] for _ in range(4)] if step in (4, 5, 11) else []
                runs.append((rows, self.weights(svi)))
        assert len(svi.captured.graphs) == len(svi.captured_validation.graphs) == 1
        assert runs[1][0] == pytest.approx(runs[0][0], 1e-6)
        torch.testing.assert_close(runs[1][1], runs[0][1], rtol=1e-6, atol=1e-6)

    def test_forecasts_that_select_the_weights_are_replayed(self, monkeypatch):
        windows, runs, replays = dvae.ArrayWindows(self.batches().flatten(0, 1)[:9], observed=2), [], []
        replay = Tape.replay
        monkeypatch.setattr(Tape, "replay", lambda tape: replays.append(replay(tape)))
        for cuda_graph in (False, True):
            with simulated_gpu() if cuda_graph else nullcontext():
                svi = self.svi(cuda_graph, select="forecast")
                runs.append([svi.validate(windows)["validation/CRPS"] for _ in range(WARM_UP + 2)])
        assert runs[1] == pytest.approx(runs[0], 1e-9)
        assert len(replays) == 2 * 2  # of the bound and the forecasts

    def test_a_check_that_fails_in_a_replay_raises_its_error(self):
        batches = self.batches()
        with simulated_gpu():
            svi = self.svi(True)
            expected = [svi.evaluate(batches[0]) for _ in range(WARM_UP + 1)]
            with pytest.raises(ValueError, match="x is NaN or infinite in 60 entries"):
                svi.evaluate(torch.full_like(batches[0], torch.nan))
            assert svi.evaluate(batches[0]) == pytest.approx(expected[0], 1e-9)

    def test_an_objective_without_weights_is_not_replayed(self):
        def objective(terms, step):
            return -terms.bound.sum() * (step + 1)

        with simulated_gpu(), pytest.warns(UserWarning, match="without a CUDA graph: objective has no weights"):
            assert self.svi(True, objective=objective).captured is None

    def test_an_objective_that_does_more_than_its_loss_is_not_replayed(self):
        class Scaled(dvae.Evidence):
            def __call__(self, terms, step):
                return 100 * super().__call__(terms, step)

        with simulated_gpu(), pytest.warns(UserWarning, match="without a CUDA graph: Scaled has no weights"):
            assert self.svi(True, objective=Scaled()).captured is None

    def test_momentum_is_zero_after_a_first_step_that_is_refused(self):
        runs, batches = [], self.batches()
        for cuda_graph in (False, True):
            with simulated_gpu() if cuda_graph else nullcontext():
                svi = self.svi(cuda_graph, optimizer="sgd", momentum=0.9)
                with pytest.raises(ValueError, match="x has NaN or infinite values"):
                    svi.step(torch.full_like(batches[0], torch.nan))
                for batch in batches:
                    svi.step(batch)
                runs.append(self.weights(svi))
        torch.testing.assert_close(runs[1], runs[0], rtol=1e-6, atol=1e-6)

    def test_graphs_are_new_after_a_checkpoint_is_restored(self, tmp_path):
        batches = self.batches()
        with simulated_gpu():
            svi = self.svi(True)
            run = Run(tmp_path / "run")
            run.write_config({})
            for batch in batches[:5]:
                svi.step(batch)
            store(svi, run)
            expected = [(svi.step(batch), svi.row()["loss"])[1] for batch in batches[5:]]
            restore(svi, run)
            assert [(svi.step(batch), svi.row()["loss"])[1] for batch in batches[5:]] == pytest.approx(expected, 1e-9)

    def test_batches_with_gaps_are_replayed(self):
        """Within a graph, each mask counts as incomplete, since reading it would synchronise."""
        masks = torch.rand(10, 4, 5, 3, generator=torch.Generator().manual_seed(2)) < 0.7
        batches, runs = [{"x": x, "mask": mask} for x, mask in zip(self.batches(), masks, strict=True)], []
        for cuda_graph in (False, True):
            with simulated_gpu() if cuda_graph else nullcontext():
                svi = self.svi(cuda_graph)
                losses = [(svi.step(batch), svi.row()["loss"])[1] for batch in batches]
                runs.append((losses, self.weights(svi)))
        assert len(svi.captured.graphs) == 1
        assert runs[1][0] == pytest.approx(runs[0][0], 1e-6)
        torch.testing.assert_close(runs[1][1], runs[0][1], rtol=1e-6, atol=1e-6)

    def test_latents_of_groups_are_replayed(self):
        batches, runs = self.batches(), []
        groups = torch.tensor([[0, 0, 1, 1], [2, 1, 2, 2], [3, 3, 3, 3], [0, 1, 2, 3], [5, 4, 4, 5]]).repeat(2, 1)
        for cuda_graph in (False, True):
            with simulated_gpu() if cuda_graph else nullcontext():
                torch.manual_seed(0)
                model = dvae.DynamicalVAE(
                    "p(g) p(z_t | z_{t-1}, g) p(x_t | z_t)",
                    "q(g | x_{1:T}) q(z_t | z_{t-1}, x_t, g)",
                    {"g": 2, "z": 2, "x": 3},
                    grouped=("g",),
                ).double()
                svi = dvae.SVI(move(model) if cuda_graph else model, steps=20, progress=False, cuda_graph=cuda_graph)
                svi.init()
                pairs = zip(batches, groups, strict=True)
                losses = [(svi.step({"x": x, "group": group}), svi.row()["loss"])[1] for x, group in pairs]
                runs.append((losses, self.weights(svi)))
        assert len(svi.captured.graphs) == 1
        assert runs[1][0] == pytest.approx(runs[0][0], 1e-6)
        torch.testing.assert_close(runs[1][1], runs[0][1], rtol=1e-6, atol=1e-6)

    def test_values_that_float32_does_not_resolve_are_refused(self):
        """A float32 model checks float64 values, also within a graph."""
        batches = self.batches()
        with simulated_gpu():
            torch.manual_seed(0)
            model = dvae.DynamicalVAE("p(z_t) p(x_t | z_t)", "q(z_t | x_t)", {"z": 2, "x": 3})
            svi = dvae.SVI(move(model), steps=20, progress=False, cuda_graph=True)
            svi.init()
            for batch in batches:
                svi.step(batch)
            assert len(svi.captured.graphs) == 1
            before = self.weights(svi)
            with pytest.raises(ValueError, match="which float32 does not resolve"):
                svi.step(1e9 + batches[0])
            torch.testing.assert_close(self.weights(svi), before, rtol=0, atol=0)

    def test_a_processor_has_no_graphs(self):
        svi = dvae.SVI(torch.nn.Linear(1, 1), cuda_graph=True, accelerator="cpu")
        with pytest.warns(UserWarning, match="without a CUDA graph: the device is cpu, not cuda"):
            svi.init()


class TestCaptured:
    """The simulated graphs of any function."""

    def test_forecasts_on_a_processor_have_no_graphs(self):
        model = dvae.DynamicalVAE("p(z_t) p(x_t | z_t)", "q(z_t | x_t)", {"z": 1, "x": 2})
        windows = dvae.ArrayWindows(torch.randn(4, 6, 2), observed=3)
        with pytest.warns(UserWarning, match="model is evaluated without CUDA graphs: the device is cpu, not cuda"):
            dvae.evaluate(model, windows, samples=2, cuda_graph=True, progress=False)

    def results(self, function, warning=None, count=6):
        """Return the results of calls with x = 1, 2, …, and the graphs."""
        with on_device():
            captured = Captured("this function", OnDevice.device)
            with pytest.warns(UserWarning, match=warning) if warning else nullcontext():
                values = [
                    captured(None, function, {"x": torch.tensor([float(n)])})["y"].cpu().item() for n in range(1, count)
                ]
            return values, captured.graphs

    def test_decisions_of_python_stay_as_they_were_in_the_recording(self):
        calls = iter(range(100))
        values, graphs = self.results(lambda inputs: {"y": inputs["x"] * 10 + next(calls)})
        assert values == [10, 21, 32, 43, 53]
        assert len(graphs) == 1

    @pytest.mark.parametrize(
        ("function", "warning"),
        [
            (lambda inputs: {"y": inputs["x"] * inputs["x"].item()}, r"test_device.py:\d+ reads a value of the GPU"),
            (lambda inputs: {"y": inputs["x"] * inputs["x"][inputs["x"] > 0]}, r"test_device.py:\d+ reads a value"),
            (lambda inputs: {"y": inputs["x"] ** 2 + (torch.rand(()) < 0)}, "aten.rand.default draws on the CPU"),
        ],
    )
    def test_a_function_that_a_graph_cannot_repeat_is_run_itself(self, function, warning):
        values, graphs = self.results(function, f"this function runs without a CUDA graph: .*{warning}")
        assert values == [1, 4, 9, 16, 25]
        assert not graphs

    def test_a_function_whose_recording_fails_is_run_itself(self, monkeypatch):
        """A library that synchronises without torch's warning is noticed only in the recording."""
        monkeypatch.setattr(Tape, "record", lambda *_, **__: (_ for _ in ()).throw(RuntimeError("invalid capture")))
        values, graphs = self.results(lambda inputs: {"y": inputs["x"] ** 2}, "the recording failed: invalid capture")
        assert values == [1, 4, 9, 16, 25]
        assert not graphs

    def test_a_recording_changes_nothing(self):
        """A GPU computes nothing while it records, so a counter rises once per call."""
        with on_device():
            count = torch.zeros(1).to("cuda")
            captured = Captured("this function", OnDevice.device)
            assert [captured(None, lambda _: {"y": count.add_(1)}, {})["y"].cpu().item() for _ in range(6)] == [
                1,
                2,
                3,
                4,
                5,
                6,
            ]


# ------------------------------------------------------------------------------------------------ the device itself


class TestOnDevice:
    here: ClassVar = torch.arange(6.0).view(2, 3)

    @pytest.mark.parametrize(
        ("run", "reads", "uploads"),
        [
            (lambda x: x.sum().item(), 1, 0),
            (lambda x: x.cpu(), 1, 0),
            (lambda x: torch.zeros(2, 3).copy_(x), 1, 0),
            (lambda x: x.nonzero(), 1, 0),
            (lambda x: x[x > 2], 1, 0),
            (lambda x: torch.linalg.inv_ex(x @ x.T), 0, 0),
            (lambda x: x.masked_fill(x > 2, 0.0), 0, 0),
            (lambda x: x[:, [0, 2]], 0, 1),
            (lambda x: x + torch.ones(2, 3).to(x), 0, 1),
            (lambda x: torch.tensor([1.0, 2, 3], device=x.device) * x, 0, 1),
            (lambda x: x.new_tensor([1.0, 2, 3]) * x, 0, 1),
            (lambda x: torch.arange(3, device=x.device) * x, 0, 0),
        ],
    )
    def test_it_lists_uploads_and_synchronizations(self, run, reads, uploads):
        expected = run(self.here)
        with on_device() as traffic:
            x = self.here.to("cuda")
            traffic.clear()
            output = run(x)
            assert (len(traffic.reads), len(traffic.uploads)) == (reads, uploads)
            assert all(place.startswith("testing/test_device.py:") for place in (*traffic.reads, *traffic.uploads))
            as_here = [value.cpu() if isinstance(value, torch.Tensor) else value for value in tree_leaves(output)]
        torch.testing.assert_close(as_here, tree_leaves(expected))

    @pytest.mark.parametrize(
        "run",
        [lambda x: x + torch.ones(3), lambda x: torch.cat([x, torch.zeros(2, 3)])],
    )
    def test_mixing_devices_is_an_error(self, run):
        with on_device(), pytest.raises(RuntimeError, match=r"on cuda:127 and on the CPU \("):
            run(self.here.to("cuda"))

    def test_gradients_equal_those_on_the_cpu(self):
        lstm = torch.nn.LSTM(3, 4, batch_first=True)
        x = torch.randn(2, 5, 3)
        expected = torch.autograd.grad(lstm(x)[0].square().sum(), list(lstm.parameters()))
        with on_device() as traffic:
            move(lstm)(x.to("cuda"))[0].square().sum().backward()
            assert not traffic.reads
            torch.testing.assert_close([p.grad.cpu() for p in lstm.parameters()], list(expected))

    def test_same_noise_is_that_of_the_cpu(self):
        def noise(device):
            torch.manual_seed(1)
            normal = torch.randn(3, device=device)
            uniform = torch.empty(3).to(device).uniform_()
            return [
                normal,
                uniform,
                torch.bernoulli(uniform),
                torch.randperm(4, device=device),
                torch.normal(normal, uniform),
            ]

        expected = noise("cpu")
        with on_device(), SameNoise():
            values = noise("cuda")
            assert all(isinstance(value, OnDevice) for value in values)
            values = [value.cpu() for value in values]
        torch.testing.assert_close(values, expected, rtol=0, atol=0)

    def test_use_outside_the_block_is_an_error(self):
        with on_device():
            x = self.here.to("cuda")
        with pytest.raises(RuntimeError, match="exists only in a block of on_device"):
            x + 1
        with on_device(), pytest.raises(TypeError, match="cannot become an array; move it to the CPU first"):
            x.numpy()
