"""The action classifier: what it reads, that it learns and repeats, and the scores ACC and FID that rest on it."""

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

import dvae
from dvae import motion
from dvae.cli import main
from dvae.inference.evaluation.evaluation import Evaluation, Row, Score
from dvae.inference.evaluation.metrics import frechet_distance, frechet_pseudo_values
from dvae.inference.evaluation.references import nearest_neighbours
from dvae.models.registry import configured, judge
from dvae.motion.data.dataset import MotionData
from dvae.motion.judges.action_classifier import ActionClassifier, ActionClassifierModel

SHORT = replace(motion.PROTOCOLS["simulated"], observed=4, predicted=6)
SMALL = {"label": "way", "hidden": 8, "layers": 2, "features": 3}
FIT = ["--label", "way", "--hidden", "8", "--features", "3", "--batch-size", "16", "--validate-every", "10"]


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def people(count=24, ways=("up", "down"), frames=40):
    """Simulated people, of whom every second one hangs upside down."""
    clips = motion.simulate(clips=count, frames=frames, test=0.4)
    flip = {"up": np.float32([1, 1, 1]), "down": np.float32([1, -1, 1])}
    made = [
        replace(
            clip, positions=clip.positions * flip[("up", "down")[i % 2]], labels={"way": ways[i % 2], "who": f"{i}"}
        )
        for i, clip in enumerate(clips)
    ]
    return motion.MotionSet(made, clips.skeleton, "people")


def other_skeleton(clips):
    return motion.MotionSet(list(clips), replace(clips.skeleton, name="other"), "people")


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
    """A classifier of who is up and who is down, fitted for long enough."""
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


def test_windows_come_with_the_class_of_their_clip():
    test = windows("test")
    classes = test.classified("c", "way", ("down", "up"))
    batch = classes.all()
    assert [("down", "up")[c] for c in batch["c"].tolist()] == test.labels("way")
    assert torch.equal(batch["x"], test.all()["x"])
    drawn = classes.sample(50, torch.Generator().manual_seed(2))
    up = test.positions(drawn["x"])[:, 0, test.skeleton.names.index("Head"), 1] > 0
    assert torch.equal(drawn["c"], up.long())
    assert torch.equal(drawn["x"], test.sample(50, torch.Generator().manual_seed(2))["x"])
    assert classes.fingerprint not in (test.fingerprint, test.classified("c", "way", ("up", "down")).fingerprint)
    assert "c" not in test.all()


def test_its_bound_is_the_log_likelihood_of_the_class_from_the_predicted_frames():
    test, model = windows("test"), classifier()
    batch = ActionClassifier(**SMALL, classes=model.classes).train(test).batches.all()
    x, c = batch["x"].double(), batch["c"]
    log_softmax = model.logits(model.features(x[:, 4:])).log_softmax(-1)
    terms = dvae.SequenceELBO().terms(model, {"x": x, "c": c})
    torch.testing.assert_close(terms.log_likelihood["c"], log_softmax[torch.arange(len(c)), c])
    torch.testing.assert_close(terms.per_frame, terms.log_likelihood["c"])  # a window counts once
    elsewhere = torch.cat([draw(len(x), 4, x.shape[2]), x[:, 4:]], 1)
    assert torch.equal(dvae.SequenceELBO().terms(model, {"x": elsewhere, "c": c}).bound, terms.bound)


def test_its_features_follow_the_formula_from_a_zero_state_and_never_vary():
    model, futures = classifier(), draw(5, 2, 6, 48)
    state = [torch.zeros(8, dtype=torch.float64) for _ in range(2)]
    weights = {name: value.detach() for name, value in model.gru.named_parameters()}
    for frame in futures[3, 1]:
        for layer in range(2):
            ours = weights[f"weight_ih_l{layer}"] @ frame + weights[f"bias_ih_l{layer}"]
            last = weights[f"weight_hh_l{layer}"] @ state[layer] + weights[f"bias_hh_l{layer}"]
            (r, z, n), (r_, z_, n_) = ours.chunk(3), last.chunk(3)
            new = torch.tanh(n + torch.sigmoid(r + r_) * n_)
            gate = torch.sigmoid(z + z_)
            frame = state[layer] = (1 - gate) * new + gate * state[layer]
    features = model.features(futures)
    assert features.shape == (5, 2, 3)
    torch.testing.assert_close(features[3, 1], torch.tanh(model.project(state[1])))
    torch.manual_seed(7)
    assert torch.equal(model.features(futures), features)
    assert torch.equal(model.train().features(futures), features)


def test_it_learns_what_can_be_told_apart(fitted):
    test = windows("test")
    predicted = fitted.logits(fitted.features(test.all()["x"][:, 4:].double())).argmax(-1)
    assert [fitted.classes[c] for c in predicted.tolist()] == test.labels("way")


def test_the_classes_are_those_of_the_training_clips_and_kept():
    train = windows("train")
    method = ActionClassifier(**SMALL).suited(train)
    assert method.classes == ("down", "up")
    assert configured(json.loads(json.dumps(method.config()))) == method
    assert method.suited(windows("test", people(ways=("left", "right")))) == method
    recipe = method.train(train)
    assert (recipe.objective, recipe.feeding) == (dvae.Evidence(), 0)


def test_a_fitted_classifier_is_read_back_and_goes_on(run, file, tmp_path, capsys):
    loaded = dvae.load(run)
    assert isinstance(loaded.model, ActionClassifierModel)
    assert loaded.model.classes == ("down", "up")
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    method = judge("action-classifier", **SMALL)
    training = replace(method.trainings[""], steps=20, batch_size=16, validate_every=10, progress=False)
    result = dvae.fit(method, MotionData.open(file), out=whole, **vars(training))
    assert "nats a window" in result.best
    x = loaded.data.windows("test").all()["x"][:, 15:]
    logits = loaded.model.logits(loaded.model.features(x))
    other = dvae.load(whole).model
    assert torch.equal(other.logits(other.features(x)), logits)
    dvae.fit(method, MotionData.open(file), out=parts, **vars(replace(training, steps=10)))
    assert main(["resume", str(parts), "--steps", "20"]) == 0
    assert f"score forecasts with: dvae evaluate RUN --classifier {parts}" in " ".join(capsys.readouterr().out.split())
    rows = [json.loads(line) for line in (parts / "log.jsonl").read_text().splitlines()]
    assert max(row["step"] for row in rows) == 20
    assert any("validation/log_likelihood/c" in row for row in rows)


@pytest.mark.parametrize("command", ["evaluate", "compare", "check calibration", "forecast"])
def test_it_forecasts_nothing(command, run, tmp_path, capsys):
    out = ["--out", str(tmp_path / "futures.npz")] if command == "forecast" else []
    assert main([*command.split(), str(run), *out]) == 1
    assert "is a fitted action-classifier, which forecasts nothing" in " ".join(capsys.readouterr().err.split())


def without_label(clips):
    made = [replace(clip, labels={"who": "0"}) if n == 3 else clip for n, clip in enumerate(clips)]
    return motion.MotionSet(made, clips.skeleton, "people")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ActionClassifier(hidden=0), "hidden is 0; it must be at least 1"),
        (lambda: ActionClassifier().build({"x": 48}), "needs to know what poses are, and was given sequences"),
        (lambda: ActionClassifier().suited(windows("train")), "have nothing for the label 'content'.* are way, who"),
        (
            lambda: ActionClassifier(**SMALL).suited(windows("train", people(ways=("up", "up")))),
            "nothing to tell apart: training clips have up for",
        ),
        (
            lambda: ActionClassifier(**SMALL).train(windows("train", without_label(people()))),
            "clip train/person_0003 .* has no label 'way', expected one of down, up",
        ),
        (
            lambda: ActionClassifier(**SMALL, classes=("up", "left")).train(windows("test")),
            "clip test/person_.* has 'down' for 'way', expected one of up, left",
        ),
        (lambda: classifier().model({"x": draw(2, 10, 48)}), "the batch lacks 'c'"),
        (lambda: classifier().model({"x": draw(2, 4, 48), "c": torch.zeros(2)}), "none after the 4 observed"),
        (
            lambda: classifier().model({"x": draw(2, 9, 48), "c": torch.zeros(2), "lengths": torch.tensor([9, 8])}),
            "reads whole windows; leave lengths out",
        ),
        (lambda: classifier().features(draw(2, 9, 51)), "frames have 51 numbers; .* fitted to frames of 48"),
    ],
)
def test_what_it_refuses(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# ACC and FID


def brute_force(real, generated, places):
    """The distance of all windows, and without each clip."""
    keep = [torch.ones(len(places), dtype=bool), *(places != clip for clip in places.unique())]
    found = [frechet_distance(real[kept], generated[kept].flatten(0, 1)).item() for kept in keep]
    return np.array(found[0]), np.array(found[1:])


def test_pseudo_values_are_those_of_leaving_each_clip_out():
    places = torch.tensor([0, 0, 0, 1, 2, 2, 2, 2, 3, 4, 4, 1, 0, 5, 5])
    real, generated = draw(15, 4) + 20, 1.3 * draw(15, 3, 4, seed=1) + 20.5
    value, without = brute_force(real, generated, places)
    shares = places.bincount().numpy() / 15
    plain = value + (1 / shares - 1) * (value - without)
    pseudo = np.array(frechet_pseudo_values(real, generated, places))
    np.testing.assert_allclose(pseudo - pseudo[0], plain - plain[0], rtol=1e-9)
    assert shares @ pseudo == pytest.approx(value, rel=1e-12)


def test_with_clips_of_one_size_the_error_is_that_of_the_jackknife():
    places = torch.arange(8).repeat_interleave(3)
    real, generated = draw(24, 2), draw(24, 5, 2, seed=1) + 1
    _, without = brute_force(real, generated, places)
    record = evaluate(windows("test"), {"way": classifier()})
    means = {"FID way": frechet_pseudo_values(real, generated, places)}
    record = replace(record, clips={str(n): 3 for n in range(8)}, rows={"a": Row(1, means)})
    expected = math.sqrt(7 / 8 * ((without - without.mean()) ** 2).sum())
    assert record["a"]["FID way"].standard_error == pytest.approx(expected, rel=1e-9)


def test_the_error_is_the_spread_of_the_distance_over_other_clips():
    def score(seed):
        places, size = torch.arange(60).repeat_interleave(2), 3
        clip = draw(60, size, seed=seed).repeat_interleave(2, 0)  # windows of a clip are alike
        real = clip + 0.1 * draw(120, size, seed=seed + 1)
        generated = 0.7 * clip[:, None] + 0.3 + 0.5 * draw(120, 4, size, seed=seed + 2)
        pseudo = np.array(frechet_pseudo_values(real, generated, places))
        return pseudo.mean(), math.sqrt(((pseudo - pseudo.mean()) ** 2).sum() / 60 / 59)

    values, errors = np.array([score(10 * seed) for seed in range(300)]).T
    assert errors.mean() == pytest.approx(values.std(), rel=0.15)


def test_one_clip_has_a_distance_and_no_error():
    real, generated = draw(5, 2), draw(5, 3, 2, seed=1)
    (value,) = frechet_pseudo_values(real, generated, torch.zeros(5, dtype=torch.long))
    assert value == pytest.approx(frechet_distance(real, generated.flatten(0, 1)).item())


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


def test_differences_of_the_distance_are_paired_over_clips():
    test, train, model = windows("test"), windows("train"), classifier()
    result = evaluate(test, {"way": model}, training_windows=train, samples=5)
    paired = result.difference("zero velocity", "nearest neighbours", "FID way")
    x, places = test.all()["x"].double(), torch.arange(10).repeat_interleave(3)
    neighbours = nearest_neighbours(x[:, :4], train.all()["x"].double(), 5).movedim(0, 1)
    still = x[:, None, 3:4].expand(-1, -1, 6, -1)
    real, first, second = (model.features(each) for each in (x[:, 4:], still, neighbours))
    value, without = (a - b for a, b in zip(brute_force(real, first, places), brute_force(real, second, places)))
    assert paired.mean == pytest.approx(value, rel=1e-6)
    jackknife = math.sqrt(9 / 10 * ((without - without.mean()) ** 2).sum())
    assert paired.standard_error == pytest.approx(jackknife, rel=1e-6)


def test_classes_that_it_does_not_know_count_for_fid_alone(fitted):
    clips = people()
    made = [replace(c, labels={"way": "sideways"}) if c.split == "test" and n % 3 else c for n, c in enumerate(clips)]
    some = windows("test", motion.MotionSet(made, clips.skeleton, "people"))
    result = evaluate(some, {"way": fitted})
    known = [label != "sideways" for label in some.labels("way")]
    assert result.basis["classifier way"]["unknown"] == known.count(False) > 0
    assert f"{known.count(False)} of {len(known)} windows are of no class it knows" in " ".join(str(result).split())
    assert result["real motion"]["ACC way"] == Score(1, 0)
    assert result.difference("zero velocity", "real motion", "ACC way").mean <= 0
    assert Evaluation.from_json(result.to_json()).to_json() == result.to_json()
    none = evaluate(windows("test", people(ways=("left", "right"))), {"way": fitted})
    assert "FID way" in none.metrics
    assert "ACC way" not in none.metrics


def test_the_record_says_which_classifier(fitted):
    test = windows("test")
    fitted.train()
    result = evaluate(test, {"b": fitted, "a": classifier()})
    assert fitted.training
    fitted.eval()
    assert list(result.metrics)[-7:] == ["limb-angle error", "CMD", "jerk", "ACC a", "ACC b", "FID a", "FID b"]
    used = {name: result.basis[f"classifier {name}"] for name in "ab"}
    assert used["b"].keys() == {"label", "classes", "weights", "unknown"}
    assert used["a"]["weights"] != used["b"]["weights"]
    assert (result.metrics["FID b"].program, result.metrics["FID b"].better) == ("free-running", "lower")
    assert f"ACC, FID b: classifier {used['b']['weights'][:12]}" in str(result)
    assert "FID a ↓" in [axes.get_title() for axes in result.plot().axes]


@pytest.mark.parametrize(
    ("held", "message"),
    [
        (
            lambda: windows("test", other_skeleton(people())),
            "fitted to the skeleton 'walker' and frames of 48 numbers; these windows have the skeleton 'other' and 48",
        ),
        (lambda: windows("test", protocol=replace(SHORT, root="relative")), "the skeleton 'walker' and 51"),
        (
            lambda: windows("test", protocol=replace(SHORT, predicted=SHORT.predicted - 1)),
            f"fitted to {SHORT.predicted} predicted frames at .* have {SHORT.predicted - 1} at",
        ),
        (
            lambda: windows("test", motion.simulate(clips=9, frames=40, test=0.4)),
            "tells ways apart, but no label 'way'",
        ),
        (lambda: windows("test", people(3), replace(SHORT, test_stride=99)), "these are 1 windows of 1 clips"),
        (lambda: windows("test", people(5), replace(SHORT, test_stride=99)), "these are 2 windows of 2 clips"),
    ],
)
def test_windows_that_do_not_suit_a_classifier_are_refused(held, message, fitted):
    with pytest.raises(ValueError, match=message):
        evaluate(held(), {"way": fitted})


def test_the_command_line_scores_runs_by_classifiers(run, file, tmp_path, capsys):
    model, other = tmp_path / "vae", tmp_path / "other"
    data = ["--data", str(file), "--steps", "2", "--batch-size", "4"]
    assert main(["fit", "vae", "--latent", "2", "--warm-up", "0", "--out", str(model), *data]) == 0
    out = tmp_path / "scores.json"
    arguments = ["evaluate", str(model), "--samples", "2", "--out", str(out)]
    assert main([*arguments, "--classifier", str(run)]) == 0
    assert "ACC way" in capsys.readouterr().out
    result = Evaluation.load(out)
    assert list(result.rows) == ["real motion", "zero velocity", "nearest neighbours", "vae"]
    assert {"ACC way", "FID way"} <= result["vae"].keys()
    by_take = ["--protocol", "cmu8", "--label", "way", "--hidden", "4", "--out", str(other)]
    assert main(["fit", "action-classifier", *by_take, *data]) == 0
    for runs_, message in (
        ([run, run], "is the second of the label 'way'"),
        ([model], "is a fitted vae, no action-classifier"),
        ([other], "was fitted on other data or under another protocol"),
    ):
        capsys.readouterr()
        assert main([*arguments, "--classifier", *map(str, runs_)]) == 2
        assert message in " ".join(capsys.readouterr().err.split())


def test_motion_along_paths_is_judged_too(file, tmp_path):
    data = ["--data", str(file), "--protocol", "simulated-trajectories", "--batch-size", "4", "--steps", "2"]
    small = ["--latent", "2", "--width", "8", "--feedforward", "8"]
    assert main(["fit", "trajevae", *data, *small, "--out", str(tmp_path / "paths")]) == 0
    assert (
        main(["fit", "action-classifier", *data, "--label", "way", "--hidden", "4", "--out", str(tmp_path / "way")])
        == 0
    )
    scored = ["evaluate", str(tmp_path / "paths"), "--samples", "2", "--out", str(tmp_path / "scores.json")]
    assert main([*scored, "--joints", "LWrist", "--classifier", str(tmp_path / "way")]) == 0
    assert {"ACC way", "path error"} <= Evaluation.load(tmp_path / "scores.json")["trajevae"].keys()
