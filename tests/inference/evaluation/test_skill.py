"""Skill relative to the best reference row, and sentences on models without skill."""

from dataclasses import replace

import numpy as np
import pytest

from dvae.inference.evaluation.evaluation import Evaluation, Row, Score
from dvae.inference.evaluation.scores import Metric

MODEL = {"generative": "p(x_t)", "inference": ""}
CLUSTERS = 4


def evaluation(metric="CRPS", clusters=CLUSTERS, **scores):
    """Return an evaluation of equal clusters; names with "model" are models."""
    rows = {
        name.replace("_", " "): Row(5, {metric: np.array(values, float)}, MODEL if "model" in name else {})
        for name, values in scores.items()
    }
    data = {"fingerprint": "0" * 64, "windows": 2 * clusters, "steps": 3, "coordinates": 1}
    sizes = {f"test/{n}": 2 for n in range(clusters)}
    return Evaluation(rows, {metric: Metric("m")}, sizes, data, {}, 5, "drawn", 0, 0)


def test_skill_is_one_minus_the_ratio_to_the_best_reference():
    result = evaluation(last_value=[9, 9, 9, 9], drift=[1, 2, 3, 2], model=[1, 1, 2, 0])
    assert result.best_reference == "drift"
    skill = result.skill("model")
    assert skill.mean == pytest.approx(1 - 1 / 2)
    # cluster c contributes (1 - ratio) - (model_c - ratio drift_c) / drift, with ratio 1/2 and drift 2
    deviations = np.array([1 - 0.5, 1 - 1, 2 - 1.5, 0 - 1]) / 2 / CLUSTERS
    assert skill.standard_error == pytest.approx(np.sqrt(CLUSTERS / (CLUSTERS - 1) * (deviations**2).sum()))
    assert result.skill("drift") == Score(0, 0)
    assert result.skill("last value").mean == pytest.approx(1 - 9 / 2)


def test_skill_is_of_the_crps_or_else_of_the_energy_score():
    result = evaluation(drift=[1, 2, 3, 2], model=[1, 1, 2, 0])
    energies = {
        name: replace(row, cluster_means=row.cluster_means | {"energy score": 10.0 - row.cluster_means["CRPS"]})
        for name, row in result.rows.items()
    }
    both = replace(result, rows=energies, metrics={"energy score": Metric(), **result.metrics})
    assert both.headline == "CRPS"
    assert both.skill("model") == result.skill("model")
    assert evaluation("energy score", drift=[1, 2, 3, 2], model=[1, 1, 2, 0]).skill("model") == result.skill("model")


def test_true_futures_are_no_reference():
    result = evaluation(true_futures=[0, 0, 0, 0], drift=[1, 2, 3, 2], model=[1, 1, 2, 0])
    assert result.best_reference == "drift"


@pytest.mark.parametrize("result", [evaluation(model=[1, 1, 1, 1]), evaluation("ADE", drift=[1] * 4, model=[1] * 4)])
def test_without_a_reference_or_a_proper_score_there_is_no_skill(result):
    assert result.verdicts == []
    assert "skill" not in str(result)
    with pytest.raises(KeyError, match="skill needs a reference row"):
        result.skill("model")
    with pytest.raises(KeyError, match="no method has a score 'skill'"):
        result.table(["skill"])


def test_models_without_skill_are_named_in_a_sentence():
    scores = {"drift": [1, 2, 3, 2], "poor_model": [9, 9.5, 10, 9.1], "good_model": [0.5, 1.5, 2.5, 1.5]}
    result = evaluation(**scores, equal_model=[1.1, 1.9, 3.2, 1.7])
    poor, equal = result.verdicts
    assert (
        poor
        == f"poor model is worse than drift (CRPS {result['poor model']['CRPS']} against {result['drift']['CRPS']})"
    )
    assert equal.startswith("equal model is not shown to be better than drift (CRPS 1.975 ± ")
    assert equal.endswith("within two standard errors)")
    for printed in (str(result), str(Evaluation.from_json(result.to_json()))):
        text = " ".join(printed.split())
        assert poor in text
        assert equal in text
        assert "good model is" not in text


def test_a_single_cluster_leaves_the_difference_uncertain():
    (sentence,) = evaluation(clusters=1, drift=[1], model=[2]).verdicts
    assert sentence.startswith("model is not shown to be better than drift")
    assert "its error is unknown" in sentence


def test_skill_is_the_first_score_of_a_table():
    few = evaluation(drift=[1, 2, 3, 2], model=[1, 1, 2, 0])
    assert [str(cell) for cell in few.table().columns[0].cells] == ["free-running", "skill ↑", "CRPS ↓ (m)"]
    many = evaluation(**{f"reference_{n}": [1 + n] * 4 for n in range(6)}, model=[1, 1, 2, 0])
    assert [str(column.header).split(" ")[0] for column in many.table().columns] == ["", "skill", "CRPS"]
    assert [str(cell) for cell in many.table(["skill"]).columns[1].cells][-1] == str(many.skill("model"))


def test_a_table_of_many_methods_has_five_scores_and_names_the_others():
    result = evaluation(**{f"reference_{n}": [1 + n] * 4 for n in range(6)}, model=[1, 1, 2, 0])
    names = ["CRPS", *(f"score {n}" for n in range(6))]
    rows = {
        method: replace(row, cluster_means=dict.fromkeys(names, row.cluster_means["CRPS"]))
        for method, row in result.rows.items()
    }
    wide = replace(result, rows=rows, metrics=dict.fromkeys(names, Metric()))
    assert len(wide.table().columns) == 6
    assert "not in this table: score 3; score 4; score 5" in str(wide)
    assert len(wide.table([*wide.scores]).columns) == 9
