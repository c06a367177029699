"""Listed and sampled windows equal the rows of the table at their keys, without future values."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import dvae
from dvae.data.sequences import HeldOutWindows, Source
from dvae.inference.evaluation.evaluation_windows import prepare_windows
from dvae.tables import Column, Columns, Panel, PanelData, Series
from dvae.tables.encoding import PanelSchema
from dvae.tables.protocol import Cut
from dvae.tables.windows import PanelWindows

NAN = np.nan
COLUMNS = Columns(
    (
        Column("y"),
        Column("n", family="count"),
        Column("plan", "known"),
        Column("price", "past"),
        Column("weather", "past", "category", classes=("rain", "sun")),
        Column("height", "static"),
    )
)


def table(lengths=(9, 14, 30, 8, 21, 17, 12, 25, 13, 10), missing=True, columns=COLUMNS, seed=0):
    rng = np.random.default_rng(seed)
    series = []
    for n, t in enumerate(lengths):
        values = np.stack([rng.normal(size=t), rng.poisson(3, t), rng.normal(size=t), rng.normal(size=t)], 1)
        values = np.concatenate([values, rng.integers(0, 2, (t, 1)), np.full((t, 1), rng.normal())], 1)
        if missing:
            values[:, :5][rng.random((t, 5)) < 0.2] = NAN
        series.append(Series(f"s{n}", values, np.cumsum(rng.choice([1.0, 1.0, 3.0], t))))
    return Panel(series, columns)


def rows(batch, n):
    """One window of a batch."""
    return {name: value[n] for name, value in batch.items()}


def expected_window(panel, schema, name, start, length):
    """Return a window, computed from the table."""
    (one,) = panel.only([name])
    part = slice(start, start + length)
    x, c = schema.targets(one)[part], schema.context(one)[part].copy()
    if (observed := schema.cut.observed) is not None:
        # plan and its indicator; price and its indicator; weather in two coordinates, and its indicator
        price = c.shape[1] - 5
        c[observed:, [price, price + 2, price + 3]] = c[observed - 1, [price, price + 2, price + 3]]
        c[observed:, [price + 1, price + 4]] = 0
    return {"x": np.nan_to_num(x), "mask": ~np.isnan(x), "c": c, "s": schema.static(one), "d": schema.gaps(one)[part]}


def assert_equal(actual, expected):
    assert actual.keys() == expected.keys()
    assert all(torch.equal(actual[name], expected[name]) for name in actual)


def assert_same(actual, expected):
    for name in expected:
        np.testing.assert_allclose(actual[name].numpy(), expected[name].astype(np.float32), rtol=1e-6, atol=1e-6)


CUTS = {"sequences": Cut(5, 3), "time": Cut(5, 3, split="time"), "stride": Cut(4, 1, stride=2, test=0.5)}


@pytest.mark.parametrize(
    ("cut_name", "split"),
    [
        *(("sequences", split) for split in ("train", "train+validation", "last")),
        *(("time", split) for split in ("train", "validation", "test")),
        *(("stride", split) for split in ("test", "all")),
    ],
)
def test_listed_windows_equal_the_table_at_their_keys(cut_name, split):
    panel, cut = table(), CUTS[cut_name]
    schema = PanelSchema.from_data(panel, cut)
    windows = PanelWindows(panel, schema, split)
    batch, keys = windows.all(), windows.keys
    assert len(windows) == len(keys) == len(set(keys)) == len(batch["x"])
    for n, (part, name, start) in enumerate(keys):
        assert part == split
        assert_same(rows(batch, n), expected_window(panel, schema, name, start, cut.length))
    assert isinstance(windows, Source)
    assert isinstance(windows, HeldOutWindows)


@pytest.mark.parametrize("cut_name", ["sequences", "time"])
def test_sampling_draws_every_window_with_equal_probability(cut_name):
    panel, cut = table(), CUTS[cut_name]
    schema = PanelSchema.from_data(panel, cut)
    windows = PanelWindows(panel, schema, "train")
    every = {}
    for place, low, last in cut.starts(panel, "train"):
        for start in range(low, last + 1):
            window = expected_window(panel, schema, panel.series[place].name, start, cut.length)
            every[np.float32(window["d"]).tobytes() + np.float64(window["x"]).tobytes()] = window
    counts = dict.fromkeys(every, 0)
    total = 400 * len(every)
    batch = windows.sample(total, torch.Generator().manual_seed(0))
    for n in range(total):
        key = batch["d"][n].numpy().tobytes() + batch["x"][n].numpy().tobytes()
        if not counts[key]:
            assert_same(rows(batch, n), every[key])
        counts[key] += 1
    deviation = (np.array([*counts.values()]) - 400) / 400**0.5
    assert abs(deviation).max() < 5
    assert deviation.std() == pytest.approx(1, abs=0.25)


def test_whole_sequences_are_padded():
    panel = table()
    schema = PanelSchema.from_data(panel, Cut())
    windows = PanelWindows(panel, schema, "all")
    batch = windows.all()
    assert batch["lengths"].tolist() == [len(one) for one in panel]
    for n, (_, name, start) in enumerate(windows.keys):
        length = int(batch["lengths"][n])
        unpadded = {key: value[n] if value.dim() < 3 else value[n, :length] for key, value in batch.items()}
        assert start == 0
        assert_same(unpadded, expected_window(panel, schema, name, 0, length))
    sample = PanelWindows(panel, schema, "train").sample(4, torch.Generator().manual_seed(0))
    assert sample["x"].shape[:2] == (4, sample["lengths"].max())
    even = table((9, 9, 9, 9))
    assert "lengths" not in PanelWindows(even, PanelSchema.from_data(even, Cut()), "all").all()


def test_future_values_of_known_covariates_are_read_and_those_of_past_ones_are_not():
    def batch(rows=slice(0), index=0):
        panel = table((8, 8, 8, 8), missing=False)
        for one in panel:
            one.values[rows, index] = 1 - one.values[rows, index]
        return PanelWindows(panel, schema, "all").all()

    schema = PanelSchema.from_data(table((8, 8, 8, 8), missing=False), Cut(5, 3))
    before = batch()
    for index, column in enumerate(COLUMNS.columns):
        if column.role in ("known", "past"):
            after = batch(slice(5, None), index)
            assert torch.equal(before["c"], after["c"]) == (column.role == "past")
            assert all(torch.equal(before[name], after[name]) for name in before.keys() - {"c"})
            assert not torch.equal(before["c"], batch(slice(4, None), index)["c"])


def test_a_mask_exists_if_windows_have_missing_values():
    panel = table((20,) * 5, missing=False)
    schema = PanelSchema.from_data(panel, Cut(5, 3, split="time"))
    assert "mask" not in PanelWindows(panel, schema, "train").all()
    panel.series[0].values[18, 1] = NAN
    assert "mask" not in PanelWindows(panel, schema, "train").all()
    test = PanelWindows(panel, schema, "test").all()
    assert (~test["mask"]).sum() == 1
    assert test["x"][~test["mask"]].item() == 0


def test_missing_values_that_training_data_do_not_have_cause_a_warning():
    """Models have no indicator for it. A static value with some missing entries is still known."""
    panel, places = table(missing=False), {name: place for place, name in enumerate(COLUMNS.names)}
    schema = PanelSchema.from_data(panel, Cut(5, 3))
    test_names = {name for _, name, _ in PanelWindows(panel, schema, "test").keys}
    for one in panel:
        if one.name in test_names:
            one.values[2, places["plan"]] = one.values[0, places["height"]] = NAN
    with pytest.warns(
        UserWarning, match="test part of panel has missing values in plan, where training data have none"
    ):
        PanelWindows(panel, schema, "test")
    PanelWindows(panel, schema, "train")


def test_columns_of_one_event_are_observed_together():
    columns = Columns((Column("a", family="correlated"), Column("b", family="correlated"), *COLUMNS.columns[2:]))
    panel = table(columns=columns)
    windows = PanelWindows(panel, PanelSchema.from_data(panel, Cut(5, 3)), "train")
    mask = windows.all()["mask"]
    assert torch.equal(mask[..., 0], mask[..., 1])
    assert not mask.all()


def test_test_windows_are_one_stride_apart():
    panel = table((30,) * 10)
    schema = PanelSchema.from_data(panel, Cut(5, 4))
    starts = [[start for _, _, start in PanelWindows(panel, schema, split).keys] for split in ("test", "train")]
    assert starts[0][:6] == [0, 4, 8, 12, 16, 20]
    assert starts[1][:4] == [0, 2, 4, 6]


def test_different_windows_have_different_fingerprints():
    panel, other = table(), table(seed=1)
    schema = PanelSchema.from_data(panel, Cut(5, 3))
    arguments = [(panel, schema, "train"), (panel, schema, "test"), (other, schema, "train")]
    arguments.append((panel, PanelSchema.from_data(panel, Cut(5, 2)), "train"))
    assert len({PanelWindows(*each).fingerprint for each in arguments}) == 4
    assert PanelWindows(*arguments[0]).fingerprint == PanelWindows(table(), schema, "train").fingerprint


@pytest.mark.parametrize("split", ["time", "sequence"])
def test_rows_after_the_last_target_are_in_no_part(split):
    panel, cut = table((30,) * 6), Cut(5, 3, split=split)
    series = []
    for one in panel:
        future = np.full((7, 6), NAN)
        future[:, 2], future[:, 5] = 4.0, one.values[0, 5]  # the plan and static values are known
        times = np.concatenate([one.times, one.times[-1] + np.arange(1.0, 8)])
        series.append(replace(one, values=np.concatenate([one.values, future]), times=times))
    grown, schema = Panel(series, COLUMNS), PanelSchema.from_data(panel, cut)
    assert PanelSchema.from_data(grown, cut) == schema
    for part in ("train", "validation", "test", "all"):
        windows, others = (PanelWindows(each, schema, part) for each in (panel, grown))
        assert windows.keys == others.keys
        assert_equal(windows.all(), others.all())


def test_windows_without_an_observed_past_or_future_are_not_listed():
    panel = table((40,) * 6)
    schema = PanelSchema.from_data(panel, Cut(5, 4))
    before = PanelWindows(panel, schema, "test").keys
    (one,) = panel.only([before[2][1]])
    start = before[2][2]
    one.values[start + 5 : start + 9, :2] = NAN
    windows = PanelWindows(panel, schema, "test")
    assert windows.keys == before[:2] + before[3:]
    assert windows.left_out == (
        "1 windows without an observed target in their past or future, and up to 3 steps at the end of 2 sequences, "
        "fewer than a stride"
    )
    one.values[start + 4 : start + 9, :2] = NAN  # the past of the next window, which begins at + 4
    windows = PanelWindows(panel, schema, "test")
    assert windows.keys == before[:2] + before[4:]
    assert windows.n_unobserved == 2
    prepare_windows(windows)  # raises no error
    for one in panel:
        one.values[5:-1, :2] = NAN
    with pytest.raises(ValueError, match=r"no test window of 5 \+ 4 steps"):
        PanelWindows(panel, schema, "test")


def test_sequences_that_are_too_short_are_listed():
    data = PanelData("a", table(), PanelSchema.from_data(table(), Cut(4, 3, split="time")))
    steps = {one.name: round(0.7 * data.panel.present(one)) for one in data.panel}
    short = [name for name, count in steps.items() if count < 7]
    assert [*data.windows("train").skipped] == short
    message = f"{len(short)} sequences with fewer than 7 steps in this split"
    assert data.windows("train").left_out == f"{message} ({', '.join(f'{name}: {steps[name]}' for name in short)})"
    with pytest.warns(UserWarning, match=rf"training leaves out {message}"):
        fit = dvae.fit(dvae.method("autoregressive", width=4), data, steps=1, batch_size=2, progress=False)
    with pytest.warns(UserWarning, match=rf"forecasts leave out {message}"):
        data.windows("train").forecast(fit.model, 1)
    parts = data.parts()
    assert message in parts["train"]
    assert parts["test"].startswith(f"{len(data.windows('test'))} test windows of 4 + 3 steps")
    assert data.recut(horizon=25).parts()["test"].startswith("panel has no test window of 4 + 25 steps")


def test_whole_sequences_end_with_their_last_target():
    """Later rows are a plan; their targets do not count as missing."""
    rng = np.random.default_rng(0)
    columns = Columns((Column("y"), Column("plan", "known")))
    series = [Series(f"s{n}", rng.normal(size=(9 + n, 2))) for n in range(6)]
    future = np.column_stack([np.full(3, NAN), np.ones(3)])
    planned = [replace(one, values=np.concatenate([one.values, future])) for one in series]
    without_plan, with_plan = (PanelData.of(Panel(each, columns), cut=Cut()) for each in (series, planned))
    assert with_plan.schema == without_plan.schema
    assert not with_plan.schema.indicators
    assert_equal(with_plan.windows("train").all(), without_plan.windows("train").all())
    empty = Series("t", np.column_stack([np.full(4, NAN), np.ones(4)]))
    windows = PanelData("p", Panel([*planned, empty], columns), without_plan.schema).windows("all")
    assert len(windows) == 6
    assert "t" in windows.left_out


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda data: PanelData.of(data.panel, cut={"observed": 3}), "cut is {'observed': 3}; it must be of type Cut"),
        (lambda data: data.windows("tests"), r"unknown split 'tests' \(did you mean 'test'\?\)"),
        (lambda data: data.ahead().forecast("run"), "the model is 'run'; expected a fitted model"),
        (lambda data: data.recut(validation=0).windows("validation"), "its 1 .* the share of validation is 0"),
        (
            lambda data: data.with_data(Panel([Series("s", np.ones((9, 1)))], Columns((Column("b"),)))),
            "with the columns b, which differ",
        ),
    ],
)
def test_wrong_arguments_are_an_error(call, message):
    data = PanelData.of(Panel([Series("s", np.ones((9, 1)))], Columns((Column("a"),))))
    with pytest.raises((TypeError, ValueError), match=message):
        call(data)


def test_a_declared_season_is_repeated():
    days = np.tile(np.arange(7.0), 12)[:, None]
    columns = Columns((Column("y"),))
    data = PanelData.of(Panel([Series("s", days)], columns), cut=Cut(14, 5, split="time", season=7))
    windows = data.windows("test")
    rows = dvae.evaluate({}, windows, references=["seasonal"], progress=False)
    assert rows["seasonal"]["CRPS"].mean == 0
    assert data.whole().all()["x"].shape == (1, len(days), 1)  # a whole sequence has no season to repeat
    with pytest.raises(ValueError, match="season is 7 and observed 5; season must be at most"):
        Cut(5, 5, season=7)


@pytest.mark.parametrize("split", ["time", "sequence"])
def test_histories_are_what_a_forecast_may_know(split, monkeypatch):
    series = [np.arange(40.0)[:, None] + 100 * n for n in range(6)]
    data = PanelData.of(series, cut=Cut(6, 2, split=split))
    windows = data.windows("test")
    values, begin, end = windows.histories()
    batch = windows.all()["x"]
    for n, (_, name, start) in enumerate(windows.keys):
        history = values[begin[n] : end[n]]
        first = 0 if split == "time" else start
        assert torch.equal(history, torch.from_numpy(series[int(name)][first : start + 6]))
        assert torch.equal(history[-6:], batch[n, :6])
    assert windows.families == ["real"]
    assert windows.training.keys == data.windows("train").keys
    assert data.only(["0"]).windows("all").training is None or split == "time"
    monkeypatch.setattr("dvae.tables.windows.LOADED", 72)
    assert windows.histories() is None
    assert len(data.windows("test").training) == 9  # evenly thinned
    scores = dvae.evaluate({}, data, references=["drift", "AR"], progress=False)
    assert scores["drift"]["CRPS"].mean < 0.1
