"""How a method is fitted where nothing else is said: the paper's way on its skeleton, the tuned one elsewhere."""

from dataclasses import replace

import pytest

import dvae
from dvae import Training, motion
from dvae.cli.app import main
from dvae.models import registry
from dvae.models.motion.poses import PoseMethod
from dvae.motion import HUMAN36M, PROTOCOLS
from dvae.motion.data.dataset import MotionData
from dvae.motion.data.protocols import Poses
from dvae.runs import directory
from dvae.runs.sweep import sweep

SMALL = {"latent": 2, "width": 4, "hidden": (4,)}


@pytest.fixture(scope="module")
def people():
    protocol = replace(PROTOCOLS["simulated"], observed=3, predicted=4)
    return MotionData("simulated", motion.simulate(clips=6, frames=20, seed=1), protocol)


def posed(skeleton):
    return Poses.from_data(PROTOCOLS["h36m"], skeleton)


KINDS = {**registry.methods(), **registry.metric_models()}


@pytest.mark.parametrize(
    "name", [name for name, kind in KINDS.items() if issubclass(kind, PoseMethod) or len(kind.trainings) > 1]
)
def test_the_published_training_is_for_the_published_skeleton(people, name):
    method = KINDS[name]()
    paper, ours = method.training(posed(HUMAN36M)), method.training(people.schema)
    assert ours == method.trainings[""]
    assert paper == method.trainings.get("human36m", ours)
    assert paper.steps >= ours.steps


def test_a_run_that_is_told_some_options_has_the_method_s_own_beside_them(people, tmp_path, monkeypatch):
    kind = type(dvae.method("cvae"))
    monkeypatch.setattr(kind, "trainings", {"": Training(3, 5, 1e-4, 0.2)})
    quiet = {"progress": False, "accelerator": "cpu"}
    dvae.fit(dvae.method("cvae", **SMALL), people, out=tmp_path / "run", **{"batch_size": 2, **quiet})
    kept = directory.read_config(tmp_path / "run").training
    assert (kept.steps, kept.batch_size, kept.learning_rate, kept.decay) == (3, 2, 1e-4, 0.2)
    methods = [dvae.method("cvae", **SMALL), dvae.method("vae", latent=2, hidden=(4,), warm_up=1)]
    sweep(methods, people, tmp_path / "both", (0,), {"steps": 2, **quiet}, jobs=1)
    for run, (steps, size, rate, decay) in {"cvae-seed0": (2, 5, 1e-4, 0.2), "vae-seed0": (2, 32, 1e-3, 0.5)}.items():
        kept = directory.read_config(tmp_path / "both" / run).training
        assert (kept.steps, kept.batch_size, kept.learning_rate, kept.decay) == (steps, size, rate, decay)
    assert dvae.fit(dvae.method("cvae", **SMALL), people, **quiet).step == 3


def test_show_says_how_a_method_is_fitted(capsys):
    assert main(["show", "cvae"]) == 0
    said = capsys.readouterr().out
    assert "fitted to human36m in 39063 steps of 64, adam, learning rate 0.001, at the end 0" in said
    assert "fitted to other data in 2000 steps of 32" in said
    assert main(["show", "pose-prior"]) == 0
    assert "fitted to human36m in 1225 steps of 33, adam, learning rate 0.01" in capsys.readouterr().out
    assert main(["show", "pose-prior", "--out", "graph.png"]) == 2
    assert "leave out --out" in capsys.readouterr().err
