"""Default training options: those of the paper on its skeleton, tuned ones elsewhere."""

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


def pose_schema(skeleton):
    return Poses.from_data(PROTOCOLS["h36m"], skeleton)


KINDS = {**registry.methods(), **registry.metric_models()}


@pytest.mark.parametrize(
    "name", [name for name, kind in KINDS.items() if issubclass(kind, PoseMethod) or len(kind.trainings) > 1]
)
def test_the_skeleton_of_a_paper_has_the_training_of_the_paper(people, name):
    method = KINDS[name]()
    paper, default = method.training(pose_schema(HUMAN36M)), method.training(people.schema)
    assert default == method.trainings[""]
    assert paper == method.trainings.get("human36m", default)
    assert paper.steps >= default.steps


def test_options_that_are_not_given_come_from_the_method(people, tmp_path, monkeypatch):
    kind = type(dvae.method("cvae"))
    monkeypatch.setattr(kind, "trainings", {"": Training(3, 5, 1e-4, 0.2)})
    quiet = {"progress": False, "accelerator": "cpu"}
    dvae.fit(dvae.method("cvae", **SMALL), people, out=tmp_path / "run", **{"batch_size": 2, **quiet})
    training = directory.read_config(tmp_path / "run").training
    assert (training.steps, training.batch_size, training.learning_rate, training.decay) == (3, 2, 1e-4, 0.2)
    methods = [dvae.method("cvae", **SMALL), dvae.method("vae", latent=2, hidden=(4,), warm_up=1)]
    sweep(methods, people, tmp_path / "both", (0,), {"steps": 2, **quiet}, jobs=1)
    for run, (steps, size, rate, decay) in {"cvae-seed0": (2, 5, 1e-4, 0.2), "vae-seed0": (2, 32, 1e-3, 0.5)}.items():
        training = directory.read_config(tmp_path / "both" / run).training
        assert (training.steps, training.batch_size, training.learning_rate, training.decay) == (
            steps,
            size,
            rate,
            decay,
        )
    assert dvae.fit(dvae.method("cvae", **SMALL), people, **quiet).step == 3


def test_show_prints_the_training_options_of_a_method(capsys):
    assert main(["show", "cvae"]) == 0
    output = capsys.readouterr().out
    assert (
        "training defaults for human36m: 39063 steps, batches of 64, adam, learning rate 0.001 that falls to 0"
        in output
    )
    assert "training defaults for other data: 2000 steps, batches of 32" in output
    assert main(["show", "pose-prior"]) == 0
    assert (
        "training defaults for human36m: 1225 steps, batches of 33, adam, learning rate 0.01" in capsys.readouterr().out
    )
    assert main(["show", "pose-prior", "--out", "graph.png"]) == 2
    assert "leave out --out" in capsys.readouterr().err
