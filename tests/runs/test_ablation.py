"""Ablations: costs equal the oracle's, every edge has its own run, and interrupted ablations are resumed."""

import json
import math
import re
import shutil
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from hypothesis import given, settings
from matplotlib.patches import FancyArrowPatch

import dvae
from dvae.cli import main
from dvae.data.schema import Schema
from dvae.factorization.notation import Factorization
from dvae.runs.ablation import FAMILY, WHOLE, Ablation, as_equations, edges_of
from dvae.runs.grid import NAME
from dvae.testing.strategies import factorizations

matplotlib.use("Agg")

DKF, SMOOTHER = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})"
PAIR = "p(z_t | z_{t-1}) p(x_t | z_t, x_{t-1})", "q(z_t | x_t)"


@pytest.fixture(scope="module")
def ablation():
    return dvae.ablate((DKF, SMOOTHER), sizes={"z": 1, "x": 1}, steps=3, surrogates=2)


def command(people, out, *more):
    equations = ["--generative", PAIR[0], "--inference", PAIR[1], "--residual", ".5", "--latent", "2", "--width", "4"]
    runs = ["--data", str(people), "--out", str(out), "--seeds", "0", "1", "--steps", "2", "--batch-size", "4"]
    surrogates = ["--surrogates", "1", "--surrogate-steps", "2", "--bound-particles", "4", "--jobs", "1"]
    return ["check", "edges", *equations, *runs, *surrogates, "--warm-up", "1", *more]


@pytest.fixture(scope="module")
def fitted(people, tmp_path_factory):
    """Return the directory of an ablation by the command line."""
    out = tmp_path_factory.mktemp("ablation") / "runs"
    assert main(command(people, out, "--figure", str(out.with_name("edges.png")))) == 0
    return out


def test_costs_equal_those_of_edge_costs(ablation):
    sizes = {"z": 1, "x": 1}
    expected = {
        "q": dvae.edge_costs(DKF, SMOOTHER, sizes, steps=3, seeds=2),
        "p": dvae.model_edge_costs(DKF, sizes, steps=3, seeds=2),
    }
    assert len(ablation.edges) == sum(map(len, expected.values())) == 6
    for edge in ablation.edges:
        assert ablation.costs[edge.run].tolist() == expected[edge.kind][edge.name].tolist()
    assert {edge.name for edge in ablation.edges if max(ablation.costs[edge.run]) < 1e-6} == {"x_{<t} to z_t"}
    assert ablation.notes == {"model-without-z_t-to-x_t": "without it, no data depend on z"}


@settings(max_examples=50)
@given(factorizations())
def test_every_edge_has_its_own_run(pair):
    parts = [*map(Factorization.parse, pair)]
    runs = [edge.run for edge in edges_of(*parts)]
    assert len({*runs, WHOLE}) == len(runs) + 1
    assert all(re.fullmatch(NAME, run) for run in runs)
    for part in parts:
        edges = [edge for *_, edge in part.slice().edges.data("edge")]
        assert len(edges) == len(part.edges)
        assert all(edge in part.edges for edge in edges)


def test_edges_are_drawn_by_their_cost(ablation):
    figure = ablation.plot()
    for axes, kind in zip(figure.axes, "pq", strict=True):
        widths = {float(patch.get_linewidth()) for patch in axes.patches if isinstance(patch, FancyArrowPatch)}
        costs = {round(np.mean(ablation.costs[edge.run]), 3) for edge in ablation.edges if edge.kind == kind}
        labels = sorted(float(text.get_text()) for text in axes.texts if "$" not in text.get_text())
        assert {*labels} == costs
        assert len(widths) == len(costs)


@pytest.mark.parametrize("name", FAMILY)
def test_a_family_method_equals_its_equations(name):
    method = dvae.method(name) if name == "vae" else dvae.method(name, width=4)
    equations = as_equations(method)
    assert equations.equations() == method.equations()
    built, expected = equations.build({"x": 3}), method.build({"x": 3})
    assert built.sizes == expected.sizes
    assert equations.warm_up == getattr(method, "warm_up", equations.warm_up)


def test_equations_read_the_same_covariates_as_the_method():
    class Given(Schema):
        covariates = ("c",), ("s",)

    method, schema = dvae.method("dkf"), Given({"x": 2, "c": 1, "s": 1})
    expected = method.build(schema)
    equations = as_equations(method, schema).equations()
    assert equations == (expected.generative, expected.inference)
    assert ("x", "c_t") in {(child, str(parent)) for child, parent in equations[0].edges}
    ablation = dvae.ablate(as_equations(method, schema), steps=2, surrogates=1)
    assert min(ablation.costs["model-without-c_t-to-x_t"]) > 1e-3


def test_an_ablation_by_the_command_line(fitted):
    ablation = dvae.Ablation.load(fitted / "edges.json")
    runs = {edge.run for edge in ablation.edges}
    left_out = {"model-without-x_t-1-to-x_t"}
    assert ablation.notes.keys() >= left_out
    assert "residual" in ablation.notes[left_out.copy().pop()]
    assert ablation.differences.keys() == runs - left_out
    assert {path.name for path in fitted.iterdir()} == {
        "edges.json",
        *(f"{run}-seed{seed}" for run in runs - left_out | {WHOLE} for seed in (0, 1)),
    }
    for run, estimate in ablation.differences.items():
        metric = "IWAE bound" if run.startswith("model") else "ELBO"  # as for surrogates: the evidence, and the gap
        full, without = (ablation.comparison[name][metric].mean for name in (WHOLE, run))
        assert estimate.mean == pytest.approx(full - without, abs=1e-9)
        assert estimate.p_value() <= ablation.p_values[run] <= 1
    reduced = dvae.load(fitted / "guide-without-x_t-to-z_t-seed1")
    assert (reduced.model.generative.text, reduced.model.inference.text) == (PAIR[0], "q(z_t)")
    assert "not fitted" in str(ablation)
    assert fitted.with_name("edges.png").stat().st_size > 0


def test_the_same_command_resumes_an_ablation(fitted, people, tmp_path):
    out = tmp_path / "runs"
    shutil.copytree(fitted, out)
    shutil.rmtree(out / "model-without-z_t-1-to-z_t-seed0")
    before = {path: path.stat().st_mtime_ns for path in out.glob("*/*")}
    assert main(command(people, out)) == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    again, first = (json.loads((each / "edges.json").read_text()) for each in (out, fitted))
    assert again == first


def test_an_ablation_is_read_back_from_json(fitted, ablation):
    for result in (ablation, Ablation.load(fitted / "edges.json")):
        again = Ablation.from_json(result.to_json())
        assert (str(again), again.to_json()) == (str(result), result.to_json())


@pytest.mark.parametrize(
    "damage",
    [
        {"equations": {"generative": "p(z_t | z_{t-99999999}) p(x_t | z_t)", "inference": PAIR[1]}},
        {"equations": {"generative": 3, "inference": PAIR[1]}},
        {"equations": {"generative": PAIR[0], "inference": "q(z_t | "}},
        {"costs": {}},
        {"costs": {"model-without-z_t-to-x_t": [1]}},
        {"notes": {"none": "of these"}},
        {"comparison": {"rows": {}}},
    ],
)
def test_an_invalid_document_is_an_error(ablation, damage):
    document = ablation.document()
    with pytest.raises(ValueError, match="not written by Ablation"):
        Ablation.of({**document, "attributes": document["attributes"] | damage})


@pytest.mark.parametrize("costs", [[], [0.1], [math.nan, 0.1]])
def test_inconsistent_costs_are_errors(ablation, costs):
    damaged = replace(ablation, costs=ablation.costs | {"model-without-z_t-to-x_t": np.array(costs)})
    with pytest.raises(ValueError, match="cost"):
        damaged.check()


def test_a_comparison_of_other_models_is_an_error(fitted):
    ablation = Ablation.load(fitted / "edges.json")
    rows = {"another" if name == WHOLE else name: row for name, row in ablation.comparison.rows.items()}
    with pytest.raises((KeyError, ValueError), match=r"whole|fits"):
        replace(ablation, comparison=replace(ablation.comparison, rows=rows)).check()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give the name of a method, or --generative"),
        (["srnn", "--inference", SMOOTHER], "--inference is the guide for --generative, but srnn has its own guide"),
        (["hit-dvae"], "ablate one of vae, dkf, storn"),
        (["srnm"], "did you mean 'srnn'?"),
        (["srnn", "--steps", "3"], "give --out DIR"),
        (["srnn", "--surrogates", "0"], "--surrogates is 0"),
        (["srnn", "--network", "recurent"], "did you mean 'recurrent'?"),
        (["--generative", "p(z_t"], "expected"),
    ],
)
def test_wrong_arguments_exit_with_2_before_any_work(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["check", "edges", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


def test_fits_require_data_and_a_directory(tmp_path):
    with pytest.raises(ValueError, match="give both `data` and `out`"):
        dvae.ablate((DKF, SMOOTHER), out=tmp_path)
    with pytest.raises(ValueError, match="the latent k has no factor in the guide"):
        dvae.ablate(("p(k_t | k_{t-1}) p(x_t | k_t)", ""), surrogates=1, progress=False)
