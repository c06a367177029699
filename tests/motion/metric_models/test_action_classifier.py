"""The action classifier: its inputs, training, and the scores ACC and FID."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

import dvae
from dvae import motion
from dvae.cli import main
from dvae.inference.evaluation.evaluation import Evaluation, Score
from dvae.inference.evaluation.metrics import frechet_distance, frechet_pseudo_values
from dvae.inference.evaluation.references import nearest_neighbours
from dvae.models.registry import configured, metric_model
from dvae.motion.data.dataset import MotionData
from dvae.motion.metric_models.action_classifier import ActionClassifier, ActionClassifierModel

SHORT = replace(motion.PROTOCOLS["simulated"], observed=4, predicted=6)
SMALL = {"label": "way", "hidden": 8, "layers": 2, "features": 3}
FIT = ["--label", "way", "--hidden", "8", "--features", "3", "--batch-size", "16", "--validate-every", "10"]


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def people(count=24, ways=("up", "down"), frames=40):
    """Simulate people; every second one is upside down."""
    clips = motion.simulate(clips=count, frames=frames, test=0.4)
    flip = {"up": np.float32([1, 1, 1]), "down": np.float32([1, -1, 1])}
    simulated = [
        replace(
            clip, positions=clip.positions * flip[("up", "down")[i % 2]], labels={"way": ways[i % 2], "who": f"{i}"}
        )
        for i, clip in enumerate(clips)
    ]
    return motion.MotionSet(simulated, clips.skeleton, "people")


def windows(split, clips=None, protocol=SHORT):
    return motion.windows(people() if clips is None else clips, protocol, split)


def evaluate(windows, classifiers, **options):
    scores = partial(motion.scores, classifiers=classifiers)
    return dvae.evaluate({}, windows, scores=scores, progress=False, **options)


def classifier(train=None, **options):
    train = windows("train") if train is None else train
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return ActionClassifier(**{**SMALL, **options}).build(train).double().eval()


@pytest.fixture(scope="module")
def fitted():
    """Return a fitted classifier of upright and upside-down people."""
    train, method = windows("train"), ActionClassifier(**SMALL)
    model = classifier(train)
    dvae.fit(
        model,
        method.train(train).batches,
        steps=60,
        batch_size=16,
        learning_rate=0.02,
        accelerator="cpu",
        progress=False,
    )
    return model


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "people.npz"
    motion.save(path, people(frames=90))
    return path


@pytest.fixture(scope="module")
def run(file, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "way"
    arguments = ["--data", str(file), "--protocol", "simulated", "--out", str(out), "--steps", "20", *FIT]
    assert main(["fit", "action-classifier", *arguments]) == 0
    return out


# The classifier


def test_its_bound_is_the_log_likelihood_of_the_class_from_the_predicted_frames():
    test, model = windows("test"), classifier()
    batch = ActionClassifier(**SMALL, classes=model.classes).train(test).batches.all()
    x, c = batch["x"].double(), batch["c"]
    log_softmax = model.logits(model.features(x[:, 4:])).log_softmax(-1)
    terms = dvae.SequenceELBO().terms(model, {"x": x, "c": c})
    torch.testing.assert_close(terms.log_likelihood["c"], log_softmax[torch.arange(len(c)), c])
    torch.testing.assert_close(terms.per_step, terms.log_likelihood["c"])  # each window counts once
    elsewhere = torch.cat([draw(len(x), 4, x.shape[2]), x[:, 4:]], 1)
    assert torch.equal(dvae.SequenceELBO().terms(model, {"x": elsewhere, "c": c}).bound, terms.bound)


def test_its_features_follow_the_formula_from_a_zero_state():
    model, futures = classifier(), draw(5, 2, 6, 48)
    state = [torch.zeros(8, dtype=torch.float64) for _ in range(2)]
    weights = {name: value.detach() for name, value in model.gru.named_parameters()}
    for frame in futures[3, 1]:
        for layer in range(2):
            gates = weights[f"weight_ih_l{layer}"] @ frame + weights[f"bias_ih_l{layer}"]
            last = weights[f"weight_hh_l{layer}"] @ state[layer] + weights[f"bias_hh_l{layer}"]
            (r, z, n), (r_, z_, n_) = gates.chunk(3), last.chunk(3)
            new = torch.tanh(n + torch.sigmoid(r + r_) * n_)
            gate = torch.sigmoid(z + z_)
            frame = state[layer] = (1 - gate) * new + gate * state[layer]
    features = model.features(futures)
    assert features.shape == (5, 2, 3)
    torch.testing.assert_close(features[3, 1], torch.tanh(model.project(state[1])))
    assert torch.equal(model.train().features(futures), features)


def test_it_learns_distinguishable_classes(fitted):
    test = windows("test")
    predicted = fitted.logits(fitted.features(test.all()["x"][:, 4:].double())).argmax(-1)
    assert [fitted.classes[c] for c in predicted.tolist()] == test.labels("way")


def test_a_fitted_classifier_is_loaded_and_resumed(run, file, tmp_path, capsys):
    run_contents = dvae.load(run)
    assert isinstance(run_contents.model, ActionClassifierModel)
    assert run_contents.model.classes == ("down", "up")
    assert configured(json.loads(json.dumps(run_contents.method.config()))) == run_contents.method
    parts, method = tmp_path / "parts", metric_model("action-classifier", **SMALL)
    training = replace(method.trainings[""], steps=10, batch_size=16, validate_every=10, progress=False)
    dvae.fit(method, MotionData.open(file), out=parts, **vars(training))
    assert main(["resume", str(parts), "--steps", "20"]) == 0
    assert f"score forecasts with: dvae evaluate RUN --classifier {parts}" in " ".join(capsys.readouterr().out.split())
    rows = [json.loads(line) for line in (parts / "log.jsonl").read_text().splitlines()]
    assert max(row["step"] for row in rows) == 20
    assert any("validation/log_likelihood/c" in row for row in rows)
    assert main(["forecast", str(run), "--out", str(tmp_path / "futures.npz")]) == 1
    assert "is a fitted action-classifier, which has no forecasts" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ActionClassifier(hidden=0), "hidden is 0; it must be at least 1"),
        (lambda: ActionClassifier().build({"x": 48}), "needs the description of poses, but was given sequences"),
        (
            lambda: ActionClassifier().resolve_defaults(windows("train")),
            "have nothing for the label 'content'.* are way, who",
        ),
        (
            lambda: ActionClassifier(**SMALL).resolve_defaults(windows("train", people(ways=("up", "up")))),
            "needs at least two classes: training clips have up for",
        ),
        (
            lambda: ActionClassifier(**SMALL, classes=("up", "left")).train(windows("test")),
            "clip test/person_.* has 'down' for 'way', expected one of up, left",
        ),
        (lambda: classifier().model({"x": draw(2, 10, 48)}), "the batch has no 'c'"),
        (lambda: classifier().features(draw(2, 9, 51)), "frames have 51 numbers, .* fitted to frames of 48"),
    ],
)
def test_wrong_arguments_are_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# ACC and FID


def brute_force(real, generated, places):
    """Return the distance of all windows, and those without each clip."""
    keep = [torch.ones(len(places), dtype=bool), *(places != clip for clip in places.unique())]
    distances = [frechet_distance(real[subset], generated[subset].flatten(0, 1)).item() for subset in keep]
    return np.array(distances[0]), np.array(distances[1:])


def test_pseudo_values_equal_those_of_leaving_out_each_clip():
    places = torch.tensor([0, 0, 0, 1, 2, 2, 2, 2, 3, 4, 4, 1, 0, 5, 5])
    real, generated = draw(15, 4) + 20, 1.3 * draw(15, 3, 4, seed=1) + 20.5
    value, without = brute_force(real, generated, places)
    shares = places.bincount().numpy() / 15
    plain = value + (1 / shares - 1) * (value - without)
    pseudo = np.array(frechet_pseudo_values(real, generated, places))
    np.testing.assert_allclose(pseudo - pseudo[0], plain - plain[0], rtol=1e-9)
    assert shares @ pseudo == pytest.approx(value, rel=1e-12)


def test_scores_of_reference_rows_by_hand(fitted):
    test = windows("test")
    result = evaluate(test, {"way": fitted}, training_windows=windows("train"), samples=5)
    assert list(result.rows) == ["real motion", "zero velocity", "nearest neighbours"]
    x = test.all()["x"].double()
    truth = torch.tensor([fitted.classes.index(label) for label in test.labels("way")])
    neighbours = nearest_neighbours(x[:, :4], windows("train").all()["x"].double(), 5)
    futures = {"zero velocity": x[None, :, 3:4].expand(-1, -1, 6, -1), "nearest neighbours": neighbours}
    real = fitted.features(x[:, 4:])
    for name, forecasts in futures.items():
        features = fitted.features(forecasts)
        right = (fitted.logits(features).argmax(-1) == truth).double().mean()
        assert result[name]["ACC way"].mean == pytest.approx(right.item())
        expected = frechet_distance(real, features.flatten(0, 1)).item()
        assert result[name]["FID way"].mean == pytest.approx(expected, rel=1e-5)
    real = result["real motion"]
    assert (real["ACC way"].mean, real["FID way"].mean, real["FID way"].standard_error) == (1, 0, 0)
    assert (real["ADE"].mean, real["FDEm"].mean, real["energy score"].mean) == (0, 0, 0)
    against_real = result.difference("real motion", "zero velocity", "FID way")
    assert against_real.mean == -result["zero velocity"]["FID way"].mean


def test_unknown_classes_count_for_fid_only_and_are_reported(fitted):
    clips = people()
    relabelled = [
        replace(c, labels={"way": "sideways"}) if c.split == "test" and n % 3 else c for n, c in enumerate(clips)
    ]
    some = windows("test", motion.MotionSet(relabelled, clips.skeleton, "people"))
    result = evaluate(some, {"way": fitted, "a": classifier()})
    unknown, used = some.labels("way").count("sideways"), result.basis["classifier way"]
    assert used["unknown"] == unknown > 0
    assert used["weights"] != result.basis["classifier a"]["weights"]
    assert f"{unknown} of {len(some)} windows have a class that it does not know" in " ".join(str(result).split())
    assert f"ACC, FID way: classifier {used['weights'][:12]}" in str(result)
    assert result["real motion"]["ACC way"] == Score(1, 0)
    assert list(result.metrics)[-4:] == ["ACC a", "ACC way", "FID a", "FID way"]
    assert Evaluation.from_json(result.to_json()).to_json() == result.to_json()
    none = evaluate(windows("test", people(ways=("left", "right"))), {"way": fitted})
    assert "FID way" in none.metrics
    assert "ACC way" not in none.metrics


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        (lambda: windows("test", protocol=replace(SHORT, root="relative")), "the skeleton 'walker' and 51"),
        (lambda: windows("test", protocol=replace(SHORT, predicted=5)), "fitted to 6 predicted frames at .* have 5 at"),
        (
            lambda: windows("test", motion.simulate(clips=9, frames=40, test=0.4)),
            "distinguishes ways, but no clip has the label 'way'",
        ),
        (lambda: windows("test", people(3), replace(SHORT, test_stride=99)), "got 1 windows of 1 clips"),
    ],
)
def test_windows_unlike_those_of_a_classifier_are_errors(condition, message, fitted):
    with pytest.raises(ValueError, match=message):
        evaluate(condition(), {"way": fitted})


def test_the_command_line_scores_runs_by_classifiers(run, file, tmp_path, capsys):
    model, out = tmp_path / "paths", tmp_path / "scores.json"
    protocol = ["--protocol", "simulated-trajectories", "--batch-size", "4", "--steps", "2"]
    small = ["--latent", "2", "--width", "8", "--feedforward", "8"]
    assert main(["fit", "trajevae", "--data", str(file), *protocol, *small, "--out", str(model)]) == 0
    way = ["--label", "way", "--hidden", "4", "--out", str(tmp_path / "way")]
    assert main(["fit", "action-classifier", "--data", str(file), *protocol, *way]) == 0
    arguments = ["evaluate", str(model), "--samples", "2", "--joints", "LWrist", "--out", str(out)]
    assert main([*arguments, "--classifier", str(tmp_path / "way")]) == 0
    assert {"ACC way", "path error"} <= Evaluation.load(out)["trajevae"].keys()
    for runs, message in (
        ([tmp_path / "way"] * 2, "is a second classifier of the label 'way'"),
        ([model], "is a fitted trajevae, not an action-classifier"),
        ([run], "was fitted on other data or under another protocol"),
    ):
        capsys.readouterr()
        assert main([*arguments, "--classifier", *map(str, runs)]) == 2
        assert message in " ".join(capsys.readouterr().err.split())
