"""What is marked to be compiled: the same numbers, the same run, a word where there is nothing of it or no compiler.

The backend "eager" has torch read a function whole, as it does to compile it, and run what it has read.
"""

import os
import subprocess
import sys
from functools import partial

import pytest
import torch
from safetensors.torch import load_file
from stopping import At, interrupt

import dvae
from dvae import motion
from dvae.compiled import MARKED, compiled, compiling, requested, require_compiler
from dvae.inference.training.checkpoints import Run
from dvae.models.motion.mix_and_match import _aligned
from dvae.motion import HUMAN36M, WALKER, bodies, estimate_angle_limits
from dvae.motion.scoring import energies
from dvae.networks import Dense
from dvae.program.model import DynamicalVAE

S, B, T = 4, 2, 3


def poses(skeleton, *shape):
    generator = torch.Generator().manual_seed(0)
    return 0.3 * torch.randn(*shape, 3 * (skeleton.joints - 1), generator=generator, dtype=torch.float64)


def angles(skeleton):
    limits = estimate_angle_limits(poses(skeleton, 300), skeleton, 0.2)
    return lambda samples: energies.joint_angles(samples, limits, skeleton)


def surfaces(rotations):
    body, moved = bodies.human().to(rotations), rotations.new_zeros(B, T, 3)
    turns = torch.linalg.qr(torch.randn(B, T, body.joints, 3, 3, dtype=torch.float64))[0].to(rotations)
    return body.squared_error(rotations.new_zeros(B, body.parameters_of_shape), (rotations, moved), (turns, moved + 1))


VIEW = motion.Rotations(motion.simulate(clips=1, frames=4).with_rotations().skeleton, "quaternion")
QUATERNIONS = torch.randn(B, T, VIEW.size, dtype=torch.float64)
CASES = {
    "_limb_errors": (lambda x: energies.limb_length(x, x[0, :, 0] + 0.01, WALKER), poses(WALKER, S, B, T)),
    "_likeness": (lambda x: energies.pairwise_diversity(x, 100.0), poses(WALKER, S, B, T)),
    "_excess": (angles(WALKER), poses(WALKER, S, B, T)),
    "_excess, angles that some poses lack": (angles(HUMAN36M), poses(HUMAN36M, S, B, T)),
    "_squared_error": (surfaces, torch.randn(B, T, bodies.human().joints, 3, 3, dtype=torch.float64)),
    "_aligned": (lambda x: _aligned(x, x.new_ones(B, VIEW.skeleton.joints - 1), VIEW), QUATERNIONS),
}


def valued(function, values, seed=1):
    """What a function makes of values, and a gradient of it."""
    torch.manual_seed(seed)
    given = values.clone().requires_grad_()
    found = function(given)
    return found.detach(), torch.autograd.grad(
        (found * torch.linspace(1, 2, found.numel()).view_as(found)).sum(), given
    )


def test_everything_that_is_marked_is_held_to_these_laws():
    ours = {name for name, function in MARKED.items() if function.__module__.startswith("dvae.")} - {"_trifle"}
    assert {name.partition(",")[0] for name in CASES} == ours


@pytest.mark.parametrize("name", CASES)
def test_what_is_read_to_be_compiled_makes_the_same_numbers(name):
    function, values = CASES[name]
    expected = valued(function, values)
    with compiling("eager") as found:
        torch.testing.assert_close(valued(function, values), expected, rtol=1e-10, atol=1e-12)
    assert found.used == {name.partition(",")[0]}
    assert not requested()


def test_of_one_code_there_are_as_many_forms_as_shapes():
    """Torch has no more than eight of a function, and then runs it as it is."""
    total = compiled(lambda x: (2 * x).sum())
    with compiling("eager"):
        for size in range(1, 12):
            assert total(torch.ones(size)) == 2 * size


@compiled
def roughness(x):
    """A model's own energy."""
    return (x[:, 1:] - x[:, :-1]).square().sum((1, 2))


class Smooth(DynamicalVAE):
    """A model of one's own, with an energy that is marked."""

    def penalties(self, rollout, data, draws):
        return {"roughness": roughness(rollout.parameters("x", rollout.values["x"])[0])}


def smooth(kind=Smooth, seed=0):
    torch.manual_seed(seed)
    equations = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)"
    return kind(*equations, {"z": 2, "x": 3}, network=Dense(widths=(8,)))


X = torch.randn(24, 5, 3, generator=torch.Generator().manual_seed(0)).cumsum(1)


def fitted(model, **options):
    objective = dvae.Evidence(energy_weights={"roughness": 0.1} if isinstance(model, Smooth) else {})
    options = {"steps": 12, "batch_size": 8, "log_every": 1, "validate_every": 6, "progress": False} | options
    return dvae.fit(model, X[:16], X[16:], objective=objective, **options)


def check_runs(tmp_path):
    """A compiled run learns what another does, says so in its config, and is resumed bit for bit."""
    plain, whole = smooth(), smooth()
    fitted(plain)
    result = fitted(whole, compile=True, out=tmp_path / "whole")
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(value, plain.state_dict()[name], rtol=1e-5, atol=1e-6)
    with pytest.raises(KeyboardInterrupt):
        fitted(smooth(), compile=True, out=tmp_path / "parts", callbacks=[At(7, interrupt)])
    resumed = fitted(smooth(seed=9), compile=True, out=tmp_path / "parts", resume=True)
    assert Run(tmp_path / "parts").config["training"]["compile"] is True
    assert resumed.history == result.history
    last = [load_file(tmp_path / name / "last.safetensors") for name in ("whole", "parts")]
    assert all(torch.equal(value, last[1][name]) for name, value in last[0].items())


def test_a_run_asks_for_what_is_marked_and_says_where_there_is_nothing(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("dvae.inference.training.svi.require_compiler", asked.append)
    monkeypatch.setattr("dvae.inference.training.svi.compiling", partial(compiling, "eager"))
    check_runs(tmp_path)
    assert asked == [torch.device("cpu")] * 3
    with pytest.warns(
        UserWarning, match=r"compile=True changes nothing in this stage .* step of DynamicalVAE has nothing"
    ):
        fitted(smooth(DynamicalVAE), compile=True)


@pytest.mark.slow
def test_what_is_compiled_makes_the_same_numbers():
    """In single precision, to 1e-5; as in training, the gradient may be taken twice.

    The others take up to a minute each; `benchmarks/compiled.py`, which compiles all, ends above 1e-5.
    """
    require_compiler(torch.device("cpu"))
    function, values = CASES["_likeness"]
    expected = valued(function, values.float())
    with compiling() as used:
        found = valued(function, values.float())
        given = values.float().requires_grad_()
        total = function(given).sum()
        first, second = (torch.autograd.grad(total, given, retain_graph=True)[0] for _ in range(2))
    assert used.used == {"_likeness"}
    for ours, theirs in zip((found[0], *found[1]), (expected[0], *expected[1]), strict=True):
        assert (ours - theirs).norm() <= 1e-5 * theirs.norm()
    assert torch.equal(first, second)


@pytest.mark.slow
def test_runs_are_compiled_where_there_is_a_compiler(tmp_path):
    check_runs(tmp_path)


@pytest.mark.slow
def test_without_a_compiler_it_is_said_what_is_missing(tmp_path):
    code = """
import torch
from dvae.compiled import require_compiler
require_compiler(torch.device("cpu"))
"""
    missing = os.environ | {"CXX": "no-such-compiler", "TORCHINDUCTOR_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=missing, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    said = done.stderr.splitlines()[-1]
    assert "raised:" not in said
    assert said.startswith("RuntimeError: compile=True takes a C++ compiler and Python's headers")
    assert "no-such-compiler" in said
    assert "apt install g++" in said
