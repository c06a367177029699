"""Grids: a file defines the methods and run names of a sweep, and the same command resumes it."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest

import dvae
from dvae.cli import loading, main
from dvae.runs.grid import Grid

STUDY = """
seeds = [0, 1]
[training]
steps = 2
batch_size = 4

[filter]
generative = "p(z_t | z_{t-1}) p(x_t | z_t)"
inference = "q(z_t | z_{t-1}, x_{<=t})"
latent = 2
width = 4

[smoother]
generative = "p(z_t | z_{t-1}) p(x_t | z_t)"
inference = "faithful"
width = 4
each.latent = [2, 3]

[vae]
method = "vae"
latent = 2
"""


@pytest.fixture
def study(tmp_path):
    file = tmp_path / "study.toml"
    file.write_text(STUDY, encoding="utf-8")
    return file


def test_a_grid_contains_the_methods_of_its_file(study):
    grid = Grid.read(study)
    assert list(grid.methods) == ["filter", "smoother-latent=2", "smoother-latent=3", "vae"]
    assert (grid.seeds, grid.training) == ((0, 1), {"steps": 2, "batch_size": 4})
    assert grid.methods["vae"] == dvae.method("vae", latent=2)
    assert grid.methods["smoother-latent=3"].equations()[1] == dvae.faithful_inverse("p(z_t | z_{t-1}) p(x_t | z_t)")
    study.write_text(STUDY + "\n[more]\nmethod = 'srnn'\neach.latent = [1, 2]\neach.width = [3, 4]\n")
    more = [name for name in Grid.read(study).methods if name.startswith("more")]
    assert more == [f"more-latent={latent}-width={width}" for latent in (1, 2) for width in (3, 4)]


def test_equations_of_a_grid_read_covariates_of_the_data(study):
    study.write_text(STUDY + """\n[covariates]\ngenerative = "p(z_t | z_{t-1}, c_t) p(x_t | z_t, s)"\n""")
    assert Grid.read(study).methods["covariates"].build({"x": 2, "c": 3, "s": 1}).context == ("c", "s")


def test_the_grid_of_the_docs_is_read(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "sweeps_and_studies.md").read_text(encoding="utf-8")
    (tmp_path / "study.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    grid = Grid.read(tmp_path / "study.toml")
    assert list(grid.methods) == ["filter", "chain-latent=8", "chain-latent=16", "srnn"]
    assert grid.seeds == (0, 1, 2)
    for method in grid.methods.values():
        method.build({"x": 3})


def test_options_of_the_file_override_common_options(study):
    methods = Grid.read(study, {"latent": 7, "warm_up": 5}).methods
    assert {name: (method.latent, method.warm_up) for name, method in methods.items()} == {
        "filter": (2, 5),
        "smoother-latent=2": (2, 5),
        "smoother-latent=3": (3, 5),
        "vae": (2, 5),
    }


@pytest.mark.filterwarnings("default:forecasts selected the weights of filter")
def test_a_sweep_of_a_grid_is_fitted_and_resumed(study, table, tmp_path, capsys):
    out = tmp_path / "runs"
    command = ["sweep", "--grid", str(study), "--data", str(table), "--out", str(out), "--jobs", "1", "--warm-up", "1"]
    assert main(command) == 0
    names = {f"{name}-seed{seed}" for name in Grid.read(study).methods for seed in (0, 1)}
    assert {path.name for path in out.iterdir() if path.is_dir()} == names
    assert dvae.load(out / "smoother-latent=3-seed1").model.sizes["z"] == 3
    before = {path: path.stat().st_mtime_ns for path in out.rglob("best.safetensors")}
    assert main([*command, "--seeds", "0"]) == 0
    assert "by an earlier sweep" in capsys.readouterr().err
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob("best.safetensors")}
    assert main(["compare", *(str(out / name) for name in sorted(names)), "--particles", "2", "--no-forecasts"]) == 0
    shown = capsys.readouterr()
    assert "teacher-forced" in shown.out
    assert "fit with --select bound to compare bounds" in shown.err


@pytest.fixture
def table(tmp_path):
    file = tmp_path / "table.csv"
    rows = [f"{s},{t},{(s * 7 + t * t) % 5 / 3},{(s + t) % 3}" for s in range(12) for t in range(8)]
    file.write_text("\n".join(["id,t,a,b", *rows]))
    return file


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[a", "is not TOML"),
        ("", "names nothing to fit"),
        ("seeds = 3\n[a]\nmethod='vae'", "seeds is 3; it must list"),
        ("seeds = [-1]\n[a]\nmethod='vae'", "distinct whole numbers"),
        ("training = 3\n[a]\nmethod='vae'", r"\[training\]: it must be a table"),
        ("training.stepz = 3\n[a]\nmethod='vae'", r"\[training\]: .* 'stepz' .*did you mean 'steps'"),
        ("training.seed = 3\n[a]\nmethod='vae'", r"seeds = \[...\] instead"),
        ("training.scheduled_sampling = 0.5\n[a]\nmethod='srnn'", "give it as an option of the methods"),
        ("[a]\nmethod='vae'\nlatent=3\neach.latent=[2, 4]", r"\[a\]: latent has one value and several in `each`"),
        ("['../a']\nmethod='vae'", "cannot name run directories"),
        ("[a]\neach.inference=['faithful', 'q(z_t | x_t)']", "each text value its own table"),
        ("[a]\nmethod='vae'\neach.latent=[3]\n['a-latent=3']\nmethod='srnn'", "two tables give a run the name"),
        ("[a]\nx=" + "[" * 3000, "is not TOML"),
        ("steps = 3\n[a]\nmethod='vae'", "steps = 3 is in no table"),
        ("[a]\nmethod='srn'", r"\[a\]: unknown method 'srn' \(did you mean 'srnn'\?\)"),
        ("[a]\nmethod='vae'\neach.latent=3", "must be a list of values"),
        ("[a]\nmethod='vae'\neach=3", "`each` a table"),
        ("[a]\nmethod='vae'\neach.latent=[3, 3]", "a value twice"),
        ("[a]\ngenerative='p(z_t'", r"\[a\]:"),
        (f"[a]\nmethod='vae'\neach.latent={list(range(1, 102))}\neach.warm_up={list(range(100))}", "maximum of 1000"),
    ],
)
def test_an_invalid_grid_is_an_error_with_its_table(study, text, message):
    study.write_text(text)
    with pytest.raises(ValueError, match=message):
        Grid.read(study)


def test_the_command_line_accepts_methods_or_a_grid(study, tmp_path, capsys):
    out = ["--out", str(tmp_path / "runs")]
    for arguments, message in (
        (["vae", "--grid", str(study)], "give either methods or --grid"),
        (["--grid", str(study), "--latent", "3"], "each.latent"),
        (["--grid", str(tmp_path / "none.toml")], "none.toml"),
    ):
        assert main(["sweep", *arguments, *out]) != 0
        assert message in capsys.readouterr().err
    study.write_text(STUDY.replace("steps = 2", "steps = 0"))
    assert main(["sweep", "--grid", str(study), *out]) == 2
    assert "steps is 0" in capsys.readouterr().err


def test_equations_named_like_a_method_keep_their_own_row(people, tmp_path):
    data = dvae.motion.MotionData.open(people)
    small = {"width": 2, "latent": 2}
    methods = {
        "grid/srnn": dvae.method("equations", **small),
        "grid/filter": dvae.method("equations", inference="q(z_t | z_{t-1}, x_t)", **small),
        "paper/srnn": dvae.method("srnn", warm_up=0, **small),
    }
    paths = [tmp_path / f"{name}-seed{seed}" for name in methods for seed in (0, 1)]
    for path, (method, seed) in zip(paths, product(methods.values(), (0, 1)), strict=True):
        method = replace(method, warm_up=0)
        dvae.fit(method, data, out=path, steps=1, batch_size=2, seed=seed, progress=False)
    rows = loading.rows([dvae.load(path) for path in paths])
    assert [[run.path for run in row] for row in rows.values()] == [paths[:2], paths[2:4], paths[4:]]
    assert [*loading.rows([dvae.load(path) for path in paths[:4]])] == ["srnn", "filter"]
