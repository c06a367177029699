"""Shared code of studies: rows over seeds, stored measurements, and archives."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from benchmarks.studies import engine
from dvae.inference.evaluation.estimates import TwoWayErrors


def row(*values, clips="aab", weights=(1, 3, 2), **options):
    runs = [{"clips": [*clips], "weights": [*weights], "rows": {"ours": {"ADE": each}}} for each in values]
    return engine.Row(runs, **options)


def test_sequences_count_by_their_weights_and_errors_are_over_clips():
    estimate = row([1.0, 5.0, 2.0], [2.0, 6.0, 4.0]).estimate("ADE")
    assert estimate == TwoWayErrors.of(np.array([[4.0, 2.0], [5.0, 4.0]]), np.array([4.0, 2.0])).estimate()


def test_a_sequence_with_a_missing_score_is_left_out_for_all_seeds():
    whole, part = row([1.0, None, 2.0], [2.0, 6.0, 4.0]), row([1.0, 2.0], [2.0, 4.0], clips="ab", weights=(1, 2))
    assert whole.estimate("ADE") == part.estimate("ADE")
    assert row([None] * 3).estimate("ADE") is None
    assert row([1.0, 2.0, 3.0]).format_score("FDE") == "–"


def test_a_reference_has_no_error_over_seeds():
    reference = row([1.0, 5.0, 2.0], trained=False)
    assert engine.cell(reference.estimate("ADE")).count("±") == 1
    model = row([1.5, 5.0, 2.0], [1.0, 5.0, 3.0])
    assert model.estimate("ADE", reference).seeds == pytest.approx(model.estimate("ADE").seeds)


def test_a_measurement_runs_once(tmp_path):
    calls = []
    run = lambda case, seed, out: calls.append((case, seed)) or {"seconds": 2.0 + seed, "score": float("nan")}  # noqa: E731
    for seeds in ((0,), (0, 1)):
        engine.measure(tmp_path, ["KL 0.1, no w"], seeds, run)
    assert calls == [("KL 0.1, no w", 0), ("KL 0.1, no w", 1)]
    rows = engine.read(tmp_path, ["KL 0.1, no w", "KL 0.1"])
    assert rows.keys() == {"KL 0.1, no w"}
    assert engine.budget(rows.values(), 5) == "5 steps of training, 2 to 3 s of processor time."
    assert rows["KL 0.1, no w"].numbers("score") == "–"


def test_an_archive_has_the_same_bytes_for_the_same_measurements(tmp_path):
    measurements = {name: {"clips": {"a": 2}, "rows": {name: {"ADE": [1.0]}}} for name in "xy"}
    archives = [engine.Archive(tmp_path / f"{order}.zip") for order in ("xy", "yx")]
    for archive in archives:
        assert archive.names == []
        for name in archive.file.stem:
            archive.add(name, measurements[name])
        assert archive.names == ["x", "y"]
        (read,) = archive.read(["y"])
        assert engine.Row([read], "y").values("ADE").tolist() == [[1.0]]
        assert (read["clips"], read["weights"]) == (["a"], [2])
    assert archives[0].file.read_bytes() == archives[1].file.read_bytes()


def test_scores_are_added_to_one_archive_at_once(tmp_path):
    names = [*"abcdefgh"]
    with ThreadPoolExecutor(len(names)) as pool:
        list(pool.map(lambda name: engine.Archive(tmp_path / "scores.zip").add(name, {"clips": {"a": 2}}), names))
    assert engine.Archive(tmp_path / "scores.zip").names == names


def test_settings_have_tuples_at_every_depth(tmp_path):
    (tmp_path / "a.toml").write_text("[cases]\nwide = { widths = [[1, 2], [3]] }\n")
    assert engine.settings(str(tmp_path / "a.py")) == {"cases": {"wide": {"widths": ((1, 2), (3,))}}}
