"""Encoding of tables for models; nothing in it depends on test data."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dvae.distributions import FAMILIES
from dvae.distributions.product import Product
from dvae.tables import Column, Columns, Panel, Series
from dvae.tables.ahead import ahead
from dvae.tables.encoding import PanelSchema
from dvae.tables.protocol import Cut
from dvae.tables.windows import PanelWindows

NAN = np.nan
KINDS = ("u", "v", "w")
COLUMNS = Columns(
    (
        Column("riders", family="count", unit="people"),
        Column("plan", "known"),
        Column("kind", family="category", classes=KINDS),
        Column("weather", "past", "category", classes=("rain", "sun")),
        Column("temp", unit="°C"),
        Column("price", "past"),
        Column("height", "static"),
        Column("open", family="binary"),
        Column("town", "static", "category", classes=("a", "b")),
        Column("sunny", "known", "category", classes=("no", "yes")),
    )
)

WITH_MISSING = tuple(name for name in COLUMNS.names if name not in ("height", "town", "sunny"))
"""Columns with missing values."""


def table(n=6, t=12, seed=0, missing=True, times=None):
    rng = np.random.default_rng(seed)
    series = []
    for sequence in range(n):
        columns = {"plan": rng.normal(3, 2, t), "temp": rng.normal(20, 5, t), "price": rng.normal(-3, 0.1, t)}
        columns |= {"riders": rng.poisson(4, t), "kind": rng.integers(0, 3, t), "height": np.full(t, rng.normal())}
        columns |= {name: rng.integers(0, 2, t) for name in ("weather", "open", "sunny")}
        columns["town"] = np.full(t, sequence % 2)
        values = np.stack([columns[name] for name in COLUMNS.names], 1).astype(float)
        if missing:
            indices = [COLUMNS.names.index(name) for name in WITH_MISSING]
            values[:, indices] = np.where(rng.random((t, len(indices))) < 0.2, NAN, values[:, indices])
        series.append(Series(f"s{sequence}", values, times))
    return Panel(series, COLUMNS)


CUT = Cut(5, 3)


def column(panel, name, parts):
    values = np.concatenate([panel.series[n].values[:, COLUMNS.names.index(name)] for n in parts])
    return values[~np.isnan(values)]


def test_logarithms_are_standardised_and_provide_the_typical_value():
    """A nearly constant column keeps its scale; zeros are read as the smallest positive value."""
    columns = Columns((Column("flow", family="power"), Column("flat", family="positive")))
    rng = np.random.default_rng(0)
    values = np.stack([rng.lognormal(1, 2, 9), 3 + 1e-15 * rng.normal(size=9)], 1)
    values[0, 0], values[1, 0] = 0, NAN
    panel = Panel([Series(f"s{n}", values) for n in range(4)], columns)
    flow, flat = PanelSchema.from_data(panel, Cut()).units["x"]
    smallest = values[2:, 0].min()
    logarithms = np.log([smallest, *values[2:, 0]])
    assert (flow.floor, flow.level, flow.spread) == pytest.approx((smallest, logarithms.mean(), logarithms.std()))
    assert flow.typical == pytest.approx(np.exp(flow.level))
    assert (flat.level, flat.spread, flat.typical) == pytest.approx((np.log(3), 1.0, 3.0))


def test_a_column_far_from_zero_is_standardised():
    """This includes 1e9 + N(0, 1). A constant with rounding errors keeps scale 1."""
    noise = np.random.default_rng(0).normal(size=(4, 9, 3))
    values = np.array([1e9, 101325, 0.1]) + np.array([1.0, 0.01, 1e-17]) * noise
    columns = Columns(tuple(map(Column, "abc")))
    schema = PanelSchema.from_data(Panel([Series(f"s{n}", one) for n, one in enumerate(values)], columns), Cut())
    scales = [schema.scales[name] for name in "abc"]
    assert scales == pytest.approx([*(noise[:, :, :2].std((0, 1)) * [1, 0.01]), 1.0], rel=0.2)
    assert len(np.unique(PanelWindows(Panel([Series("s", values[0])], columns), schema, "all").all()["x"][..., 1])) == 9


@pytest.mark.parametrize(
    ("family", "values", "message"),
    [
        ("positive", 1e9 + np.arange(9.0), r"has mean 1e\+09 and standard deviation 2\.58, .* the family 'real'"),
        ("real", 1e-40 * np.arange(9.0), r"column 'x' is 2\.58199e-40; .* multiply the values"),
    ],
)
def test_targets_that_float32_does_not_resolve_are_an_error(family, values, message):
    panel = Panel([Series(f"s{n}", values[:, None]) for n in range(4)], Columns((Column("x", family=family),)))
    with pytest.raises(ValueError, match=message):
        PanelSchema.from_data(panel, Cut())


@pytest.mark.parametrize(("family", "center", "count"), [("real", "6000000", 3), ("positive", "0", 4)])
def test_sequences_that_lose_precision_in_float32_are_named(family, center, count):
    levels = [3e6, 5e6, 6e6, 7e6, 9e6]
    columns = Columns((Column("x", family=family), Column("y")))
    values = [np.stack([level + 0.1 * np.arange(9), np.arange(9.0)], 1) for level in levels]
    values[4][:, 0] = levels[4]  # a constant loses nothing
    series = [Series(f"s{n}", sequence, split="train") for n, sequence in enumerate(values)]
    with pytest.warns(UserWarning, match=rf"column 'x' varies .* from {center}.* in {count} of 5 .* such as 's0'; sub"):
        PanelSchema.from_data(Panel(series, columns), Cut())


def test_units_come_from_the_training_sequences():
    panel = table()
    schema = PanelSchema.from_data(panel, CUT)
    parts = [place for place, _, _ in CUT.starts(panel, "train")]
    assert 0 < len(parts) < len(panel)
    for name in ("plan", "temp", "price", "height"):
        observed = column(panel, name, parts)
        assert schema.means[name] == pytest.approx(observed.mean(), rel=1e-12)
        assert schema.scales[name] == pytest.approx(observed.std(), rel=1e-12)
    assert schema.means["riders"] == 0
    assert schema.scales["riders"] == pytest.approx(column(panel, "riders", parts).mean())
    means, scales, typical, floor, _, _ = map(list, zip(*schema.units["x"], strict=True))
    assert not any(floor)
    names = ["riders", "kind", "kind", "kind", "temp", "open"]
    assert means == [schema.means.get(name, 0) for name in names]
    assert scales == [schema.scales.get(name, 1) for name in names]
    assert typical == [scales[0], *means[1:]]
    share = column(panel, "open", parts).mean()
    assert (means[-1], scales[-1]) == (share, pytest.approx((share * (1 - share)) ** 0.5))
    assert schema.coordinates == ["riders", "kind=u", "kind=v", "kind=w", "temp", "open"]
    assert schema.sizes == {"x": 6, "c": 1 + 1 + 2 + 1 + 1 + 1 + 2, "s": 1 + 2, "r": 1}
    assert schema.with_missing == WITH_MISSING


def test_guides_read_indicators_if_training_data_have_missing_targets():
    schema = PanelSchema.from_data(table(), CUT)
    assert schema.indicators == ("x",)
    assert schema.together == [0, 1, 1, 1, 2, 3]
    assert PanelSchema.from_data(table(missing=False), CUT).indicators == ()
    assert replace(schema, with_missing=("plan", "weather", "price")).indicators == ()  # as an older run has it
    correlated = (Column("a", family="correlated"), Column("b", family="correlated"))
    assert PanelSchema(columns=Columns(correlated), means={}, scales={}).together == [0, 0]


def altered(panel, split, cut):
    """Return the panel with other values, classes, times and gaps in its test steps."""
    rng = np.random.default_rng(9)
    trained = {place: last + cut.length for place, _, last in cut.starts(panel, split)}
    series = []
    for place, one in enumerate(panel.series):
        values = one.values.copy()
        later = np.arange(len(one)) >= trained.get(place, 0)
        for name in ("riders", "plan", "temp", "price"):
            values[later, COLUMNS.names.index(name)] = rng.integers(50, 90, later.sum())
        for name in ("kind", "weather", "open", "sunny"):
            values[later, COLUMNS.names.index(name)] = np.where(rng.random(later.sum()) < 0.5, NAN, 1)
        times = one.times.copy()
        times[later] = times[later] + 100 * np.cumsum(rng.random(later.sum()))
        series.append(replace(one, values=values, times=times))
    return replace(panel, series=series)


@pytest.mark.parametrize(("cut", "missing"), [(CUT, False), (Cut(5, 3, split="time", test=0.3), True)])
def test_training_windows_do_not_depend_on_test_data(cut, missing):
    panel = table(t=40, missing=missing, times=np.arange(40.0))
    other = altered(panel, "train", cut)
    assert other.fingerprint() != panel.fingerprint()
    schema = PanelSchema.from_data(panel, cut)
    assert PanelSchema.from_data(other, cut) == schema
    windows, others = (PanelWindows(data, schema, "train") for data in (panel, other))
    assert windows.keys == others.keys
    batch, other_batch = windows.all(), others.all()
    assert batch.keys() == other_batch.keys()
    assert all(torch.equal(batch[name], other_batch[name]) for name in batch)


def by_hand(sequence, schema):
    """Return c, computed row by row."""
    last, rows = {}, []
    for row in sequence.values:
        entries = []
        for value, spec in zip(row, schema.columns.columns, strict=True):
            if spec.role not in ("known", "past"):
                continue
            current = last[spec.name] = last.get(spec.name, NAN) if np.isnan(value) else value
            if spec.family == "category":
                entries += [float(current == n) for n in range(len(spec.classes))]
            else:
                entries.append(np.nan_to_num((current - schema.means[spec.name]) / schema.scales[spec.name]))
            if spec.name in schema.with_missing:
                entries.append(float(not np.isnan(value)))
        rows.append(entries)
    return np.array(rows)


def test_covariates_repeat_their_last_value_or_the_mean_and_classes_are_one_hot():
    panel = table(seed=3)
    for place in (0, 1):  # nothing at first, and nothing at all
        panel.series[place].values[: (4, 12)[place], [1, 3, 5]] = NAN
    schema = PanelSchema.from_data(panel, CUT)
    for one in panel:
        np.testing.assert_allclose(schema.context(one), by_hand(one, schema), rtol=1e-12, atol=1e-12)
        kinds, x = one.values[:, 2], schema.targets(one)
        eye = np.where(np.isnan(kinds)[:, None], NAN, np.eye(3)[np.nan_to_num(kinds).astype(int)])
        np.testing.assert_array_equal(x, np.column_stack([one.values[:, 0], eye, one.values[:, [4, 7]]]))


def test_static_values_are_constant_within_a_sequence():
    panel = table()
    height, town = COLUMNS.names.index("height"), COLUMNS.names.index("town")
    panel.series[0].values[:5, height] = NAN
    panel.series[1].values[:, [height, town]] = NAN
    schema = replace(PanelSchema.from_data(panel, CUT), with_missing=("weather", "price", "plan", "height"))
    mean, scale = schema.means["height"], schema.scales["height"]
    np.testing.assert_allclose(
        schema.static(panel.series[0]), [(panel.series[0].values[-1, height] - mean) / scale, 1, 1, 0]
    )
    np.testing.assert_allclose(schema.static(panel.series[1]), [0, 0, 0, 0])
    panel.series[2].values[3, height] += 1
    with pytest.raises(ValueError, match="'height' is static, but changes within sequence 's2'"):
        schema.static(panel.series[2])


@pytest.mark.parametrize(
    ("times", "step"),
    [
        (None, 0),
        (np.arange("2020-01", "2022-01", dtype="datetime64[M]").astype("datetime64[s]").astype(float), 0),
        (np.cumsum([1.0, 2, 2, 4] * 6), 2),
        (np.cumsum([2.0] * 23 + [0.01]), 2),
    ],
    ids=["none", "months", "uneven", "near"],
)
def test_gaps_exist_if_steps_are_uneven(times, step):
    panel = table(t=24, times=times)
    schema = PanelSchema.from_data(panel, CUT)
    assert schema.step == step
    assert ("d" in schema.sizes) == bool(step)
    if step:
        gaps = schema.gaps(panel.series[0])
        assert gaps.shape == (24, 1)
        np.testing.assert_allclose(gaps[1:, 0], np.diff(times) / step)
        assert gaps[0] == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": {}}, "no mean and scale of height, plan, price"),
        (
            {"scales": dict.fromkeys(("plan", "height", "price"), 0.0)},
            r"scales\['plan'\] is 0.0; it must be finite and",
        ),
        ({"with_missing": ()}, "no indicator of price, weather"),
        ({"step": -1.0}, "step is -1.0"),
    ],
)
def test_an_incomplete_schema_is_an_error(change, message):
    with pytest.raises(ValueError, match=message):
        replace(PanelSchema.from_data(table(), CUT), **change)


def test_columns_of_a_family_share_a_distribution_and_each_category_has_one():
    columns = Columns(
        (
            Column("real", family="category", classes=KINDS),  # may have the name of a family
            Column("a"),
            Column("n", family="count"),
            Column("b"),
            Column("l", family="category", classes=("u", "v")),
        )
    )
    distribution = PanelSchema(columns=columns).emission
    assert isinstance(distribution, Product)
    indices = {(0, 1, 2): "category", (3, 5): "real", (4,): "count", (6, 7): "category"}
    assert dict(distribution.parts) == {index: FAMILIES[name] for index, name in indices.items()}
    for family, spec in FAMILIES.items():
        classes = ("u", "v") if family == "category" else ()
        assert PanelSchema(columns=Columns((Column("y", family=family, classes=classes),))).emission == spec


def test_training_parts_without_values_or_windows_are_an_error():
    panel = table()
    for place, _, _ in CUT.starts(panel, "train"):
        panel.series[place].values[:, COLUMNS.names.index("temp")] = NAN
    with pytest.raises(ValueError, match="column 'temp' has no value in the training part"):
        PanelSchema.from_data(panel, CUT)
    with pytest.raises(ValueError, match=r"no training window of 50 \+ 3 steps: its longest sequence has 12 steps"):
        PanelSchema.from_data(panel, Cut(50, 3))


LAGGED = Columns(
    (
        Column("riders", family="count"),
        Column("kind", family="category", classes=KINDS),
        Column("price", family="positive"),
    ),
    lags=(3, 5),
)


def lagged(t=12, missing=True, seed=0):
    rng = np.random.default_rng(seed)
    values = np.stack([rng.poisson(4, t), rng.integers(0, 3, t), rng.gamma(2, 1, t)], 1).astype(float)
    if missing:
        values[rng.random(values.shape) < 0.2] = NAN
    return Panel([Series(f"s{n}", values if n == 0 else rng.permutation(values)) for n in range(6)], LAGGED)


def test_lagged_values_are_relative_to_the_steps_up_to_them():
    panel = lagged()
    schema = PanelSchema.from_data(panel, CUT)
    sequence = panel.series[0]
    x = schema.targets(sequence).copy()
    x[:, 0], x[:, 4] = np.log1p(x[:, 0]), np.log(x[:, 4])
    expected = np.zeros((len(x), 2, 2, 5))
    for t in range(len(x)):
        for place, lag in enumerate(LAGGED.lags):
            recent = x[max(t - lag - CUT.observed + 1, 0) : t - lag + 1] if t >= lag else x[:0]
            for d in range(5):
                cells = recent[~np.isnan(recent[:, d]), d]
                if len(recent) and not np.isnan(recent[-1, d]):
                    scale = cells.std()
                    expected[t, place, :, d] = (cells[-1] - cells.mean()) / scale if scale > 1e-12 else 0.0, 1.0
    context = schema.context(sequence)
    assert context.shape[1] == schema.sizes["c"] == 20
    assert context == pytest.approx(expected.reshape(len(x), -1), abs=1e-9)
    assert 0 < context[:, 5:10].mean() < 1  # indicators


def test_lags_read_nothing_of_the_future():
    panel = lagged(missing=False)
    schema = PanelSchema.from_data(panel, CUT)
    windows = PanelWindows(panel, schema, "test")
    (_, name, start), first = windows.keys[-1], windows.all()["c"][-1]
    index = [sequence.name for sequence in panel].index(name)
    panel.series[index].values[start + CUT.observed :, [0, 2]] += 3
    assert torch.equal(PanelWindows(panel, schema, "test").all()["c"][-1], first)
    panel.series[index].values[start + CUT.observed - 1, 0] += 3
    assert not torch.equal(PanelWindows(panel, schema, "test").all()["c"][-1], first)


def test_lags_are_known_beyond_the_table_up_to_the_shortest_one():
    panel = lagged(missing=False)
    schema = PanelSchema.from_data(panel, CUT)
    assert ahead(panel, schema).all()["c"][:, -1, 5:10].all()  # indicators of the first lag
    with pytest.raises(ValueError, match="lag 3 is below the horizon 4, so its values are unknown"):
        ahead(panel, schema, 4)
