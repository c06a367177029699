"""Forecasts of other software: the scores of a model's own draws, in every form; and every wrong form is refused."""

import io
import re
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import dvae
from dvae.data.sequences import ArrayWindows
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.evaluation import Evaluation
from dvae.inference.evaluation.external import ForecastSamples, column_names, read_samples, windows_to_forecast
from dvae.inference.evaluation.scores import Measure, calibrated
from dvae.program.model import DynamicalVAE
from dvae.tables import ColumnHints, Cut, PanelData

pd = pytest.importorskip("pandas")

N, K, OBSERVED, HORIZON, D = 7, 9, 4, 3, 2


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.fixture(scope="module")
def windows():
    return ArrayWindows(draw(N, OBSERVED + HORIZON, D).cumsum(1), OBSERVED, columns={"a": "m", "b": ""})


@pytest.fixture(scope="module")
def model():
    pair = "p(z_t | z_{t-1}) p(x_t | x_{t-1}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return DynamicalVAE(*pair, {"z": 2, "x": D}).double()


@pytest.fixture(scope="module")
def own(model, windows):
    """Return a model's own draws (K, N, T, D), and its evaluation."""
    seen = []

    def scores(windows):
        def keep(forecasts, truth, past, index):
            seen.append(forecasts)
            return truth[:, 0, 0]

        return [*calibrated(windows), Measure("kept", keep)]

    options = {"samples": K, "batch_size": 3, "progress": False, "references": False}
    result = evaluate(model, windows, scores=scores, **options)
    return torch.cat(seen).movedim(0, 1), result


def score(forecasts, windows, **options):
    return evaluate({"theirs": forecasts}, windows, scores=calibrated, batch_size=3, progress=False, **options)


def save_npz(path, samples, windows, **changes):
    arrays = windows_to_forecast(windows)
    keys = {name: arrays[name] for name in ("split", "sequence", "start", "columns") if name in arrays}
    np.savez_compressed(path, **{"samples": np.asarray(samples), **keys, **changes})
    return path


def long_table(samples, windows):
    k, n, t = (index.ravel() for index in np.indices(samples.shape[:3]))
    split, sequence, start = (np.array(part) for part in zip(*windows.keys, strict=True))
    columns = {"split": split[n], "sequence": sequence[n], "start": start[n], "sample": k, "ahead": t + 1}
    values = np.asarray(samples).reshape(-1, samples.shape[-1]).T
    return pd.DataFrame(columns | dict(zip(column_names(windows), values, strict=True)))


FORMS = {
    "array": lambda x, windows, path: x.numpy(),
    "tensor": lambda x, windows, path: x,
    "mapping": lambda x, windows, path: {key: x[:, n] for n, key in reversed([*enumerate(windows.keys)])},
    "mapping by name": lambda x, windows, path: {key[1:]: x[:, n].numpy() for n, key in enumerate(windows.keys)},
    "list": lambda x, windows, path: list(x.movedim(1, 0)),
    "gluonts": lambda x, windows, path: [
        SimpleNamespace(samples=x[:, n].numpy(), item_id=key[1], start_date=key[2])
        for n, key in enumerate(windows.keys)
    ],
    "darts": lambda x, windows, path: [
        SimpleNamespace(
            all_values=lambda n=n: x[:, n].movedim(0, -1).numpy(), components=pd.Index(["a", "b"]), start_time=lambda: 0
        )
        for n in range(N)
    ],
    "npz": lambda x, windows, path: save_npz(path / "a.npz", x, windows),
    "npy": lambda x, windows, path: np.save(path / "a.npy", x.numpy()) or path / "a.npy",
    "csv": lambda x, windows, path: (
        long_table(x, windows).sample(frac=1, random_state=0).to_csv(path / "a.csv", index=False) or path / "a.csv"
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_models_own_draws_have_its_scores_in_every_form(own, windows, tmp_path, form):
    samples, expected = own
    result = score(FORMS[form](samples, windows, tmp_path), windows)
    row, reference = result.rows["theirs"], expected.rows["model"]
    assert row.samples == K
    for name, values in row.cluster_means.items():
        np.testing.assert_array_equal(values, reference.cluster_means[name])
    for name, values in row.histograms.items():
        np.testing.assert_array_equal(values, reference.histograms[name])
    assert {*row.cluster_means} == {*expected.metrics} & {measure.name for measure in calibrated(windows)}


def test_forecasts_stand_beside_models_and_references_and_are_neither(model, own, windows, tmp_path):
    samples, _ = own
    result = evaluate({"theirs": samples[:4] + 100, "model": model}, windows, samples=K, batch_size=3, progress=False)
    assert [*result.rows] == ["last value", "theirs", "model"]
    assert result.best_reference == "last value"
    assert result.skill("theirs").mean < -1
    assert any(sentence.startswith("theirs is worse than last value") for sentence in result.verdicts)
    assert result.difference("theirs", "model", "CRPS").mean > 50
    notes = " ".join(result.notes)
    assert "forecasts of theirs were given" in notes
    assert f"not comparable with those of K = {K}: theirs (4)" in notes
    record = result.rows["theirs"].config["forecasts"]
    assert record["shape"] == [4, N, HORIZON, D]
    assert record["sha256"] != score(samples[:4], windows).rows["theirs"].config["forecasts"]["sha256"]
    assert result.data["fingerprint"] == windows.fingerprint
    result.save(tmp_path / "scores.json")
    loaded = Evaluation.load(tmp_path / "scores.json")
    assert loaded.verdicts == result.verdicts
    assert "given forecasts" in str(score(samples, windows).table().title)


@pytest.mark.parametrize("kind", [torch.int32, torch.bfloat16, torch.float16, torch.float32])
def test_forecasts_of_other_types_are_scored_in_the_precision_of_the_truth(own, windows, kind):
    rounded = own[0].to(kind)
    rounded = rounded.requires_grad_() if kind.is_floating_point else rounded
    expected = score(rounded.detach().double(), windows)["theirs"]["CRPS"].mean
    assert score(rounded, windows)["theirs"]["CRPS"].mean == pytest.approx(expected, rel=1e-6)


def test_large_counts_are_not_rounded(own, windows):
    counts = own[0].mul(10).round().long() + 2**28
    far = ArrayWindows(windows.x * 10 + 2**28, OBSERVED)
    expected = score(counts.double(), far)["theirs"]["CRPS"].mean
    assert score(counts, far)["theirs"]["CRPS"].mean == pytest.approx(expected, rel=1e-6)


WRONG = {
    "no window axis": (lambda x, w: x[:, 0], r"shape \(9, 3, 2\), expected samples \(K, N, T, D\) = \(K, 7, 3, 2\)"),
    "missing windows": (lambda x, w: x[:, 1:], r"shape \(9, 6, 3, 2\), expected .* \(K, 7, 3, 2\)"),
    "extra windows": (lambda x, w: x[:, [0, *range(N)]], r"shape \(9, 8, 3, 2\)"),
    "horizon": (lambda x, w: x[:, :, :2], r"shape \(9, 7, 2, 2\)"),
    "columns": (lambda x, w: x[..., :1], r"shape \(9, 7, 3, 1\)"),
    "observed steps too": (
        lambda x, w: torch.cat([x, x, x[:, :, :1]], 2),
        "give only the steps to predict, without the observed ones",
    ),
    "order of axes": (lambda x, w: x.movedim(0, 1), "change the order of the axes"),
    "no samples": (lambda x, w: x[:0], r"shape \(0, 7, 3, 2\)"),
    "missing key": (
        lambda x, w: {key: x[:, n] for n, key in enumerate(w.keys) if n != 2},
        r"forecasts of 6 windows, expected .*; 1 are missing, such as \[\('array', '2', 0\)\]$",
    ),
    "unknown key": (
        lambda x, w: {("array", str(n + 1), 0): x[:, n] for n in range(N)},
        r"missing, such as \[\('array', '0', 0\)\]; 1 are unknown or repeated, such as \[\('array', '7', 0\)\]",
    ),
    "no key": (lambda x, w: {"a": x[:, 0]}, r"key 'a'; expected \(split, sequence, first step\) of a window"),
    "key twice": (
        lambda x, w: ForecastSamples(x, [("array", str(n // 2), 0) for n in range(N)]),
        r"3 are missing, .*; 3 are unknown or repeated, such as \[\('array', '0', 0\)",
    ),
    "unequal items": (
        lambda x, w: [x[:, n, : 2 + n % 2] for n in range(N)],
        r"item 0 has \(\(9, 2, 2\),\), and item 1 has \(\(9, 3, 2\),\)",
    ),
    "means": (lambda x, w: list(x.mean(0)), r"samples \(K, T, D\) of each window, .*; item 0 has \(\(3, 2\),\)$"),
    "fewer named columns": (
        lambda x, w: ForecastSamples(x[..., :1], columns=["b"]),
        r"shape \(9, 7, 3, 1\), .*; its columns are \['b'\], not \['a', 'b'\]",
    ),
    "columns of other names": (
        lambda x, w: ForecastSamples(x, columns=["b", "a"]),
        r"columns \['b', 'a'\]; expected, in this order, \['a', 'b'\]",
    ),
    "sequences in another order": (
        lambda x, w: [SimpleNamespace(samples=x[:, n].numpy(), item_id=str(6 - n), start_date=n) for n in range(N)],
        r"sequences \['6', '5', .*; expected, in this order, \['0', '1'",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_forecasts_are_refused_naming_what_was_given_and_expected(own, windows, case):
    make, message = WRONG[case]
    with pytest.raises(ValueError, match="'theirs' (has|must).*" + message):
        score(make(own[0], windows), windows)


def test_other_objects_are_refused(own, windows):
    for given, message in (
        (3, "'theirs' is 3; expected a model that forecasts.* or samples"),
        ([], "'theirs' is an empty list"),
        ([1.0], r"theirs\[0\] is a float without samples"),
        ([SimpleNamespace(forecast_array=1)], r"theirs\[0\] is a SimpleNamespace without .* means and quantiles"),
        (own[0].to(torch.complex64), "complex"),
    ):
        with pytest.raises(TypeError, match=message):
            score(given, windows)
    broken = own[0].clone()
    broken[3, 5, 1, 0] = torch.nan
    with pytest.raises(FloatingPointError, match=r"forecast of theirs is not finite for the window at step 0 of '5'"):
        score(broken, windows)
    with pytest.raises(ValueError, match="must not have the name of a reference row: last value"):
        evaluate({"last value": own[0]}, windows, progress=False)


def test_windows_with_equal_keys_need_their_order(own, windows):
    grouped = ArrayWindows(windows.x, OBSERVED, groups=["one"] * 4 + ["two"] * 3)
    score(own[0], grouped)
    with pytest.raises(ValueError, match=r"several windows have the same key, such as \('array', 'one', 0\)"):
        score({("array", "one", 0): own[0][:, 0]}, ArrayWindows(windows.x[:1].expand(2, -1, -1), OBSERVED, ["one"] * 2))


def test_axes_are_rearranged(own):
    samples, _ = own
    other = samples.movedim(0, 1)[:, :, :, None, None]  # (N, K, T, 1, 1, D)
    torch.testing.assert_close(ForecastSamples(other).arranged("nkt11d").values, samples, rtol=0, atol=0)
    torch.testing.assert_close(ForecastSamples(other).arranged("nkt1jc").values, samples, rtol=0, atol=0)
    for axes in ("kntd", "nkt1d1", "nkt11x", "nkk11d", "nktjcd"):
        with pytest.raises(ValueError, match=f"axes are '{axes}' for an array .* expected a letter for each axis"):
            ForecastSamples(other).arranged(axes)


@pytest.fixture(scope="module")
def panel():
    rng = np.random.default_rng(0)
    parts = [
        pd.DataFrame({"day": np.arange(20), "riders": rng.poisson(5, 20), "kind": rng.choice(["a", "b"], 20)})
        for _ in range(8)
    ]
    frame = pd.concat([part.assign(station=f"s{n}") for n, part in enumerate(parts)])
    return PanelData.of(frame, ColumnHints(id=("station",), time="day"), Cut(6, 3))


def test_exported_windows_are_the_past_and_the_keys(panel):
    test, arrays = panel.windows("test"), windows_to_forecast(panel)
    np.testing.assert_array_equal(arrays["observed"], test.all().mask_to_nan()[:, :6])
    keys = zip(*(arrays[name].tolist() for name in ("split", "sequence", "start")), strict=True)
    assert list(keys) == test.keys
    assert arrays["horizon"] == 3
    assert arrays["columns"].tolist() == column_names(test)
    assert arrays["time"].tolist() == [[str(start + step) for step in range(9)] for start in arrays["start"].tolist()]
    assert "future" not in arrays
    train = windows_to_forecast(panel.windows("train"), whole=True)
    both = np.concatenate([train["observed"], train["future"]], 1)
    np.testing.assert_array_equal(both, panel.windows("train").all().mask_to_nan())


def test_samples_that_a_family_excludes_are_noted(panel):
    test = panel.windows("test")
    samples = test.all()["x"][None, :, 6:].double()
    assert panel.schema.columns.targets[0].family == "count"
    assert not any("outside" in note for note in score(samples, test).notes)
    samples[0, 1, 2, 0] = -2.5
    (note,) = [note for note in score(samples, test).notes if "outside" in note]
    assert note.endswith("riders has -2.5, but its values are whole numbers from 0")


def test_forecasts_of_a_sequence_in_another_order_are_refused(panel):
    windows = panel.windows("test")
    futures = windows.all()["x"][:, windows.protocol.observed :].numpy()[:, None]
    listed = [
        SimpleNamespace(samples=each, item_id=key[1], start_date=pd.Period("2024-01-01", "D") + key[2])
        for each, key in zip(futures, windows.keys, strict=True)
    ]
    assert score(listed, windows)["theirs"]["energy score"].mean == 0
    same = [n for n in range(len(listed) - 1) if windows.keys[n][1] == windows.keys[n + 1][1]]
    listed[same[0]], listed[same[0] + 1] = listed[same[0] + 1], listed[same[0]]
    with pytest.raises(ValueError, match=r"a forecast from 2024-.* before one from .*; expected the order"):
        score(listed, windows)


def test_files_that_forecasts_of_tables_wrote_are_scored_or_refused_with_a_reason(panel, tmp_path):
    test = panel.windows("test")
    torch.manual_seed(0)
    model = dvae.method("vae", latent=2).build(panel.schema)
    forecasts = test.forecast(model, samples=45)
    forecasts.save(tmp_path / "own.npz")
    forecasts.save(tmp_path / "own.csv")
    first = score(tmp_path / "own.npz", test)["theirs"]["CRPS"]
    assert first == score(forecasts.draws, test)["theirs"]["CRPS"]
    with pytest.raises(ValueError, match=r"own.npz: it names the first step of each future; pass `observed`"):
        read_samples(tmp_path / "own.npz")
    with pytest.raises(ValueError, match=r"own.csv: it contains means and quantiles, which do not"):
        read_samples(tmp_path / "own.csv")


TABLES = {
    "no keys": (lambda f: f.drop(columns="start"), "no column 'start'; expected sequence, start, sample, ahead"),
    "a header": (lambda f: f.iloc[:0], "it has no rows; expected one for each window, sample and step"),
    "a row less": (lambda f: f.iloc[1:], r"188 rows; expected one for each of 7 windows, 9 samples and 3 steps"),
    "a row twice": (lambda f: pd.concat([f.iloc[1:], f.iloc[1:2]]), "189 rows; expected one for each"),
    "steps from 0": (lambda f: f.assign(ahead=f["ahead"] - 1), "with `ahead` from 1"),
    "text": (lambda f: f.astype(object).assign(a="x"), "could not convert string to float"),
    "a start that is no number": (lambda f: f.assign(start="x"), "invalid literal for int"),
}


@pytest.mark.parametrize("case", TABLES)
def test_incomplete_tables_are_refused(own, windows, tmp_path, case):
    make, message = TABLES[case]
    make(long_table(own[0], windows)).to_csv(tmp_path / "their\x07.csv", index=False)
    with pytest.raises(ValueError, match=message):
        read_samples(tmp_path / "their\x07.csv")


def test_a_gap_or_swapped_columns_in_a_table_is_refused(own, windows, tmp_path):
    frame = long_table(own[0], windows)
    frame.loc[5, "a"] = np.nan
    frame.to_csv(tmp_path / "gap.csv", index=False)
    with pytest.raises(FloatingPointError, match="forecast of theirs is not finite"):
        score(tmp_path / "gap.csv", windows)
    long_table(own[0], windows).rename(columns={"a": "b", "b": "a"}).to_csv(tmp_path / "swapped.csv", index=False)
    with pytest.raises(ValueError, match=r"columns \['b', 'a'\]; expected, in this order, \['a', 'b'\]"):
        score(tmp_path / "swapped.csv", windows)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"sequence": "0"}, r"has the keys \['sequence'\]; expected both `sequence` and `start`"),
        ({"clip": "0"}, r"has the keys \['clip'\]"),
        ({"start": 0}, r"has the keys \['start'\]"),
        ({"split": "test"}, r"has the keys \['split'\]"),
        ({"start": 0, "split": "test"}, r"has the keys \['start', 'split'\]"),
        ({"Sequence": "0", "Start": 0}, r"contains \['Sequence', 'Start'\]; expected only samples, .*sequence"),
        ({"sequence": "0", "start": 0, "Columns": "a"}, r"contains \['Columns'\]; expected only .*columns"),
    ],
)
def test_incomplete_or_misspelt_keys_are_refused(own, windows, tmp_path, keys, message):
    np.savez(tmp_path / "theirs.npz", samples=own[0], **{name: np.full(N, value) for name, value in keys.items()})
    with pytest.raises(ValueError, match=f"theirs.npz: it {message}"):
        score(tmp_path / "theirs.npz", windows)


def test_samples_without_keys_have_the_order_of_the_windows_and_a_note(own, windows, tmp_path):
    np.savez(tmp_path / "theirs.npz", samples=own[0])
    result, keyed = (
        score(tmp_path / "theirs.npz", windows),
        score(save_npz(tmp_path / "k.npz", own[0], windows), windows),
    )
    assert result["theirs"]["CRPS"] == keyed["theirs"]["CRPS"]
    assert "forecasts of theirs have no keys: they are read in the order of the windows" in result.notes
    assert not any("have no keys" in note for note in keyed.notes)


class Pickled:
    def __reduce__(self):
        return pytest.fail, ("a pickle was run",)


def npz(*entries):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in entries:
            archive.writestr(name, data)
    return content.getvalue()


def npy(shape="(1,)", descr="<f8", data=b"\0" * 8):
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + data


def objects():
    content = io.BytesIO()
    np.save(content, np.array([Pickled()], object), allow_pickle=True)
    return content.getvalue()


HOSTILE = {
    "empty": (b"", "cannot be read as npz"),
    "no archive": (b"PK\x03\x04" + b"x" * 100, "cannot be read as npz"),
    "a pickle": (npz(("samples.npy", objects())), "Python objects"),
    "too large": (npz(("samples.npy", npy("(99999999999999,)"))), "declares shape .* but holds 8 bytes"),
    "empty and large": (npz(("samples.npy", npy("(0, 999999999)", data=b""))), "declares shape"),
    "code in the header": (npz(("samples.npy", npy("__import__('os')"))), "not a plain array"),
    "text": (npz(("samples.npy", npy("(1,)", "<U2"))), "expected numbers `samples`"),
    "other members": (npz(("filled\x1b[31m.npy", npy())), r"contains \['filled\\x1b"),
    "no letters": (
        npz(
            ("samples.npy", npy("(1, 1, 1, 1)")),
            ("sequence.npy", npy("(1,)", "<U1", b"\xff\xff\xff\xff")),
            ("start.npy", npy("(1,)", "<i8")),
        ),
        "npz",
    ),
    "keys of another length": (
        npz(
            ("samples.npy", npy("(1, 1, 1, 1)")),
            ("sequence.npy", npy("(2,)", "<U1", b"\0" * 8)),
            ("start.npy", npy("(1,)", "<i8")),
        ),
        "must have one entry for each window",
    ),
    "dimensions": (npz(("samples.npy", npy("(1, 1)"))), "samples have shape"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_are_refused_in_one_sentence(tmp_path, case):
    content, message = HOSTILE[case]
    path = tmp_path / "theirs.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as refused:
        read_samples(path)
    assert "theirs.npz" in str(refused.value)
    assert str(refused.value).isprintable()


def test_other_paths_are_refused(tmp_path):
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(ValueError, match="must be a plain file"):
        read_samples(tmp_path / "folder.npz")
    with pytest.raises(ValueError, match=re.escape("must end in one of .npz, .npy, .csv")):
        read_samples(tmp_path / "a.pkl")
    with pytest.raises(FileNotFoundError):
        read_samples(tmp_path / "absent.npz")
    np.save(tmp_path / "objects.npy", np.array([None]), allow_pickle=True)
    with pytest.raises(ValueError, match=r"objects.npy"):
        read_samples(tmp_path / "objects.npy")


def test_forecasts_of_gluonts(own, windows):
    forecast = pytest.importorskip("gluonts.model.forecast")
    start, univariate = pd.Period("2024-01-01", "D"), ArrayWindows(windows.x[..., :1], OBSERVED)
    listed = [
        forecast.SampleForecast(own[0][:, n, :, 0].numpy(), start, item_id=key[1]) for n, key in enumerate(windows.keys)
    ]
    assert score(listed, univariate)["theirs"]["CRPS"] == score(own[0][..., :1], univariate)["theirs"]["CRPS"]
    quantiles = forecast.QuantileForecast(np.zeros((2, HORIZON)), start, ["0.1", "0.9"])
    with pytest.raises(TypeError, match="QuantileForecast without samples"):
        score([quantiles] * N, univariate)


def test_forecasts_of_darts(own, windows):
    series = pytest.importorskip("darts").TimeSeries
    values = own[0].movedim(0, -1).numpy()
    expected = score(own[0], windows)["theirs"]["CRPS"]
    assert score([series.from_values(each) for each in values], windows)["theirs"]["CRPS"] == expected
    named = [series.from_values(each, columns=["a", "b"]) for each in values]
    assert score(named, windows)["theirs"]["CRPS"] == expected
    swapped = [series.from_values(each, columns=["b", "a"]) for each in values]
    with pytest.raises(ValueError, match="expected, in this order"):
        score(swapped, windows)
