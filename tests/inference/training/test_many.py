"""Many models at once: levels hold by simulation, and what it takes to tell two apart is what it then took."""

import doctest
import io
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from dvae.inference.evaluation.estimates import Crossed
from dvae.inference.training import many
from dvae.inference.training.many import confidence_set, holm, pairs, required


def drawn(random, means, clips=25, seeds=3, of_seeds=0.5, rest=0.7, alike=1.0):
    """Scores of models by seed and clip: of the clip, of the model's seed, and a rest of each model's own."""
    weights = np.ones(clips)
    common = alike * random.standard_normal(clips)
    rows = {}
    counts = seeds if isinstance(seeds, tuple) else (seeds,) * len(means)
    for place, (mean, count) in enumerate(zip(means, counts, strict=True)):
        values = mean + common + 0.5 * random.standard_normal(clips)
        if count is None:  # a reference: nothing is trained
            rows[f"m{place}"] = replace(Crossed.of(values[None], weights), seeds=0.0, rest=0.0, count=sys.maxsize)
            continue
        by_seed = of_seeds * random.standard_normal((count, 1))
        rows[f"m{place}"] = Crossed.of(values + by_seed + rest * random.standard_normal((count, clips)), weights)
    return rows


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]).tolist() == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, 0.9]).tolist() == [1.0, 1.0]
    found = holm([0.02, math.nan, 0.01])
    assert math.isnan(found[1])
    assert found[[0, 2]].tolist() == pytest.approx([0.02, 0.02])  # of two
    assert holm([]).size == 0


def test_holm_keeps_its_level_for_all_pairs_at_once():
    random = np.random.default_rng(0)
    wrong = sum(min(pairs(drawn(random, [0.0] * 4)).p_values.values()) < 0.1 for _ in range(300))
    assert wrong / 300 < 0.1 + 2 * math.sqrt(0.09 / 300)


@pytest.mark.parametrize(
    ("of_seeds", "seeds"), [(0.1, (3, 3, 3)), (0.5, (2, 2, 2)), (0.1, (2, 10, 10)), (0.5, (None, 2, 2))]
)
def test_the_best_models_are_in_the_set_with_its_level_and_worse_ones_are_left_out(of_seeds, seeds):
    """Each of those that are equally good, whether few seeds tell of it, or none, as of what is not trained."""
    random = np.random.default_rng(1)
    repeats, held, far = 150, np.zeros(3), 0
    for seed in range(repeats):
        rows = drawn(random, [0.0, 0.0, 0.0, 60.0], seeds=(*seeds, 4), of_seeds=of_seeds)
        members = confidence_set(rows, draws=400, seed=seed).members
        held += [name in members for name in ("m0", "m1", "m2")]
        far += "m3" in members
    assert held.min() / repeats > 0.9 - 2.5 * math.sqrt(0.09 / repeats)
    assert far < 0.1 * repeats


@pytest.mark.parametrize("seeds", [(3, 3), (2, 10)], ids=str)
def test_power_is_that_of_the_test_that_is_used(seeds):
    """With the true variances, at the numbers that there are: Student's t with degrees of freedom that are measured."""
    random = np.random.default_rng(11)
    clips, of_seeds, rest, difference, repeats = 40, 0.5, 0.3, 1.3, 600
    found = sum(
        pairs(drawn(random, [0.0, difference], clips, seeds, of_seeds, rest)).p_values["m0", "m1"] < 0.05
        for _ in range(repeats)
    )
    exact = []
    for place, count in enumerate(seeds):
        variance = 0.25 + rest**2 / count  # of a clip's mean, what is the model's own
        own = np.sqrt(2) * np.sin(2 * np.pi * (place + 1) * np.arange(clips) / clips)  # of mean 0, variance 1, apart
        deviations = own * math.sqrt(variance * (clips - 1) / clips) / clips
        exact.append(
            Crossed(
                place * difference, deviations, (of_seeds**2 + rest**2 / clips) / count, rest**2 / clips / count, count
            )
        )
    assert required(*exact).achieved == pytest.approx(found / repeats, abs=3 * math.sqrt(0.25 / repeats))


def test_a_set_of_these_very_weights_is_smaller_than_one_over_seeds():
    rows = drawn(np.random.default_rng(2), [0.0, 0.9, 1.2, 1.5], of_seeds=1.0)
    over_seeds, here = confidence_set(rows), confidence_set(rows, over_seeds=False)
    assert set(here.members) < set(over_seeds.members)
    best = min(rows, key=lambda name: rows[name].mean)
    assert here.members[0] == over_seeds.members[0] == best
    assert list(here.p_values.values()) == sorted(here.p_values.values())


def test_a_model_of_two_seeds_hides_none_that_is_surely_worse():
    """Errors of one degree of freedom have tails that no t statistic of the others would stand out of."""
    random = np.random.default_rng(10)
    rows = drawn(random, [0.0, 0.6, 0.6], clips=200, seeds=20, of_seeds=0.05, rest=0.1)
    rows |= {f"{name} of two seeds": row for name, row in drawn(random, [0.2] * 4, clips=200, seeds=2).items()}
    assert not {"m1", "m2"} & set(confidence_set(rows).members)


def test_higher_is_lower_the_other_way_round():
    rows = drawn(np.random.default_rng(3), [0.0, 1.0, 5.0])
    turned = {name: replace(row, mean=-row.mean, deviations=-row.deviations) for name, row in rows.items()}
    found = [confidence_set(*each).p_values for each in ((rows,), (turned, "higher"))]
    assert list(found[0]) == list(found[1])
    assert found[0] == pytest.approx(found[1], abs=0.02)  # of other draws


def test_models_that_are_one_are_best_together():
    rows = drawn(np.random.default_rng(4), [0.0])
    same = {"a": rows["m0"], "b": rows["m0"]}
    assert confidence_set(same, over_seeds=False).members == ["b", "a"]
    assert pairs(same).p_values["a", "b"] > 0.9


def test_a_reference_has_no_seeds():
    rows = drawn(np.random.default_rng(5), [0.0, 8.0])
    rows["neighbours"] = replace(rows["m1"], seeds=0.0, rest=0.0, count=sys.maxsize)
    assert confidence_set(rows).members == ["m0"]
    assert pairs(rows).p_values["m0", "neighbours"] < 0.05
    assert required(rows["m0"], rows["neighbours"]).achieved > 0.9


def test_what_is_required_is_what_it_takes():
    """At the numbers that it asks for, with the true variances, the difference is found as often as it says."""
    random = np.random.default_rng(6)
    seeds, difference = 4, 1.2
    many_ = drawn(random, [0.0, difference], clips=4000, seeds=200, of_seeds=0.4)  # variances without error
    found = required(many_["m0"], many_["m1"], difference=difference, power=0.8, seeds=(4, 8))
    assert found.clips[8] < found.clips[4]
    clips = int(found.clips[seeds])
    repeats = 600
    times = 0
    for _ in range(repeats):
        rows = drawn(random, [0.0, difference], clips=clips, seeds=seeds, of_seeds=0.4)
        times += rows["m1"].estimate(rows["m0"]).p_value() < 0.05
    assert times / repeats == pytest.approx(0.8, abs=0.04 + 3 * math.sqrt(0.16 / repeats))


def test_more_clips_are_not_enough_where_seeds_differ():
    rows = drawn(np.random.default_rng(7), [0.0, 0.1], of_seeds=2.0, rest=0.1)
    found = required(rows["m0"], rows["m1"], seeds=(2, 10_000))
    assert math.isinf(found.clips[2])
    assert math.isfinite(found.clips[10_000])
    assert "no number is enough" in rendered(found.table())
    assert found.achieved < 0.5


def test_power_of_one_kind_of_error_is_the_textbooks():
    """With clips alone to differ over it is a t test on differences: that of the noncentral t."""
    random = np.random.default_rng(8)
    first, second = (Crossed.of(random.standard_normal((1, 30)), np.ones(30)) for _ in range(2))
    first, second = (replace(row, seeds=0.0, rest=0.0, count=sys.maxsize) for row in (first, second))
    sought, scale = 0.5, first.estimate(second).sequences * math.sqrt(30)
    found = required(first, second, difference=sought)
    clips = int(found.clips[2])

    def power(n):
        beyond, shift = stats.t.ppf(0.975, n - 1), sought / scale * math.sqrt(n)
        return stats.nct.sf(beyond, n - 1, shift) + stats.nct.cdf(-beyond, n - 1, shift)

    assert power(clips) >= 0.8 > power(clips - 1)


def test_tables_say_what_was_found():
    rows = drawn(np.random.default_rng(9), [0.0, 5.0])
    text = rendered(pairs(rows).table())
    assert all(word in text for word in ("m0", "m1", "Holm"))
    assert "no" in rendered(confidence_set(rows, draws=100).table())
    assert "25 clips and 3 seeds and 3 seeds" in " ".join(rendered(required(rows["m0"], rows["m1"]).table()).split())


def rendered(table):
    from rich.console import Console

    console = Console(width=150, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


def single():
    return Crossed.of(np.zeros((1, 4)), np.ones(4))


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: confidence_set({}), "of some models"),
        (lambda: confidence_set({"a": single()}, level=1.0), "between 0 and 1"),
        (lambda: confidence_set({"a": single()}), "of a there is one training seed"),
        (lambda: confidence_set({"a": single()}, ""), "neither the lower nor the higher"),
        (lambda: confidence_set({"a": Crossed.of(np.zeros((2, 1)), np.ones(1))}), "one clip"),
        (lambda: required(single(), single()), "two seeds"),
        (lambda: required(single(), single(), power=1.0), "between 0 and 1"),
        (lambda: required(single(), single(), seeds=(1,)), "from 2 on"),
        (lambda: required(single(), single(), seeds=()), "from 2 on"),
        (lambda: required(single(), Crossed.of(np.zeros((1, 5)), np.ones(5))), "on the same clips"),
        (lambda: confidence_set({"a": replace(single(), mean=math.nan)}, over_seeds=False), "a is not finite"),
    ],
)
def test_what_cannot_be_told_is_refused(call, told):
    with pytest.raises(ValueError, match=told):
        call()


def test_docstrings():
    assert doctest.testmod(many).failed == 0
