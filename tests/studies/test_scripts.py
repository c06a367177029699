"""Run the scripts of the tables of results on little data."""

import json
import re
import shutil
import subprocess
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import networkx as nx
import numpy as np
import pytest
import torch

from benchmarks import bench, graphs, peers, speed, startup
from benchmarks import trajevae as trajevae_speed
from benchmarks.studies import (
    angles,
    audits,
    bones,
    bounds,
    bracket,
    completion,
    engine,
    family,
    hit_dvae,
    irregular,
    mix_and_match,
    motion_latent,
    occlusion,
    overview,
    packages,
    papers,
    priors,
    ranking,
    results,
    rotations,
    static,
    trajevae,
    tuning,
)
from dvae import Descent, Training, alternatives, method, motion
from dvae.cli import main as command
from dvae.inference.training.checkpoints import Run
from dvae.inference.training.fit import fit
from dvae.motion.geometry.angles import angle_names, cosines
from dvae.motion.segments import dataset
from dvae.runs.directory import load
from dvae.tables import Column, Columns, Panel, Series

SMALL = ["--steps", "2", "--batch-size", "4", "--validate-every", "2"]


def dvae(*arguments):
    assert command([str(argument) for argument in arguments]) == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a small motion file."""
    folder = tmp_path_factory.mktemp("tables")
    motion.save(folder / "people.npz", motion.simulate(clips=8, frames=80, seed=1))
    return folder


def fitted(folder, name, method, *options):
    dvae("fit", method, "--data", folder / "people.npz", "--out", folder / name, *SMALL, *options)
    return folder / name


@pytest.fixture(autouse=True)
def _as_many_threads(monkeypatch):
    """Keep the number of threads, which scripts set to one."""
    monkeypatch.setattr(torch, "set_num_threads", lambda number: None)


@pytest.fixture
def out(tmp_path):
    """Return a folder for tables."""
    return tmp_path / "results"


def tables(out, *names):
    """Return tables as lists of rows, with their headers."""
    read = [results.read(name, out) for name in names]
    assert all(len(row) == len(table.header) for table in read for row in table.rows)
    return [[table.header, *table.rows] for table in read]


def files(out):
    """Return the texts of all tables and notes."""
    return {file: file.read_text() for file in out.rglob("*.*")}


@contextmanager
def nothing_new(out, runs):
    """Assert that tables and files stay unchanged."""

    def contents():
        return files(out), {file: file.stat().st_mtime_ns for file in runs.rglob("*.json")}

    before = contents()
    yield
    assert contents() == before


def patched(monkeypatch, module, **values):
    for name, value in values.items():
        monkeypatch.setattr(module, name, value)


def test_audits(out, monkeypatch):
    monkeypatch.setattr(audits, "FAMILY", {name: audits.FAMILY[name] for name in ("VAE", "DKF", "HiT-DVAE")})
    audits.main(out, steps=2, seeds=1)
    guides, derived, edges = tables(out, "audits/guides", "audits/derived", "audits/edges")
    assert sum(row[0] == "DKF" for row in derived) == len(alternatives(audits.FAMILY["DKF"][0]))
    assert sum(row[0] == "DKF" and row[1].endswith(" to z_t`") for row in edges) == 3  # of z_{t-1}, x_t and x_{>t}
    costs = {row[0]: (row[3], float(row[5].split()[0])) for row in guides[1:]}
    assert [missing for missing, _ in costs.values()] == ["–", "–", "`z_{<t}`"]
    assert costs["VAE"][1] == costs["DKF"][1] == 0 < costs["HiT-DVAE"][1]


def test_bounds(out, monkeypatch):
    monkeypatch.setattr(bounds, "TEMPERATURES", (2, 6))
    bounds.main(out, steps=3, sequences=4, particles=2, fitting=20, sides=3)
    estimates, sides = tables(out, "bounds/estimates", "bounds/sides")
    assert len(sides) == len(estimates) == len(bounds.GUIDES) + 1
    assert all(abs(float(cell.split()[0])) < 1 for row in sides[1:] for cell in row[-2:])
    gaps = [float(row[1]) for row in estimates[1:]]
    assert gaps[0] == max(gaps)
    assert min(gaps) >= 0


def test_bracket(folder, out, tmp_path, monkeypatch):
    monkeypatch.setattr(bracket, "SETTINGS", {"particles": 2, "temperatures": 2, "chains": 2})
    monkeypatch.setattr(bracket, "GUIDES", {name: bounds.GUIDES[name] for name in ("mean-field", "exact")})
    run = fitted(folder, "bracketed", "dkf", "--warm-up", 1, "--latent", 1)
    bracket.main((run,), tmp_path / "kept", out, count=2, fitting=1, steps=2)
    parts, (head, line) = tables(out, "bounds/parts", "bounds/runs")
    mean_field, exact = (float(row[1]) for row in parts[1:])
    assert mean_field > exact > -1e-6
    assert line[0].startswith("bracketed, ")
    assert len(head) == len(line)
    assert not {"–", ""} & {*line}
    (stored,) = (tmp_path / "kept").iterdir()
    stored.write_text(stored.read_text().replace('"seed"', '"other"'))
    with pytest.raises(ValueError, match="not written by Bracket"):
        bracket.main((run,), tmp_path / "kept", out, count=2, fitting=1, steps=2)


def test_family(folder, out):
    comparisons = []
    for name in ("vae", "dkf"):
        run, file = fitted(folder, name, name, "--warm-up", 1), folder / f"{name}.json"
        dvae("compare", run, "--particles", 2, "--samples", 2, "--out", file)
        comparisons.append(file)
    family.main(tuple(comparisons), out)
    forced, free = tables(out, "family/teacher-forced", "family/free-running")
    assert {row[0] for row in forced[1:]} == {row[0] for row in free[1:]} == {"vae", "dkf"}
    assert forced[1][2] == "–"
    dvae("compare", run, "--particles", 2, "--no-forecasts", "--out", file)
    family.main((file,), out, "-bounds")
    assert [row[0] for row in tables(out, "family/teacher-forced-bounds")[0][1:]] == ["dkf"]
    assert not (out / "family/free-running-bounds.csv").exists()


def test_bones(folder, out):
    small = ("--pose-prior", "0", "--draws", "2")
    runs = tuple(fitted(folder, f"gsps-{bones}", "gsps", *small, f"--{bones}") for bones in ("no-bones", "bones"))
    bones.main(runs, out, every=2, samples=2)
    scores, differences = tables(out, "bones/scores", "bones/differences")
    lengths = {row[0]: float(row[1].split()[0]) for row in scores[1:]}
    assert lengths["gsps bones"] == 0 < 0.01 < lengths["gsps no bones"]
    assert [row[0] for row in differences[1:]] == ["gsps bones minus gsps no bones"]
    with pytest.raises(SystemExit, match="name each run without bones"):
        bones.main(runs[1:], out)


def test_hit_dvae(folder, out):
    run = fitted(folder, "hit-dvae", "hit-dvae", "--pose-prior", "0")
    hit_dvae.main(run, out, count=2, seconds=2.0)
    (seconds,) = tables(out, "hit_dvae/long-forecasts")
    assert [row[0] for row in seconds[1:]] == ["1", "2"]


def test_static(folder, out):
    run = fitted(folder, "with-w", "hit-dvae", "--pose-prior", "0", "--width", "8")
    static.main((run,), out, labels=("activity",), splits=("train",), count=5)
    probes, swaps = tables(out, "hit_dvae/probes", "hit_dvae/exchanged-latents")
    assert [row[2] for row in probes[1:]] == ["w", "z", "mean and spread of poses"]
    assert [row[1:3] for row in swaps[1:]] == [*(["w", f"{share:g}"] for share in static.SHARES), ["z", "1"]]
    assert swaps[1][3:5] == ["0", "0"]


def test_probes_find_labels_and_lengths_only_if_features_contain_them():
    torch.manual_seed(0)
    labels = [name for name in "abc" for _ in range(40)]
    places = torch.arange(120) // 4
    fitted = static.halves(labels, places)
    assert [int(fitted[n : n + 40].sum()) for n in (0, 40, 80)] == [20] * 3
    assert all(len({*fitted[places == place].tolist()}) == 1 for place in range(30))
    features = torch.randn(120, 6)
    chance = static.read_label(features, labels, fitted).mean()
    features[:, 2] += 9 * torch.tensor(["abc".index(label) for label in labels])
    assert abs(chance - 1 / 3) < 0.2
    assert static.read_label(features, labels, fitted).mean() == 1
    lengths = features[:, :2] @ torch.randn(2, 5) + 1
    assert (
        static.read_lengths(features, lengths.double(), fitted)
        > 0.99
        > 0.1
        > static.read_lengths(torch.randn(120, 6), lengths.double(), fitted)
    )


def test_mix_and_match(tmp_path, out, monkeypatch):
    """Fitted and scored once, whatever is asked again; two alphas make a curve."""
    monkeypatch.setattr(mix_and_match, "BODY", motion.WALKER.names)
    little = {"STEPS": 2, "EVERY": 20, "SAMPLES": 3, "WATCHED": 3, "FUTURES": 5, "THINNED": 2}
    little |= {"OPTIONS": {"width": 8}, "METRIC_MODEL_OPTIONS": {"width": 4}, "TUNING": mix_and_match.RAW}
    little |= {"METRIC_MODEL": {**mix_and_match.METRIC_MODEL, "examples": 8, "steps": 2}}
    for name, value in little.items():
        monkeypatch.setattr(mix_and_match, name, value)
    named = {name: mix_and_match.NAMED[name] for name in ("mix", "mix, velocity", "no noise")}
    alphas = {name: mix_and_match.CASES["sweep"][name] for name in ("alpha 0.1", "alpha 0.3")}
    sections = {
        name: mix_and_match.Section(mix_and_match.RAW, c)
        for name, c in {mix_and_match.RAW: named, "alpha": alphas}.items()
    }
    sections["alpha"] = replace(sections["alpha"], longer=(3,), until=101.0)  # a quality that no case reaches
    monkeypatch.setattr(mix_and_match, "SECTIONS", sections)
    motion.write_motion(tmp_path / "bvh", motion.simulate(clips=2, frames=240, seed=1), "bvh")
    options = {
        "raw": tmp_path / "bvh",
        "runs": tmp_path / "runs",
        "results": out,
        "picture": tmp_path / "a.png",
    }
    mix_and_match.main(sections=tuple(sections), seeds=(0,), **options)
    with nothing_new(out, tmp_path / "runs"):
        mix_and_match.main(sections=tuple(sections), seeds=(0,), **options)
    (tmp_path / "runs" / mix_and_match.RAW / "mix-0" / engine.MEASURED).unlink()
    mix_and_match.main(sections=(mix_and_match.RAW,), cases=("mix",), seeds=(0, 1), **options)
    names = [f"{mix_and_match.RAW}-{what}" for what in ("futures", "noise", "angles")] + ["alpha-futures"]
    ways, noise, angles, swept = tables(out, *(f"mix_and_match/{name}" for name in names))
    assert [row[0] for row in ways[1:]] == ["zero velocity", "mix", "mix, velocity", "no noise"]
    assert [row[0] for row in noise[1:]] == ["mix", "mix, velocity"]
    assert all(float(row[4].split()[0]) == 0 for row in ways[1:] if row[0] in ("zero velocity", "no noise"))
    assert all(float(row[4].split()[0]) > 0 for row in ways[1:] if "mix" in row[0])
    counts = [["mix, velocity", "1"], ["mix, velocity", "5"], ["no noise", "1"]]
    assert [row[:2] for row in angles[1:]] == [["zero velocity", "1"], ["mix", "1"], *counts]
    assert [row[0] for row in swept[1:]] == ["alpha 0.1", "alpha 0.3"]
    assert "3 steps of training" in (out / "mix_and_match" / "alpha-3-steps-futures.txt").read_text()
    assert (tmp_path / "a.png").stat().st_size > 10_000


@pytest.fixture
def short(monkeypatch):
    """Shorten completion: simulated people, small options, a horizon of half a second."""
    few = motion.simulate(clips=10, frames=90, seed=1)
    monkeypatch.setattr(dataset, "simulate", lambda: few)
    monkeypatch.setattr(completion, "split_by_group", lambda people: people)
    for name, value in {"HORIZON": 0.5, "DESCENT": Descent(2, starts=2, candidates=2, newton=0), "DRAWS": 30}.items():
        monkeypatch.setattr(completion, name, value)
    for name, value in {
        "POINTS": (5, 10),
        "FRAMES": (4, 100),
        "FEW": 5,
        "RESIDUAL": completion.RESIDUAL | {"width": 4},
    }.items():
        monkeypatch.setattr(completion, name, value)
    sights = {(5, 4): False, (5, 100): False, (10, 100): True, (0, 4): True}
    sights_tested = [completion.Sight(*sight, markers) for sight, markers in sights.items()]
    monkeypatch.setattr(completion, "SIGHTS", {"few": sights_tested})
    return completion.Budget(some=2, known=2, steps=2, dense=20)


def test_motion_latent(tmp_path, out, monkeypatch):
    """Results are fitted and scored only once; an interrupted run continues; several seeds give errors."""
    people = motion.simulate(clips=12, frames=90, seed=1)
    labels_by_clip = [
        {**clip.labels, "file_group": "ABC"[n % 3], "content": ("walk", "run")[n % 2]} for n, clip in enumerate(people)
    ]
    clips = [replace(clip, labels=labels) for clip, labels in zip(people, labels_by_clip, strict=True)]
    motion.save(tmp_path / "people.npz", replace(people, clips=clips))
    monkeypatch.setattr(motion_latent, "PAIRS", 4)
    monkeypatch.setattr(motion_latent, "DRAWN", 4)
    for cases in motion_latent.SECTIONS.values():
        for name, case in cases.items():
            options = {"widths": (8,), **case.get("method", {})}
            small = {**options, "latent": options.get("latent", 64) // 16}
            monkeypatch.setitem(cases, name, {**case, "method": small})
    monkeypatch.setattr(motion_latent, "LENGTHS", dict.fromkeys(motion_latent.LENGTHS, 3))
    options = {"runs": tmp_path / "runs", "results": out}
    data = {"data": tmp_path / "people.npz", "other": tmp_path / "people.npz"}
    main, tuning = motion_latent.main, ("both phases", "turns scaled", "z of 16")
    main(**data, sections=("held out",), cases=("both phases", "first phase alone"), seeds=(0, 1), **options)
    main(**data, sections=("tuning",), cases=tuning, seeds=(0,), **options)
    with nothing_new(out, tmp_path / "runs"):
        main(**data, sections=("tuning",), cases=tuning, seeds=(0,), **options)
    (tmp_path / "runs" / "tuning" / "z-of-16-0" / engine.MEASURED).unlink()
    main(**data, sections=("tuning",), cases=("z of 16",), seeds=(0,), **options)
    names = "tuning-same-source", "held-out-same-source", "held-out-same-source-differences", "held-out-other-source"
    varied, same, against, other = tables(out, *(f"motion_latent_4d/{name}" for name in names))
    assert [row[0] for row in varied[1:]] == [*tuning, "PCA of 12", "PCA of 9"]
    assert [row[0] for row in same[1:]] == ["both phases", "first phase alone", "PCA of 12"]
    assert [row[0] for row in against[1:]][1] == "both phases minus PCA of 12"
    assert other[1][1] != same[1][1]
    main(**data, sections=("prior",), cases=("KL 1",), seeds=(0,), **options)
    (generated,) = tables(out, "motion_latent_4d/prior-generated")
    names = ["KL 1, N(0, I)", "KL 1, fitted normal", "KL 1, aggregate posterior"]
    assert [row[0] for row in generated[1:]] == [*names, "real, training", "real, test"]
    assert [row[-1] == "–" for row in generated[1:]] == [False] * 3 + [True] * 2  # only models have latents
    main(**data, sections=("prior",), cases=("published",), seeds=(0,), **options, steps=4)
    (longer,) = tables(out, "motion_latent_4d/prior-4-steps-same-source")
    assert [row[0] for row in longer[1:]] == ["published", "PCA of 12"]
    training = Run(tmp_path / "runs" / "prior-4-steps" / "published-0").config["training"]
    assert (training["batch_size"], training["gradient_clip"]) == (256, None)


def test_completion(tmp_path, out, short, monkeypatch):
    """Results are measured only once; predictions exclude observed frames; no distance is below the floor."""
    small = method("motion-latent", latent=3, widths=(8,), finish=0.0)
    fit(small, dataset.SegmentData.open(), out=tmp_path / "a", **vars(Training(steps=2, batch_size=4, progress=False)))
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    options = {"out": tmp_path / "out", "picture": tmp_path / "a.png", "budget": short, "results": out}
    runs = tmp_path / "a", tmp_path / "b"
    completion.main("simulated", runs, parts=("prediction",), **options)
    completion.main("simulated", runs[:1], parts=("completion", "uncertainty"), **options)
    with nothing_new(out, tmp_path / "out"):
        completion.main(None, runs, parts=("prediction",), **options)
        completion.main(None, runs[:1], **options)
    names = "prediction", "completion-few", "completion-uncertainty"
    curves, completions, sure = tables(out, *(f"motion_latent_4d/{name}" for name in names))
    assert [row[0] for row in curves[1:4]] == ["ours", "ours, body unknown", "reconstruction"]
    assert curves[-1][0] == "segments"
    assert [row[0] for row in completions[1:]][-2:] == ["10 points, 100 frames, markers", "0 points, 4 frames, markers"]
    for row in completions[1:]:
        assert float(row[4].split()[0]) < float(row[1].split()[0])
    assert [row[0] for row in sure[1:]] == [str(sight) for sight in completion.UNCERTAINTY_CASES]
    errors, _ = engine.read_all(tmp_path / "out", "references").runs
    last, first = (completion.at(errors["times"][completion.observed_times(30.0)[1] - ahead]) for ahead in (1, 0))
    for row in errors["rows"].values():
        assert max(row[last]) == 0 < min(row[first])
    assert (tmp_path / "a.png").stat().st_size > 10_000
    monkeypatch.setattr(completion, "TUNED_DEVIATIONS", {"surface": (0.01,), "marker": (), "point": ()})
    monkeypatch.setattr(completion, "DESCENTS", [])
    shutil.copytree(tmp_path / "a", tmp_path / "prior" / "KL-1-0")
    completion.main("simulated", (), (tmp_path / "prior" / "KL-1-0",), parts=("tuning", "claim"), **options)
    assert len([*(tmp_path / "out" / completion.TUNING).glob("*.json")]) == 2
    (claimed,) = tables(out, "motion_latent_4d/prediction-claim")
    names = (
        "prior-KL-1",
        "prior-KL-1, body given",
        "prior-KL-1, reconstruction",
        "residual-sup",
        "last frame held",
        "prior-KL-1 minus residual-sup, 95 %",
        "segments",
    )
    assert [row[0] for row in claimed[1:]] == [*names]
    with pytest.raises(SystemExit, match="unknown part 'guesses'"):
        completion.main(parts=("guesses",), **options)


def test_residual_poses_start_where_segments_start(short):
    """An oracle of the future gives the true surfaces for all headings and positions."""
    data = dataset.SegmentData.open()
    segments = data.windows("test")
    run = SimpleNamespace(model=MotionSpace(data), segments=segments, batch=segments.all())
    people, cut = run.segments.motion, completion.protocol(30.0)
    windows = motion.windows(people, cut, "test")
    assert len(windows) == len(people)

    class Oracle:
        rotations = windows.schema.view

        def read(self, batch):
            return batch

        def model(self, batch, length, mean_emission):
            return {"x": self.rotations(windows.all())["x"][:, cut.observed :]}

    errors = completion.reference_errors(run, Oracle(), 30.0)["rows"]
    assert max(max(row) for row in errors[completion.SUP].values()) < 5  # mm; frames of chi account for 2
    assert min([*errors[completion.STILL].values()][-1]) > 50


class MotionSpace:
    """Frames and a body, for surfaces."""

    def __init__(self, data):
        self.timed, self.body = data.timed, motion.bodies.human()


def test_rotations(folder, out):
    rotations.main(folder / "people.npz", out)
    (table,) = tables(out, "rotations/errors")
    assert [row[0] for row in table[1:]] == [*motion.WALKER.names, "all"]
    assert (
        float(table[1][2]) == 0 < max(float(row[2]) for row in table[1:]) == float(table[-1][2])
    )  # the root does not move


def test_angles(folder, out, monkeypatch):
    monkeypatch.setattr(angles, "SETS", {"simulated": SimpleNamespace(file="people.npz")})
    monkeypatch.setattr(angles, "PROTOCOLS", {"by style": "simulated"})
    angles.main(folder, out)
    (table,) = tables(out, "gsps/angles")
    assert {row[0] for row in table[1:]} == {*angle_names(motion.WALKER), angles.ANY}
    shares = {row[0]: float(row[1].partition("%")[0]) for row in table[1:]}
    assert max(shares.values()) == shares[angles.ANY] > 0


def test_poses_beyond_angle_limits_are_counted():
    """Half of the poses exceed a limit that is their median; a limit whose cosine is above .98 is inactive."""
    poses = motion.windows(motion.simulate(clips=4, frames=90), "simulated", "train").poses()[:101]
    limits, names = motion.estimate_angle_limits(poses, motion.WALKER), angle_names(motion.WALKER)
    assert not any(share or excess for share, excess in angles.beyond(poses, limits, motion.WALKER).values())
    cos, high = cosines(poses, motion.WALKER), limits.high.clone()
    active, inactive = (cos[:, names.index(name)].median() for name in ("Head2HeadTop", "Neck2Spine"))
    assert active < 0.98 < inactive
    high[names.index("Head2HeadTop")], high[names.index("Neck2Spine")] = active, inactive
    shares = angles.beyond(poses, replace(limits, high=high), motion.WALKER)
    cos = cos[:, names.index("Head2HeadTop")]
    expected = (cos > active).double().mean().item()
    degrees = [torch.rad2deg(value.double().arccos()).item() for value in (active, cos.max())]
    assert shares["Head2HeadTop"] == shares[angles.ANY] == pytest.approx((expected, degrees[0] - degrees[1]))
    assert sum(share > 0 for share, _ in shares.values()) == 2


def test_trajevae(folder, out):
    run = fitted(folder, "trajevae", "trajevae", "--protocol", "simulated-trajectories")
    trajevae.main(run, out, joints=("RFoot", "LWrist"), count=2, samples=2)
    ((header, *rows),) = tables(out, "trajevae/exact-paths")
    assert [row[:2] for row in rows] == [[given, how] for given in ("RFoot", "RFoot, LWrist") for how in ("", "exact")]

    def number(row, name):
        return float(row[header.index(name)].split(" ± ")[0].rstrip("%"))

    for free, exact in (rows[:2], rows[2:]):
        assert number(free, "path error, m") > 0.01 > number(exact, "path error, m")
        assert number(free, "within 1 cm") < number(exact, "within 1 cm") == 100
        assert number(exact, "bone-length error") < number(free, "bone-length error")
        assert free[header.index("corrected by, m")] == "–"
        assert number(exact, "corrected by, m") > 0
    with pytest.raises(SystemExit, match="a run of vae, which follows no paths"):
        trajevae.main(fitted(folder, "pathless", "vae", "--warm-up", 1))
    with pytest.raises(SystemExit, match=r"no joint 'Tail'.*LWrist"):
        trajevae.main(run, joints=("Tail",))
    with pytest.raises(SystemExit, match="nowhere is not a run directory"):
        trajevae.main(folder / "nowhere")


def test_priors(folder, out, monkeypatch):
    monkeypatch.setattr(tuning, "SAMPLES", 4)
    small = ["--protocol", "simulated-trajectories", "--width", "8", "--latent", "4"]
    runs = [
        fitted(folder, name, "trajevae", *small, *options)
        for name, options in {"learned": (), "standard": ("--prior", "standard", "--no-cosine")}.items()
    ]
    priors.main(tuple(runs), out, counts=(0,))
    ((header, *rows),) = tables(out, "trajevae/priors")
    assert [row[:2] for row in rows] == [[run.name, "0"] for run in runs]

    def column(name):
        return [row[header.index(name)] for row in rows]

    assert column("prior means")[1] == "0.00"
    assert column("prior")[1] == "1.00"
    for run, off, posterior in zip(runs, column("z in units of the prior"), column("posterior"), strict=True):
        fitted_run = load(run)
        data = fitted_run.model.read(tuning.selection_windows(fitted_run.data).given(()).all())
        read = slice(fitted_run.model.method.components or None)
        (mean, deviation), (loc, scale) = (
            [values[:, read].detach() for values in factor["z"](data, len(data["s"]), data["y"].shape[1])]
            for factor in (fitted_run.model.encoder, fitted_run.model.generator)
        )
        assert float(posterior) == pytest.approx(float((deviation**2).mean()) ** 0.5, abs=0.006)
        second = ((mean - loc) ** 2 + deviation**2) / scale**2  # moment of a draw, in units of the prior
        assert float(off.split()[0]) == pytest.approx(float(second.mean()) ** 0.5, abs=0.006)
    assert all(a < b for a, b in zip(column("APD, prior"), column("APD, prior × 2"), strict=True))
    assert len({*column("APD, common both")}) > 1
    assert column("energy score, common both") != column("energy score, prior")
    with pytest.raises(SystemExit, match="a run of vae; give one of trajevae"):
        priors.main((fitted(folder, "without-paths", "vae", "--warm-up", 1),))


def test_the_common_prior_has_the_moments_of_the_mixture_of_posteriors():
    torch.manual_seed(0)
    mean, deviation = torch.randn(5, 3, 2), torch.rand(5, 3, 2)
    common = priors.pooled((mean, deviation))
    draws = (mean + deviation * torch.randn(20_000, 5, 3, 2)).flatten(0, 1)
    for moment, expected in zip(common, (draws.mean(0), draws.std(0)), strict=True):
        torch.testing.assert_close(moment, expected, atol=0.03, rtol=0)
    prior = torch.randn(7, 4, 2), torch.rand(7, 4, 2)  # the last step is not used
    for parts in ((), ("mean",), ("deviation",), ("mean", "deviation")):
        replaced = priors.with_common(lambda: prior, common, parts)()
        for name, values, before, after in zip(("mean", "deviation"), replaced, prior, common, strict=True):
            assert (values[:, :3] == (after if name in parts else before[:, :3])).all()
            assert (values[:, 3] == before[:, 3]).all()


def test_occlusion(folder, out, monkeypatch):
    monkeypatch.setattr(occlusion, "STEPS", {"srnn": 2})
    monkeypatch.setattr(occlusion, "METHODS", {"srnn": {"latent": 2, "width": 4}})
    occlusion.main(folder / "people.npz", out, "simulated", length=8.0, stride=75, seeds=2, samples=2)
    errors, differences = tables(out, "occlusion/errors", "occlusion/differences")
    assert [row[0] for row in errors[1:]] == ["straight line", f"{occlusion.NEIGHBOURS} neighbours", "srnn"]
    assert all(float(cell.split()[0]) > 0 for row in errors[1:] for cell in row[1:3])
    error, line, more = (float(row[1].split()[0]) for row in (errors[3], errors[1], differences[2]))
    assert abs(error - line - more) < 0.11  # of three rounded numbers


def test_ranking(folder, out, monkeypatch):
    """Results are fitted and scored only once; differences are between rows; later runs are added."""
    methods = {"cvae": {"width": 4, "latent": 2}, "srnn": {"width": 4, "latent": 2, "warm_up": 1}}
    small = {name: {**options, "steps": 2, "batch_size": 4} for name, options in methods.items()}
    monkeypatch.setattr(ranking, "SETS", {"simulated": ranking.Set("people.npz", small)})
    monkeypatch.setattr(ranking, "fitted_metric_models", lambda *arguments: {})
    monkeypatch.setattr(ranking, "ENOUGH", 2)
    runs, scores = folder / "ranked", folder / "scores"
    picture = folder / "ranking.png"
    options = {"scores": scores, "results": out, "picture": picture, "samples": 2, "sets": ("simulated",)}
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match=r"finds no GPU.*; leave the accelerator out"):
        ranking.main(runs, folder, accelerator="cuda", **options)
    ranking.main(runs, folder, seeds=(0,), accelerator="cpu", **options)
    ranking.main(runs, folder, seeds=(0, 1), methods=("srnn",), **options)
    archive = ranking.archive(scores, "simulated")
    before = archive.file.stat().st_mtime_ns
    assert len(archive.names) == 4  # of three runs, and of the references
    shutil.rmtree(runs)
    ranking.main(runs, folder, seeds=(0, 1), methods=("srnn",), **options)  # scored, which is enough
    assert not runs.exists()
    ranking.main(runs, **options)
    assert before == archive.file.stat().st_mtime_ns
    (best,) = re.findall(
        r"^May be the best, .* with 2 seeds or more: (.*)\.$", results.read("index/simulated", out).note
    )
    assert set(best.split(", ")) <= {"zero velocity", "nearest neighbours", "srnn"}  # the other has one seed
    (rows,) = tables(out, "index/simulated")
    by_name = {row[0]: row for row in rows[1:]}
    assert by_name.keys() == {"zero velocity", "nearest neighbours", *methods}
    assert (by_name["cvae"][1], by_name["srnn"][1]) == ("1", "2")
    energies = [float(row[5].split()[0]) for row in rows[1:]]
    assert energies == sorted(energies)
    for row, energy, before in zip(rows[2:], energies[1:], energies, strict=False):
        assert abs(float(row[4].split()[0]) - (energy - before)) < 0.0016  # of three rounded numbers


def test_reading_a_table_returns_the_written_table(out, capsys):
    table = results.Table(["", "a, b"], [["`p(z | x)`", 'the "first" ± 1'], ["ä", ""]], "A note.")
    results.write(out, {"some/table": table})
    assert results.read("some/table", out) == table
    results.write(out, {"some/table": table._replace(note="")})
    assert results.read("some/table", out).note == ""
    results.write(None, {"some/table": table})
    assert "A note.\n\n|  | a, b |\n| --- | ---: |\n| `p(z \\| x)` |" in capsys.readouterr().out


def test_minutes_are_means_over_fits_on_a_cpu():
    def cells(**minutes):
        runs = [
            {"minutes": n, "config": {"training": {"accelerator": accelerator}}} for accelerator, n in minutes.items()
        ]
        return ranking.training_cells(engine.Row(runs))

    assert cells(auto=4.0, cuda=1.0) == ("2", "4.0")
    assert cells(auto=4.0, cpu=6.0) == ("2", "5.0")
    assert cells(cuda=1.0) == ("1", "GPU")


def test_selected_futures_have_the_nearest_lower_bodies():
    """Distances are over all frames; the first future is selected too."""
    drawn = torch.randn(60, 2, 5, 4, generator=torch.Generator().manual_seed(0))

    class Drawn(torch.nn.Module):
        generative = inference = None

        def forecast(self, past, horizon, samples, **options):
            return {"x": drawn[:samples], "z": drawn}

    nearest = ranking.NearestLowerBody(Drawn(), [0, 3]).forecast({}, 5, 3)["x"]
    assert nearest.shape == (3, 2, 5, 4)
    assert nearest[0].equal(drawn[0])
    for sequence in range(2):
        distances = [(each[:, [0, 3]] - drawn[0, sequence][:, [0, 3]]).norm() for each in drawn[:, sequence]]
        expected = [drawn[n, sequence] for n in np.argsort(distances)[:3]]
        assert all(map(torch.equal, nearest[:, sequence], expected))


def test_futures_with_a_fixed_lower_body_differ_only_in_the_upper_body(folder, monkeypatch):
    """Futures with a fixed lower-body draw share the motion of the lower body."""
    small = {"pose_prior": 0.0, "draws": (2, 2), "latent": 4, "width": 4, "steps": 2, "batch_size": 4}
    monkeypatch.setattr(ranking, "SETS", {"simulated": ranking.Set("people.npz", {})})
    views = [ranking.View(parts=parts) for parts in ("free", "held", "nearest")]
    ranking.work(folder, folder / "parts", folder / "parts", "simulated", {"gsps": small}, {"gsps": views}, (0,), 3)
    free, held, nearest = (ranking.entries(folder / "parts", "simulated", view, ["gsps"]) for view in views)
    assert "nearest neighbours" in free
    assert held.keys() == nearest.keys() == {"gsps"}
    assert (held["gsps"].values("APD lower") == 0).all()
    assert (held["gsps"].values("APD upper") > 0).all()
    whole, *parts = (free["gsps"].values(f"APD{part}") for part in ("", " lower", " upper"))
    assert (np.minimum(*parts) > 0).all()
    assert (nearest["gsps"].values("APD lower") > 0).all()
    assert (nearest["gsps"].values("APD lower") < parts[0]).all()
    assert (np.maximum(*parts) < whole).all()
    assert (whole < sum(parts)).all()


def test_metric_models_contain_no_paths_and_are_written_once(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(ranking.METRIC_MODELS, "prior", ("pose-prior", {}, Training(2, 4, progress=False)))
    data = motion.MotionData.open(folder / "people.npz", motion.PROTOCOLS["simulated"])
    config = ranking.fitted_metric_models(data, tmp_path, ["prior"])["prior"] / "config.json"
    before = config.stat()
    assert Run(config.parent).config["data"]["path"] == "people.npz"
    ranking.fitted_metric_models(data, tmp_path, ["prior"])
    assert (config.stat().st_ino, config.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_every_row_has_a_folder_of_its_own():
    """A sweep accepts the names."""
    sets = [each.methods for each in ranking.SETS.values()]
    for rows in [*sets, *(each.rows for each in papers.PAPERS.values()), *(s.cases for s in tuning.SECTIONS.values())]:
        folders = [engine.folder(row) for row in rows]
        assert len({*folders}) == len(rows)
        assert all(re.fullmatch(r"[\w.=+-]+", name) for name in folders), folders


def test_every_row_has_options_of_its_method():
    sets = [each.methods for each in ranking.SETS.values()]
    for rows in [*sets, *(each.rows for each in papers.PAPERS.values())]:
        for row, options in rows.items():
            method_options, training = ranking.split_options(options)
            built = method(method_options.pop("method", row), **method_options)
            replace(built.trainings[""], **training)


def test_groups_are_of_the_first_word():
    people = motion.simulate(clips=2, frames=80, seed=1)
    contents = ("walk-turn-left", "run")
    clips = [replace(clip, labels={"content": name}) for clip, name in zip(people, contents, strict=True)]
    data = ranking.with_groups(
        motion.MotionData("", motion.MotionSet(clips, people.skeleton), motion.PROTOCOLS["simulated"])
    )
    assert [clip.labels["group"] for clip in data.motion] == ["walk", "run"]
    assert [clip.labels["content"] for clip in data.motion] == list(contents)


def test_a_second_stage_uses_the_first_stage_of_its_set(folder, tmp_path, monkeypatch):
    """Fit the first stage even if it is not selected."""
    small = {"width": 4, "latent": 2, "batch_size": 4}
    methods = {"cvae": {**small, "steps": 3}, "dlow": {"modes": 2, "steps": 2, "batch_size": 4}}
    monkeypatch.setattr(ranking, "SETS", {"simulated": ranking.Set("people.npz", methods)})
    monkeypatch.setattr(ranking, "fitted_metric_models", lambda *arguments: {})
    ranking.main(tmp_path, folder, ("simulated",), ("dlow",), (0,), 2, tmp_path / "scores")
    assert Run(tmp_path / "simulated" / "cvae-seed0").config["training"]["steps"] == 3
    assert not any(name.startswith("cvae-") for name in ranking.archive(tmp_path / "scores", "simulated").names)


def test_a_set_like_another_shares_its_metric_models_and_reference_rows(folder, tmp_path, capsys, monkeypatch):
    """Windows are shared too; rows of methods are separate."""
    small = {"width": 4, "latent": 2, "warm_up": 1, "batch_size": 4}
    first = ranking.Set("people.npz", {"srnn": {**small, "steps": 2}})
    second = replace(first, methods={"srnn": {**small, "steps": 3}}, like="simulated")
    sets_with_metric_models = []
    monkeypatch.setattr(ranking, "SETS", {"simulated": first, "longer": second})
    monkeypatch.setattr(
        ranking, "fitted_metric_models", lambda data, path, names: sets_with_metric_models.append(path.name) or {}
    )
    for name in ranking.SETS:
        assert ranking.rows_of(tmp_path / "scores", "longer", ranking.View()) == {}  # no table of reference rows alone
        ranking.main(tmp_path, folder, seeds=(0,), samples=2, sets=(name,), scores=tmp_path / "scores")
    assert sets_with_metric_models == ["simulated", "simulated"]
    names = ranking.archive(tmp_path / "scores", "longer").names
    assert names
    assert not any(name.startswith(f"{ranking.REFERENCES}/") for name in names)
    assert [Run(tmp_path / name / "srnn-seed0").config["training"]["steps"] for name in ranking.SETS] == [2, 3]
    table = [line.split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    once, again = (row[6:] for row in table if "nearest neighbours" in row[1])
    assert once == again


def test_papers(folder, out, monkeypatch):
    """Rows appear in their views; a change is the difference of its rows; published cells stay."""
    small = {"latent": 2, "width": 4, "feedforward": 4, "steps": 2, "batch_size": 4}
    paper = papers.Paper(
        "simulated-trajectories",
        {"trajevae": small, "whole poses": {**small, "method": "trajevae", "complement": False}},
        {"scores": ("APD", "ADE")},
        [("trajevae", "whole poses")],
        ("ADE",),
        {"Human3.6M: TrajeVAE, 0": {"APD": "8.462", "ADE": ".518"}},
        (ranking.View(0), ranking.View(1)),
        [
            papers.Further("one-motion", "One motion.", [ranking.View(1, single=True)], ["trajevae"]),
            papers.Further("another", "Another.", [ranking.View(1, exchanged=9.0)], []),
        ],
    )
    monkeypatch.setattr(papers, "PAPERS", {"page": paper})
    monkeypatch.setattr(ranking, "SETS", {paper.set: ranking.Set("people.npz", {})})
    monkeypatch.setattr(ranking, "JOINTS", ("RFoot",))
    monkeypatch.setattr(papers, "JOINTS", ("RFoot",))
    folders = {"stored": folder / "scores", "results": out, "pictures": folder}
    for data in (folder, None):
        papers.main(folder / "papers", data, ("page",), samples=3, seeds=(0, 1), **folders)
    names = ("scores", "changes", "further-paths", "one-motion-scores")
    assert {file.stem for file in (out / "page").glob("*.csv")} == {*names}
    rows, compared, more, single = tables(out, *(f"page/{name}" for name in names))
    cells = {(row[0], row[1]): row[2:] for row in rows[1:]}
    runs = {(name, count) for name in paper.rows for count in "01"}
    assert cells.keys() == {("zero velocity", ""), ("nearest neighbours", ""), ("*Human3.6M: TrajeVAE*", "0"), *runs}
    assert cells["*Human3.6M: TrajeVAE*", "0"] == ["", "", "8.462", ".518"]
    ades = {key: float(cells[key][3].split()[0]) for key in runs}
    for count, change in zip("01", compared[1][3:], strict=True):
        assert abs(float(change.split()[0]) - (ades["trajevae", count] - ades["whole poses", count])) < 0.0016
    assert more[0][1:] == ["score", "RFoot too"]
    assert float(more[1][2].split()[0]) == pytest.approx(ades["trajevae", "1"] - ades["trajevae", "0"], abs=0.0016)
    assert [row[:2] for row in single[1:]] == [["trajevae", "1"]]
    assert single[1][4].startswith("0.000")  # one motion has no diversity
    assert (folder / "page.png").stat().st_size > 0
    rows_by_view = {view: ranking.entries(folder / "scores", paper.set, view, paper.rows) for view in paper.views}
    errors, *_ = papers.draw_scores(rows_by_view, paper).axes
    for row, line in zip(paper.rows, (line for line in errors.lines if line.get_marker() == "o"), strict=True):
        assert [*line.get_xdata()] == [0, 1]
        assert line.get_ydata() == pytest.approx([ades[row, count] for count in "01"], abs=0.0006)


def test_tuning(folder, out, monkeypatch):
    """Cases of one method, and of another with paths; scored once."""
    training = Training(steps=2, batch_size=4)
    cases = {"preset": {}, "wide, longer": {"width": 6, "steps": 3}}
    paths = replace(motion.PROTOCOLS["simulated-trajectories"], name="paths")
    sections = {
        "cvae": tuning.Section("cvae", training, cases, protocol=motion.PROTOCOLS["simulated"], seeds=(0, 1)),
        "cvae-rnn": tuning.Section("cvae-rnn", training, {"preset": {}}, {"width": 4}, paths),
    }
    usual = motion.PROTOCOLS["simulated"]
    patched(monkeypatch, tuning, SECTIONS=sections, TUNING=usual, JOINTS=(), SAMPLES=2)
    monkeypatch.setattr(tuning, "fitted_metric_models", lambda *arguments: {})
    for data in (folder / "people.npz", None):
        tuning.main(folder / "tuned", data, tuple(sections), stored=folder / "tuning", results=out)
        futures, paths = (
            {row[0]: row[1:] for row in table[1:]} for table in tables(out, "tuning/cvae", "tuning/cvae-rnn")
        )
        assert futures.keys() == {*tuning.REFERENCES, *cases}
        assert paths.keys() == {*tuning.REFERENCES, "preset"}
        assert re.match(r"[\d.]+ \([\d.]+, [\d.]+\)", futures["preset"][0])
        assert futures["preset"] != futures["wide, longer"]
        assert tuning.Store(folder / "tuning", "cvae").scores.keys() == cases.keys()
        shutil.rmtree(folder / "tuned", ignore_errors=True)  # scored, which is enough
    failing = {"without a prior": {"method": "gsps", "pose_prior_run": "nowhere"}}
    monkeypatch.setitem(sections, "cvae", replace(sections["cvae"], cases=failing))
    with pytest.raises(RuntimeError, match="without-a-prior-seed0 failed"):
        tuning.main(folder / "tuned", folder / "people.npz", ("cvae",), stored=folder / "tuning")


def test_pose_priors_are_tuned_by_their_density(folder, tmp_path, out, monkeypatch):
    """The density includes the determinant, which the score of futures leaves out."""
    protocol = motion.PROTOCOLS["simulated"]
    training = Training(2, 4, learning_rate=0.01, progress=False)
    patched(
        monkeypatch,
        tuning,
        TUNING=protocol,
        SECTIONS={"none": tuning.Section("cvae", Training(), {}, protocol=protocol)},
        STEPS={"prior": (1, 30)},
        OF_METRIC_MODELS=["prior 1 steps", "prior 30 steps"],
        SEEDS_OF={"prior": (0, 1)},
        METRIC_MODELS={"prior": ("pose-prior", {}, training)},
    )
    tuning.main(tmp_path, folder / "people.npz", ("metric_models",), stored=tmp_path / "scores", results=out)
    (rows,) = tables(out, "tuning/metric_models")
    assert [row[-1] for row in rows[1:]] == ["–", "–"]
    scores = tuning.Store(tmp_path / "scores", "metric_models").scores
    assert all(seeds.keys() == {"0", "1"} for seeds in scores.values())
    prior = load(tmp_path / "metric_models" / "prior-30-steps-seed1").model
    prior_scores = scores["prior 30 steps"]["1"]
    windows = tuning.selection_windows(motion.MotionData.open(folder / "people.npz", protocol)).all()["x"]
    density = prior.log_prob(prior.facing(windows)[:, protocol.observed :]).mean().item()
    assert prior_scores["log density"] == pytest.approx(density, abs=1e-3)
    assert abs(prior_scores["pose NLL"] + density) > 1


def test_gsps_uses_the_pose_prior_of_the_metric_models_for_rotated_poses_only(tmp_path):
    cases = ("6500 steps", "not turned")
    pose_priors = {case: tuning.SECTIONS["gsps"].of(case, tmp_path)[0].pose_prior_run for case in cases}
    assert pose_priors == {"6500 steps": str(tmp_path), "not turned": ""}


def test_irregular(tmp_path, out, monkeypatch):
    """Fitted and scored once, whatever is asked again; runs are scored on the same halves of the same sequences."""
    random = np.random.default_rng(0)
    parts = ["train", "validation", "test"] * 4
    series = [Series(str(n), random.normal(size=(5 + n, 2)), split=part) for n, part in enumerate(parts)]
    panel = Panel(series, Columns((Column("a"), Column("b"))))
    training, size = {"batch_size": 3, "validate_every": 2}, {"width": 4, "decoder": ()}
    monkeypatch.setattr(irregular, "domain", lambda name: panel)
    patched(monkeypatch, irregular, STEPS={2: 2}, SIZE=size, TRAINING=training, PARTICLES=3)
    options = {"runs": tmp_path / "runs", "results": out, "seeds": (0, 1), "latents": (2,)}
    irregular.main(part="test", **options)
    with nothing_new(out, tmp_path / "runs"):
        irregular.main(part="test", **options)
    (table,) = tables(out, "irregular/latent-2")
    rows = {row[0]: row[1:] for row in table[1:]}
    for share in irregular.KEPT:
        whole, halves, less = (
            float(cell.split()[0])
            for cell in (rows[f"whole, tested on {share}"][0], *rows[f"halves, tested on {share}"][:2])
        )
        assert abs(halves - whole - less) < 0.0016  # of three rounded numbers
        assert f"independent frames, tested on {share}" in rows


def test_halves_have_distinct_frames_with_the_times_between_them():
    sequences = [np.arange(n, dtype=float)[:, None].repeat(2, 1) for n in (3, 8, 12)]
    batch = irregular.batch_of(sequences, 0.5, 3)
    assert batch["lengths"].tolist() == [2, 4, 6]
    for x, d, length in zip(batch["x"][..., 0], batch["d"][..., 0], batch["lengths"], strict=True):
        assert torch.equal(x[:length].diff(), d[1:length])  # values are times
        assert (d[1:length] >= 1).all()
        assert not d[length:].any()
    assert len(irregular.frames(batch)) == 12
    whole = irregular.batch_of(sequences, 1.0, 3)
    assert torch.equal(irregular.frames(whole), torch.cat([torch.from_numpy(x).float() for x in sequences]))


def test_every_entry_of_a_gap_has_the_length_of_the_gap():
    mask = torch.tensor([1, 0, 0, 1, 1, 0, 0, 0, 1, 0]).bool()
    assert occlusion.bursts(mask[None, :, None])[0, :, 0].tolist() == [0, 2, 2, 0, 0, 3, 3, 3, 0, 1]


@pytest.fixture
def benches(tmp_path, monkeypatch, capsys):
    """Run benchmarks with given rows, one tuple for each measurement; return the status and the last line."""
    monkeypatch.setattr(bench, "HISTORY", tmp_path / "history.json")
    monkeypatch.setattr(bench, "tabulate", partial(bench.tabulate, results=tmp_path))
    monkeypatch.setattr(bench, "measure_at_commit", lambda *_: {})

    def run(*measurements, targets=BENCHES, commit="b", version="1.0", keep=False):
        remaining = [dict(zip(targets, rows, strict=False)) for rows in measurements]
        monkeypatch.setattr(bench, "measured", lambda *_: (dict(remaining.pop(0)), targets))
        monkeypatch.setattr(bench, "commit", lambda: commit)
        monkeypatch.setattr(bench.dvae, "__version__", version)
        status = bench.main(("speed",), threads=torch.get_num_threads(), out=tmp_path / "out.json", keep=keep)
        assert not remaining
        return status, capsys.readouterr().out.splitlines()[-1].strip()

    run.row = lambda name: {row[0]: row[1:] for row in results.read("speed/history", tmp_path).rows}[name]
    run.history = tmp_path / "history.json"
    return run


BENCHES = {
    "speed: step": ("at most", 2.0),
    "speed: gain": ("at least", 3.0),
    "speed: cost": ("at most", None),
    "speed: exponent": ("under", 1.1),
}


def test_a_row_that_is_slower_than_at_the_last_release_fails_by_its_name(benches):
    benches((1.0, 4.0, 7.0, 0.01), commit="a", keep=True)
    assert benches((1.09, 3.7, 7.6, 0.9))[0] == 0  # within a tenth; an exponent within its bound
    assert benches((1.3, 4.0, 9.0, 0.01), (1.05, 4.0, 7.0, 0.01))[0] == 0  # the better of two
    step = (1, "speed: step: 1.20 was 1.00 at the last release")
    assert benches((1.3, 4.0, 7.0, 0.01), (1.2, 4.0, 7.0, 0.01)) == step
    gain = (1, "speed: gain: 2.90 was 4.00 at the last release")  # lower is worse
    assert benches((1.0, 2.0, 7.0, 0.01), (1.0, 2.9, 7.0, 0.01)) == gain
    cost = (1, "speed: cost: 8.00 was 7.00 at the last release")  # has no target
    assert benches((1.0, 4.0, 8.0, 0.01), (1.0, 4.0, 8.0, 0.01)) == cost
    assert benches((1.0, 4.0, 7.0, 1.2), (1.0, 4.0, 7.0, 1.2)) == (
        1,
        "speed: exponent: 1.20 was 0.01 at the last release",
    )


def test_the_table_has_the_last_number_of_each_row_in_the_version(benches):
    benches((1.0, 4.0, 7.0, 0.01), commit="a", version="0.9", keep=True)
    benches((1.0, 5.0, 7.0, 0.01), commit="b", keep=True)
    benches((0.8,), commit="c", keep=True)
    assert benches.row("speed: step") == ["at most 2", "yes", "0.80", "1.00", "0.80"]  # the release is b
    assert benches.row("speed: gain") == ["at least 3", "yes", "5.00", "4.00", "1.25"]  # it is a for b


PUBLIC_CODE = {
    "config/motion/cfg_storn.ini": "[Network]\nname = STORN\nx_dim = 96\nz_dim = 3\n",
    "dvae/model/storn.py": """
import torch
class STORN(torch.nn.Linear):
    def forward(self, x):
        self.z_mean = self.z_logvar = self.z_mean_p = self.z_logvar_p = x.sum()
        return super().forward(x)
def build_STORN(cfg, device="cpu"):
    assert cfg.getint("Network", "z_dim") == 10
    return STORN(cfg.getint("Network", "x_dim"), 48, device=device)
""",
    "dvae/utils/loss.py": """
def loss_MPJPE(x, y):
    assert x.shape == y.shape == (5, 2, 48)  # steps first
    return (x - y).square().sum()
def loss_KLD(mean, logvar, mean_p, logvar_p):
    return mean - mean_p
""",
}


def test_a_step_of_the_public_code_trains_its_model(tmp_path):
    for name, text in PUBLIC_CODE.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    x = torch.randn(2, 5, 48)
    model, step = peers.public("storn", x, tmp_path)
    before = (model(x) - x).square().mean()
    assert peers.ratio("storn", lambda *_: step, x, None) > 0
    assert (model(x) - x).square().mean() < before


def test_peers_without_clone_and_package_are_left_out(monkeypatch, capsys):
    monkeypatch.delenv("DVAE_PUBLIC_CODE", raising=False)
    monkeypatch.setattr(peers.importlib.util, "find_spec", lambda _: None)
    assert peers.rows(torch.device("cpu")) == {}
    assert "DVAE_PUBLIC_CODE must name a clone" in (printed := capsys.readouterr().out)
    assert "it needs the package jax" in printed
    monkeypatch.setenv("DVAE_PUBLIC_CODE", "nowhere")
    with pytest.raises(ValueError, match="is 'nowhere', which has no folder config/motion"):
        peers.rows(torch.device("cpu"))


def test_a_target_that_was_missed_before_is_reported_without_failure(benches):
    benches((2.5, 4.0, 7.0, 0.01), commit="a", keep=True)
    assert benches((2.6, 4.0, 7.0, 0.01)) == (0, "speed: step: 2.60 must be at most 2")


def test_a_slower_row_is_compared_with_the_code_of_the_release(benches, monkeypatch):
    """This machine may be the slower one."""
    benches((1.0, 4.0, 7.0, 0.01), commit="a", keep=True)
    monkeypatch.setenv(bench.RELEASE_RUN, "1")
    assert benches((9.0, 1.0, 9.0, 0.01))[0] == 0  # no comparison
    monkeypatch.delenv(bench.RELEASE_RUN)
    requests = []
    release = {"speed: step": 1.15, "speed: cost": 6.0}  # the second did not get slower
    monkeypatch.setattr(bench, "measure_at_commit", lambda *given: requests.append(given[:2]) or release)
    assert benches((1.2, 4.0, 7.0, 0.01), (1.2, 4.0, 7.0, 0.01))[0] == 0
    assert benches((1.3, 4.0, 7.0, 0.01), (1.3, 4.0, 7.0, 0.01)) == (
        1,
        "speed: step: 1.30 was 1.15 at the last release",
    )
    assert requests == [("a", "speed")] * 2


def test_a_release_is_the_first_record_of_its_version(benches):
    benches((1.0, 4.0, 7.0, 0.01), commit="a", keep=True)
    benches((1.05, 5.0, 7.0, 0.01), keep=True)
    assert benches.row("speed: gain") == ["at least 3", "yes", "5.00", "4.00", "1.25"]
    fewer = {"speed: step": BENCHES["speed: step"], "speed: other": ("at most", None)}
    benches((1.08, 3.0), targets=fewer, keep=True)
    first, second = json.loads(benches.history.read_text())
    assert first["rows"] == dict(zip(BENCHES, (1.0, 4.0, 7.0, 0.01), strict=True))
    assert second["rows"] == {**dict(zip(BENCHES, (1.08, 5.0, 7.0, 0.01), strict=True)), "speed: other": 3.0}
    assert benches((1.12, 5.0, 7.0, 0.01), (1.12, 5.0, 7.0, 0.01), commit="c")[0] == 1  # compared with the first record
    benches((1.1, 5.0, 7.0, 0.01), commit="d", version="2.0", keep=True)
    assert benches((1.2, 5.0, 7.0, 0.01), commit="e", version="2.0")[0] == 0
    assert benches.row("speed: step") == ["at most 2", "yes", "1.10", "1.00", "1.10"]


def fail(error=RuntimeError("no graph")):
    raise error


def test_a_part_that_fails_loses_only_its_rows(benches, monkeypatch, tmp_path, capsys):
    parts = {"step": 1.0, "broken": fail, "filter": lambda: {"filter": 2.0, "filter-step": 3.0}}
    monkeypatch.setattr(speed, "rows", lambda _: parts)
    monkeypatch.setattr(trajevae_speed, "rows", lambda _: fail())
    earlier = {"speed: broken": 1.0, "speed: broken, B 512": 1.0, "speed: other": 1.0, "trajevae: step": 1.0}
    with pytest.MonkeyPatch.context() as context:
        context.setattr(bench, "measured", bench.measured)  # restores it
        benches(tuple(earlier.values()), targets=dict.fromkeys(earlier, ("at most", None)), keep=True)
    options = {"threads": torch.get_num_threads(), "out": tmp_path / "out.json", "keep": True}
    assert bench.main(("trajevae", "speed"), **options) == 1
    reasons = {"trajevae": "RuntimeError: no graph", "speed: broken": "RuntimeError: no graph"}
    printed = capsys.readouterr().out
    assert all(f"  {part} failed: {reason}\n" in printed for part, reason in reasons.items())
    rows = {"speed: step": 1.0, "speed: filter": 2.0, "speed: filter-step": 3.0}
    assert {key: json.loads((tmp_path / "out.json").read_text())[key] for key in ("rows", "failed")} == {
        "rows": rows,
        "failed": reasons,
    }
    assert json.loads(benches.history.read_text())[-1]["rows"] == {"speed: other": 1.0, **rows}
    assert results.read("speed/history", tmp_path).note.endswith("Failed: trajevae, speed: broken.")


def test_finished_parts_are_stored_before_the_end(benches, monkeypatch, tmp_path):
    monkeypatch.setattr(speed, "rows", lambda _: {"step": lambda: 1.0, "stopped": lambda: fail(KeyboardInterrupt)})
    with pytest.raises(KeyboardInterrupt):
        bench.main(("speed",), threads=torch.get_num_threads(), out=tmp_path / "out.json", keep=True)
    assert json.loads(benches.history.read_text())[-1]["rows"] == {"speed: step": 1.0}


def test_a_gpu_has_its_own_history(benches, monkeypatch, tmp_path):
    machine = {"device": "H200", "threads": torch.get_num_threads()}
    monkeypatch.setattr(bench, "require_gpu", lambda _: None)
    monkeypatch.setattr(bench, "machine", lambda _: machine)
    monkeypatch.setattr(startup, "first_step", lambda *options: float("--cuda-graph" in options))
    options = {"threads": torch.get_num_threads(), "out": tmp_path / "out.json", "keep": True}
    assert bench.main(("startup",), device="cuda", **options) == 0
    (record,) = json.loads((tmp_path / "gpu-history.json").read_text())
    assert record["machine"] == machine
    assert record["rows"] == {"startup: first step on a GPU": 0.0, "startup: first step with a CUDA graph": 1.0}
    assert [row[1] for row in results.read("speed/gpu-history", tmp_path).rows] == ["under 10"] * 2
    assert not benches.history.exists()


def test_a_fit_that_fails_has_no_time(monkeypatch):
    run = SimpleNamespace(
        run=lambda command, **_: SimpleNamespace(returncode=int("--bad" in command), stderr="no data")
    )
    monkeypatch.setattr(startup, "subprocess", run)
    assert startup.first_step("--good") >= 0
    with pytest.raises(RuntimeError, match="no data"):
        startup.first_step("--bad")


def test_steps_with_graphs_have_the_final_scheduled_sampling(monkeypatch):
    """A core of the processor takes the same steps."""
    steps = []
    monkeypatch.setattr(graphs, "step_of", lambda *arguments, **options: steps.append((arguments, options)))
    monkeypatch.setattr(graphs, "seconds", lambda *actions, **_: [1.0, 0.5, 2.0] if len(actions) == 3 else [16.0])
    parts = graphs.rows(torch.device("cuda"))
    assert {row for name in parts for row in (name, f"{name}, B 512", f"{name}, over a core")} >= {*graphs.TARGETS}
    for name, probability in (("cvae", 1.0), ("hit-dvae", 1.0), ("gsps", 0.0)):
        assert parts[name]() == {name: 2.0, f"{name}, B 512": 4.0, f"{name}, over a core": 128.0}
        assert {options["scheduled_sampling"] for _, options in steps} == {probability}
        assert [(cuda_graph, device.type) for (_, _, cuda_graph, device), _ in steps] == [
            (False, "cuda"),
            (True, "cuda"),
            (True, "cuda"),
            (False, "cpu"),
        ]
        steps.clear()


def test_a_release_is_measured_by_its_own_code(tmp_path, monkeypatch):
    """The code is in a temporary worktree."""
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", tmp_path]
    (tmp_path / "benchmarks").mkdir()
    program = 'import sys, pathlib; pathlib.Path(sys.argv[-1]).write_text(\'{"rows": {"speed: step": %s}}\')'
    for value in (1, 2):
        (tmp_path / "benchmarks" / "bench.py").write_text(program % value)
        subprocess.run([*git, "init", "-q"], check=True)
        subprocess.run([*git, "add", "-A"], check=True)
        subprocess.run([*git, "commit", "-qm", str(value)], check=True)
    monkeypatch.setattr(bench, "HERE", tmp_path / "benchmarks")
    before = subprocess.run([*git, "rev-parse", "HEAD~1"], check=True, capture_output=True, text=True).stdout.strip()
    assert bench.measure_at_commit(before, "speed", "cpu", 1) == {"speed: step": 1}
    assert bench.measure_at_commit(bench.commit(), "speed", "cpu", 1) == {"speed: step": 2}
    assert bench.measure_at_commit("0" * 40, "speed", "cpu", 1) == {}
    worktrees = subprocess.run([*git, "worktree", "list"], check=True, capture_output=True, text=True).stdout
    assert len(worktrees.splitlines()) == 1


def test_wrong_arguments_of_benchmarks_are_errors_before_any_measurement(tmp_path):
    for options, message in (
        ({"threads": 0}, "threads must be at least 1, got 0"),
        ({"out": tmp_path / "no" / "x.json"}, "is in a folder that does not exist; create .*no first"),
        ({"names": ("sped",)}, "sped"),
    ):
        with pytest.raises(SystemExit, match=message):
            bench.main(**options)


def test_recorded_products_have_the_shapes_of_the_work():
    x, y = torch.randn(3, 4, requires_grad=True), torch.randn(4, 2)
    query, token = torch.randn(2, 1, 5, 4), torch.randn(2, 1, 6, 4)
    with speed.Products() as noted:
        (x @ y).sum().backward()
        torch.baddbmm(torch.zeros(5, 3, 2), torch.randn(5, 3, 4), torch.randn(5, 4, 2))
        torch.mm(x.detach(), y, out=torch.empty(3, 2))
        torch.nn.functional.scaled_dot_product_attention(query, token, token, attn_mask=torch.zeros(2, 1, 5, 6))
    shapes = [
        [
            tuple(value.shape) for value in args if isinstance(value, torch.Tensor)
        ]  # without the mask, whose shape varies
        for _, args, _ in noted.calls
    ]
    assert shapes == [
        [(3, 4), (4, 2)],
        [(3, 2), (2, 4)],
        [(5, 3, 2), (5, 3, 4), (5, 4, 2)],
        [(3, 4), (4, 2)],
        [(2, 1, 5, 4), (2, 1, 6, 4), (2, 1, 6, 4)],
    ]
    noted.run()


def test_overview(tmp_path):
    overview.main(tmp_path / "overview.png", steps=1)
    assert (tmp_path / "overview.png").read_bytes().startswith(b"\x89PNG")


def test_packages(tmp_path):
    packages.main(tmp_path / "packages.png")
    assert (tmp_path / "packages.png").read_bytes().startswith(b"\x89PNG")
    graph = packages.imports()
    assert {"factorization", "networks", "distributions", "program", "inference", "models", "motion", "runs"} == set(
        graph
    ) - {"cli", "data", "tables", "testing"}
    assert len(graph) <= 12
    assert graph.has_edge("models", "inference")  # through links and a relative import
    assert graph.has_edge("inference", "program")


def test_packages_are_above_their_imports():
    graph = nx.DiGraph([("roof", "walls"), ("walls", "ground"), ("roof", "ground"), ("shed", "ground")])
    assert packages.levels_of(graph) == [["ground"], ["shed", "walls"], ["roof"]]
