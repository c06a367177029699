"""Windows hold what the table holds at their keys, drawn or listed, and nothing that is not known yet."""

import numpy as np
import pytest
import torch

import dvae
from dvae.data.sequences import HeldOutWindows, Source
from dvae.inference.evaluation.held import hold
from dvae.tables import Column, Columns, Panel, PanelData, Series
from dvae.tables.encoding import PanelSchema
from dvae.tables.protocol import Cut
from dvae.tables.windows import PanelWindows

NAN = np.nan
TOLD = Columns(
    (
        Column("y"),
        Column("n", family="count"),
        Column("plan", "known"),
        Column("price", "past"),
        Column("weather", "past", "category", classes=("rain", "sun")),
        Column("height", "static"),
    )
)


def table(lengths=(9, 14, 30, 8, 21, 17, 12, 25, 13, 10), missing=True, told=TOLD, seed=0):
    rng = np.random.default_rng(seed)
    made = []
    for n, t in enumerate(lengths):
        values = np.stack([rng.normal(size=t), rng.poisson(3, t), rng.normal(size=t), rng.normal(size=t)], 1)
        values = np.concatenate([values, rng.integers(0, 2, (t, 1)), np.full((t, 1), rng.normal())], 1)
        if missing:
            values[:, :5][rng.random((t, 5)) < 0.2] = NAN
        made.append(Series(f"s{n}", values, np.cumsum(rng.choice([1.0, 1.0, 3.0], t))))
    return Panel(made, told)


def rows(batch, n):
    """One window of a batch."""
    return {name: value[n] for name, value in batch.items()}


def wanted(panel, schema, name, start, length):
    """A window, from the table alone."""
    (one,) = panel.only([name])
    part = slice(start, start + length)
    x, c = schema.targets(one)[part], schema.context(one)[part].copy()
    if (observed := schema.cut.observed) is not None:
        # plan and its indicator; price and its indicator; weather in two coordinates, and its indicator
        price = c.shape[1] - 5
        c[observed:, [price, price + 2, price + 3]] = c[observed - 1, [price, price + 2, price + 3]]
        c[observed:, [price + 1, price + 4]] = 0
    return {"x": np.nan_to_num(x), "mask": ~np.isnan(x), "c": c, "s": schema.static(one), "d": schema.gaps(one)[part]}


def assert_same(found, expected):
    for name in expected:
        np.testing.assert_allclose(found[name].numpy(), expected[name].astype(np.float32), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("cut", [Cut(5, 3), Cut(5, 3, split="time"), Cut(4, 1, stride=2, test=0.5)], ids=str)
@pytest.mark.parametrize("split", ["train", "validation", "test", "train+validation", "all", "last"])
def test_listed_windows_hold_the_table_at_their_keys(cut, split):
    panel = table()
    schema = PanelSchema.under(panel, cut)
    windows = PanelWindows(panel, schema, split)
    batch, keys = windows.all(), windows.keys
    assert len(windows) == len(keys) == len(set(keys)) == len(batch["x"])
    for n, (part, name, start) in enumerate(keys):
        assert part == split
        assert_same(rows(batch, n), wanted(panel, schema, name, start, cut.length))
    assert isinstance(windows, Source)
    assert isinstance(windows, HeldOutWindows)


@pytest.mark.parametrize("cut", [Cut(5, 3), Cut(5, 3, split="time")], ids=str)
def test_drawn_windows_are_all_of_them_and_each_alike(cut):
    panel = table()
    schema = PanelSchema.under(panel, cut)
    windows = PanelWindows(panel, schema, "train")
    every = {}
    for place, low, last in cut.starts(panel, "train"):
        for start in range(low, last + 1):
            window = wanted(panel, schema, panel.series[place].name, start, cut.length)
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


def test_draws_are_those_of_the_generator():
    windows = PanelWindows(table(), PanelSchema.under(table(), Cut(5, 3)), "train")
    one, other, third = (windows.sample(7, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert not torch.equal(one["x"], third["x"])


def test_whole_sequences_are_padded():
    panel = table()
    schema = PanelSchema.under(panel, Cut())
    windows = PanelWindows(panel, schema, "all")
    batch = windows.all()
    assert batch["lengths"].tolist() == [len(one) for one in panel]
    for n, (_, name, start) in enumerate(windows.keys):
        length = int(batch["lengths"][n])
        found = {key: value[n] if value.dim() < 3 else value[n, :length] for key, value in batch.items()}
        assert start == 0
        assert_same(found, wanted(panel, schema, name, 0, length))
    some = PanelWindows(panel, schema, "train").sample(4, torch.Generator().manual_seed(0))
    assert len(some["x"]) == 4
    assert some["x"].shape[1] == some["lengths"].max()
    assert len(PanelWindows(panel, schema, "test").sample(50, torch.Generator())["x"]) == 2
    even = table((9, 9, 9, 9))
    assert "lengths" not in PanelWindows(even, PanelSchema.under(even, Cut()), "all").all()


def test_what_ends_with_the_present_changes_nothing_after_it_and_what_is_known_does():
    def batch(panel):
        return PanelWindows(panel, schema, "all").all()

    panel = table((8, 8, 8, 8), missing=False)
    schema = PanelSchema.under(panel, Cut(5, 3))
    before = batch(panel)
    for place, column in enumerate(TOLD.columns):
        if column.role not in ("known", "past"):
            continue
        other = table((8, 8, 8, 8), missing=False)
        for one in other:
            one.values[5:, place] = 1 - one.values[5:, place]
        after = batch(other)
        assert torch.equal(before["c"], after["c"]) == (column.role == "past")
        assert all(torch.equal(before[name], after[name]) for name in before.keys() - {"c"})
        for one in other:
            one.values[4, place] = 1 - one.values[4, place]
        assert not torch.equal(before["c"], batch(other)["c"])


def test_there_is_a_mask_where_something_of_these_windows_is_missing():
    panel = table((20,) * 5, missing=False)
    schema = PanelSchema.under(panel, Cut(5, 3, split="time"))
    assert "mask" not in PanelWindows(panel, schema, "train").all()
    panel.series[0].values[18, 1] = NAN
    assert "mask" not in PanelWindows(panel, schema, "train").all()
    test = PanelWindows(panel, schema, "test").all()
    assert (~test["mask"]).sum() == 1
    assert test["x"][~test["mask"]].item() == 0


def test_a_gap_of_which_training_knows_nothing_is_warned_of():
    """No indicator tells models of it; a static value that is missing here and there is known."""
    panel, places = table(missing=False), {name: place for place, name in enumerate(TOLD.names)}
    schema = PanelSchema.under(panel, Cut(5, 3))
    held = {name for _, name, _ in PanelWindows(panel, schema, "test").keys}
    for one in panel:
        if one.name in held:
            one.values[2, places["plan"]] = one.values[0, places["height"]] = NAN
    with pytest.warns(
        UserWarning, match="the test part of panel lacks values of plan, of which training data lack none"
    ):
        PanelWindows(panel, schema, "test")
    PanelWindows(panel, schema, "train")
    for one in panel:
        if one.name in held:
            one.values[:, places["height"]] = NAN
    with pytest.warns(UserWarning, match="lacks values of plan, height"):
        PanelWindows(panel, schema, "test")


def test_columns_that_are_one_event_are_observed_whole_or_not():
    told = Columns((Column("a", family="correlated"), Column("b", family="correlated"), *TOLD.columns[2:]))
    panel = table(told=told)
    windows = PanelWindows(panel, PanelSchema.under(panel, Cut(5, 3)), "train")
    mask = windows.all()["mask"]
    assert torch.equal(mask[..., 0], mask[..., 1])
    assert not mask.all()


def test_held_out_windows_are_a_stride_apart():
    panel = table((30,) * 10)
    schema = PanelSchema.under(panel, Cut(5, 4))
    starts = {
        split: [start for _, name, start in PanelWindows(panel, schema, split).keys] for split in ("test", "train")
    }
    assert starts["test"][:6] == [0, 4, 8, 12, 16, 20]
    assert starts["train"][:4] == [0, 2, 4, 6]
    assert PanelWindows(panel, PanelSchema.under(panel, Cut(5, 4, stride=9)), "test").keys[1][2] == 9


def test_times_go_on_behind_the_end_as_they_mostly_go():
    panel = table((9, 9, 9))
    windows = PanelWindows(panel, PanelSchema.under(panel, Cut(5, 3)), "all")
    times, _ = windows.times(11)
    for (_, name, start), found in zip(windows.keys, times, strict=True):
        (one,) = panel.only([name])
        own = one.times[start : start + 11]
        np.testing.assert_array_equal(found[: len(own)], own)
        np.testing.assert_allclose(np.diff(found[len(own) - 1 :]), np.median(np.diff(one.times)))


def test_windows_are_told_apart_by_their_fingerprint():
    panel, other = table(), table(seed=1)
    schema = PanelSchema.under(panel, Cut(5, 3))
    made = [(panel, schema, "train"), (panel, schema, "test"), (other, schema, "train")]
    made.append((panel, PanelSchema.under(panel, Cut(5, 2)), "train"))
    assert len({PanelWindows(*each).fingerprint for each in made}) == 4
    assert PanelWindows(*made[0]).fingerprint == PanelWindows(table(), schema, "train").fingerprint


def test_a_part_without_windows_is_refused():
    panel = table()
    said = r"panel has no validation window of 5 \+ 3 steps; .* its 10 .* and validation has a share of 0"
    with pytest.raises(ValueError, match=said):
        PanelWindows(panel, PanelSchema.under(panel, Cut(5, 3, validation=0)), "validation")


@pytest.mark.parametrize("split", ["time", "sequence"])
def test_rows_behind_the_last_target_are_of_no_part(split):
    panel, cut = table((30,) * 6), Cut(5, 3, split=split)
    longer = [np.concatenate([one.values, np.full((7, 6), NAN)]) for one in panel]
    for values in longer:
        values[30:, 2] = 4.0  # of the future, its plan is known
        values[:, 5] = values[0, 5]
    times = [np.concatenate([one.times, one.times[-1] + np.arange(1.0, 8)]) for one in panel]
    grown = Panel([Series(f"s{n}", *both) for n, both in enumerate(zip(longer, times, strict=True))], TOLD)
    schema = PanelSchema.under(panel, cut)
    assert PanelSchema.under(grown, cut) == schema
    for part in ("train", "validation", "test", "all"):
        windows, others = (PanelWindows(each, schema, part) for each in (panel, grown))
        assert windows.keys == others.keys
        batch, again = windows.all(), others.all()
        assert all(torch.equal(batch[name], again[name]) for name in batch)


def test_windows_of_whose_future_nothing_is_known_are_not_listed():
    panel = table((40,) * 6)
    schema = PanelSchema.under(panel, Cut(5, 4))
    before = PanelWindows(panel, schema, "test").keys
    (one,) = panel.only([before[2][1]])
    start = before[2][2]
    one.values[start + 5 : start + 9, :2] = NAN
    windows = PanelWindows(panel, schema, "test")
    assert windows.keys == before[:2] + before[3:]
    assert windows.left_out == "1 windows, in whose past or future no target was observed"
    one.values[start + 4 : start + 9, :2] = NAN  # the past of the next one, which begins at + 4
    windows = PanelWindows(panel, schema, "test")
    assert windows.keys == before[:2] + before[4:]
    assert windows.untold == 2
    hold(windows)  # which refuses such windows
    for one in panel:
        one.values[5:-1, :2] = NAN
    with pytest.raises(ValueError, match=r"no test window of 5 \+ 4 steps"):
        PanelWindows(panel, schema, "test")


def test_sequences_that_are_too_short_are_listed():
    panel = table()
    windows = PanelWindows(panel, PanelSchema.under(panel, Cut(8, 3)), "all")
    steps = {one.name: panel.present(one) for one in panel}
    assert windows.skipped == {name: steps[name] for name in ("s0", "s3", "s9")}
    named = ", ".join(f"{name}: {steps[name]}" for name in windows.skipped)
    assert windows.left_out == f"3 sequences, which have fewer than 11 steps there ({named})"
    assert PanelWindows(panel, PanelSchema.under(panel, Cut()), "test").left_out == ""
    data = PanelData("a", table(), PanelSchema.under(table(), Cut(4, 3, split="time")))
    steps = {one.name: data.panel.present(one) for one in data.panel}
    short = [name for name, count in steps.items() if round(0.7 * count) < 7]
    assert [*data.windows("train").skipped] == short
    named = ", ".join(f"{name}: {round(0.7 * steps[name])}" for name in short)
    with pytest.warns(UserWarning, match=rf"training leaves out .* fewer than 7 steps there \({named}\)"):
        fit = dvae.fit(dvae.method("autoregressive", width=4), data, steps=1, batch_size=2, progress=False)
    with pytest.warns(UserWarning, match=rf"forecasts leave out .* fewer than 7 steps there \({named}\)"):
        data.windows("train").forecast(fit.model, 1)
    said = data.parts()
    assert list(said) == ["train", "validation", "test"]
    assert f"{len(short)} sequences, which have fewer than 7 steps there" in said["train"]
    assert said["test"].startswith(f"{len(data.windows('test'))} test windows of 4 + 3 steps")
    assert data.recut(horizon=25).parts()["test"].startswith("panel has no test window of 4 + 25 steps")


def test_whole_sequences_end_with_their_last_target():
    """Rows behind it are a plan, of which nothing is missing."""
    rng = np.random.default_rng(0)
    columns = Columns((Column("y"), Column("plan", "known")))
    series = [Series(f"s{n}", rng.normal(size=(9 + n, 2))) for n in range(6)]
    planned = []
    for one in series:
        future = np.column_stack([np.full(3, np.nan), rng.normal(size=3)])
        planned.append(Series(one.name, np.concatenate([one.values, future])))
    plain, more = (PanelData.of(Panel(each, columns), cut=Cut()) for each in (series, planned))
    assert more.schema == plain.schema
    assert not more.schema.indicators
    ours, theirs = more.windows("train").all(), plain.windows("train").all()
    assert "mask" not in ours
    for name in theirs:
        assert torch.equal(ours[name], theirs[name]), name
    nothing = Series("t", np.column_stack([np.full(4, np.nan), np.ones(4)]))
    windows = PanelData("p", Panel([*planned, nothing], columns), plain.schema).windows("all")
    assert len(windows) == 6
    assert "t" in windows.left_out


def test_a_panel_of_other_columns_is_refused():
    first, second = Columns((Column("a"), Column("b", "known"))), Columns((Column("b", "known"), Column("a")))
    panel = Panel([Series(f"s{n}", np.ones((5, 2)) * n) for n in range(5)], first)
    data = PanelData.of(panel, cut=Cut())
    assert data.on(panel).panel is panel
    with pytest.raises(ValueError, match="panel of b, a, whose columns are another thing than a, b"):
        data.on(Panel(panel.series, second))


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda panel: PanelData.of(panel, cut={"observed": 3}), "cut is {'observed': 3}; it must be of type Cut"),
        (lambda panel: PanelData.of(panel).windows("tests"), r"unknown split 'tests' \(did you mean 'test'\?\)"),
        (lambda panel: PanelData.of(panel).ahead().forecast("run"), "the model is 'run'; expected a fitted model"),
        (lambda panel: PanelData.of(panel).ahead().forecast(torch.nn.Identity(), "4"), "samples is '4'; it must be a"),
    ],
)
def test_arguments_of_another_type_are_named(call, said):
    panel = Panel([Series("s", np.ones((9, 1)))], Columns((Column("a"),)))
    with pytest.raises((TypeError, ValueError), match=said):
        call(panel)


def test_a_season_that_is_told_is_repeated():
    days = np.tile(np.arange(7.0), 12)[:, None]
    columns = Columns((Column("y"),))
    data = PanelData.of(Panel([Series("s", days)], columns), cut=Cut(14, 5, split="time", season=7))
    windows = data.windows("test")
    rows = dvae.evaluate({}, windows, references=["seasonal"], progress=False)
    assert rows["seasonal"]["CRPS"].mean == 0
    with pytest.raises(ValueError, match="season is 7 and observed 5; a period"):
        Cut(5, 5, season=7)
