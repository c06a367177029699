"""Windows for forecasts after the end of a table: one for each sequence, with its past and known covariates."""

import numpy as np
import pytest

from dvae.tables import Column, Columns, Panel, Series
from dvae.tables.ahead import ahead
from dvae.tables.encoding import PanelSchema
from dvae.tables.protocol import Cut
from dvae.tables.windows import PanelWindows

NAN = np.nan
PLAIN = Columns((Column("y"), Column("price", "past")))
PLANNED = Columns((Column("y"), Column("price", "past"), Column("plan", "known"), Column("holiday", "known")))
CUT = Cut(4, 3, test=0.25)


def table(columns, future=0, lengths=(12, 9, 15, 10), uneven=False):
    rng = np.random.default_rng(0)
    series = []
    for n, t in enumerate(lengths):
        values = rng.normal(size=(t + future, len(columns.columns)))
        values[t:, :2] = NAN
        times = np.cumsum(rng.choice([1.0, 2.0, 2.0, 5.0], t + future)) if uneven else np.arange(t + future) * 10.0
        series.append(Series(f"s{n}", values, times))
    return Panel(series, columns)


def test_the_future_begins_after_the_last_target():
    panel = table(PLAIN)
    schema = PanelSchema.from_data(panel, CUT)
    windows = ahead(panel, schema)
    batch = windows.all()
    for n, series in enumerate(panel):
        np.testing.assert_array_equal(batch["x"][n, :4, 0], series.values[-4:, 0])
        assert windows.keys[n][1:] == (series.name, len(series) - 4)
    assert batch["mask"][:, :4].all()
    assert not batch["mask"][:, 4:].any()
    for horizon in (1, 7):
        assert ahead(panel, schema, horizon).all()["x"].shape == (4, 4 + horizon, 1)
    times, _ = windows.times(7)
    np.testing.assert_array_equal(times[0], np.arange(8, 15) * 10.0)


def test_the_past_equals_that_of_a_test_window():
    panel = table(PLANNED, future=3, uneven=True)
    for one in panel:
        one.values[3:-3, 1:3] = NAN
    schema = PanelSchema.from_data(panel, CUT)
    batch = ahead(panel, schema).all()
    filled = Panel([Series(one.name, np.nan_to_num(one.values), one.times) for one in panel], PLANNED)
    for one, other in zip(filled, panel, strict=True):
        one.values[:, 1:] = other.values[:, 1:]
    test = PanelWindows(filled, schema, "last").all()
    np.testing.assert_array_equal(batch["c"], test["c"])
    np.testing.assert_array_equal(batch["d"], test["d"])
    assert (batch["d"][:, 0] != 1).any()
    assert (batch["c"][:, 0, 0] != 0).any()  # the last value, from before the window, and not the mean


def test_future_rows_provide_the_known_covariates():
    panel = table(PLANNED, future=3)
    schema = PanelSchema.from_data(panel, CUT)
    batch = ahead(panel, schema).all()
    for n, one in enumerate(panel):
        plan = (one.values[-7:, 2] - schema.means["plan"]) / schema.scales["plan"]
        np.testing.assert_allclose(batch["c"][n, :, 2], plan, rtol=1e-5)
    assert ahead(panel, schema, 2).all()["c"].shape[1] == 6


@pytest.mark.parametrize("future", [0, 2])
def test_missing_future_covariates_are_named_with_their_sequence(future):
    panel = table(PLANNED, future)
    with pytest.raises(
        ValueError,
        match=f"forecast of 3 steps needs future values of plan, holiday, but sequence 's0' has {future} rows "
        "after its last target at row 11; append rows with these",
    ):
        ahead(panel, PanelSchema.from_data(panel, CUT))
    panel = table(PLANNED, 3)
    panel.series[2].values[-1, 3] = NAN
    with pytest.warns(
        UserWarning, match=r"1 of 4 .* needs future values of holiday, .* 's2' has 3 rows .* append rows with it"
    ):
        windows = ahead(panel, PanelSchema.from_data(panel, CUT))
    assert [name for _, name, _ in windows.keys] == ["s0", "s1", "s3"]


def test_sequences_without_a_forecast_are_named_and_the_others_are_forecast():
    panel = table(PLAIN)
    with pytest.raises(ValueError, match="whole sequences have no horizon"):
        ahead(panel, PanelSchema.from_data(panel, Cut()))
    schema = PanelSchema.from_data(panel, CUT)
    panel.series[1].values[3:, 0] = NAN
    message = "sequence 's1' has 3 steps up to its last target; a forecast observes 4"
    with pytest.warns(UserWarning, match=f"1 of 4 sequences have no forecast: {message}"):
        windows = ahead(panel, schema)
    assert [name for _, name, _ in windows.keys] == ["s0", "s2", "s3"]
    with pytest.raises(ValueError, match=message):
        ahead(panel.only(["s1"]), schema)
