"""Comparison of many models: error levels by simulation, and required numbers of clips and seeds."""

import doctest
import io
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from dvae.inference.evaluation import multiple_comparisons
from dvae.inference.evaluation.estimates import TwoWayErrors
from dvae.inference.evaluation.multiple_comparisons import confidence_set, holm, pairs, required


def draw_scores(random, means, clips=25, seeds=3, of_seeds=0.5, rest=0.7, alike=1.0):
    """Draw scores of models by seed and clip, with effects of the clip, of the model's seed, and residuals."""
    weights = np.ones(clips)
    common = alike * random.standard_normal(clips)
    rows = {}
    counts = seeds if isinstance(seeds, tuple) else (seeds,) * len(means)
    for place, (mean, count) in enumerate(zip(means, counts, strict=True)):
        values = mean + common + 0.5 * random.standard_normal(clips)
        if count is None:  # an untrained reference
            rows[f"m{place}"] = replace(TwoWayErrors.of(values[None], weights), seeds=0.0, rest=0.0, count=sys.maxsize)
            continue
        by_seed = of_seeds * random.standard_normal((count, 1))
        rows[f"m{place}"] = TwoWayErrors.of(values + by_seed + rest * random.standard_normal((count, clips)), weights)
    return rows


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]).tolist() == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, 0.9]).tolist() == [1.0, 1.0]
    adjusted = holm([0.02, math.nan, 0.01])
    assert math.isnan(adjusted[1])
    assert adjusted[[0, 2]].tolist() == pytest.approx([0.02, 0.02])  # of two
    assert holm([]).size == 0


@pytest.mark.parametrize(("of_seeds", "seeds"), [(0.5, (2, 2, 2)), (0.5, (None, 2, 2))])
def test_the_set_includes_the_best_models_at_its_level_and_excludes_worse_ones(of_seeds, seeds):
    """Test equally good models, with few seeds, no effect of the seed, and an untrained reference."""
    random = np.random.default_rng(1)
    repeats, included, far = 150, np.zeros(3), 0
    for seed in range(repeats):
        rows = draw_scores(random, [0.0, 0.0, 0.0, 60.0], seeds=(*seeds, 4), of_seeds=of_seeds)
        members = confidence_set(rows, draws=400, seed=seed).members
        included += [name in members for name in ("m0", "m1", "m2")]
        far += "m3" in members
    assert included.min() / repeats > 0.9 - 2.5 * math.sqrt(0.09 / repeats)
    assert far < 0.1 * repeats


def test_more_clips_do_not_replace_seeds():
    rows = draw_scores(np.random.default_rng(7), [0.0, 0.1], of_seeds=2.0, rest=0.1)
    required_sizes = required(rows["m0"], rows["m1"], seeds=(2, 10_000))
    assert math.isinf(required_sizes.clusters[2])
    assert math.isfinite(required_sizes.clusters[10_000])
    assert "no number is enough" in rendered(required_sizes.table())
    assert required_sizes.achieved < 0.5


def test_power_with_one_source_of_error_equals_the_textbook_formula():
    """If only clips vary, the test is a t test on differences, with power of the noncentral t."""
    random = np.random.default_rng(8)
    first, second = (TwoWayErrors.of(random.standard_normal((1, 30)), np.ones(30)) for _ in range(2))
    first, second = (replace(row, seeds=0.0, rest=0.0, count=sys.maxsize) for row in (first, second))
    sought, scale = 0.5, first.estimate(second).sequences * math.sqrt(30)
    required_sizes = required(first, second, difference=sought)
    clips = int(required_sizes.clusters[2])

    def power(n):
        beyond, shift = stats.t.ppf(0.975, n - 1), sought / scale * math.sqrt(n)
        return stats.nct.sf(beyond, n - 1, shift) + stats.nct.cdf(-beyond, n - 1, shift)

    assert power(clips) >= 0.8 > power(clips - 1)


def test_tables_name_the_result():
    rows = draw_scores(np.random.default_rng(9), [0.0, 5.0])
    text = rendered(pairs(rows).table())
    assert all(word in text for word in ("m0", "m1", "Holm"))
    assert "no" in rendered(confidence_set(rows, draws=100).table())
    assert "25 clusters and 3 seeds and 3 seeds" in " ".join(rendered(required(rows["m0"], rows["m1"]).table()).split())


def rendered(table):
    from rich.console import Console

    console = Console(width=150, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


def test_docstrings():
    assert doctest.testmod(multiple_comparisons).failed == 0
