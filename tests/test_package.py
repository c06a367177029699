"""What a package must be: one version, every module of the tree in it, and files beside it that say the same."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import dvae

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_version_is_written_once_and_said_alike():
    assert PROJECT["project"]["dynamic"] == ["version"]
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "dvae.__version__"}
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == dvae.__version__
    assert f"version = {{{dvae.__version__}}}" in (ROOT / "README.md").read_text(encoding="utf-8")
    assert f"## [{dvae.__version__}] - {citation['date-released']}\n" in (ROOT / "CHANGELOG.md").read_text("utf-8")


def test_every_package_of_the_tree_is_installed():
    """By name, as links lead to two of them, and two start before dvae is imported."""
    found = {path.parent.relative_to(ROOT / "dvae") for path in (ROOT / "dvae").rglob("__init__.py")}
    for linked in ("models", "inference"):
        found |= {path.parent.relative_to(ROOT) for path in (ROOT / linked).rglob("__init__.py")}
    names = {".".join(("dvae", *path.parts)) for path in found}
    starts = {"dvae.command": "dvae_command", "dvae.testing.plugin": "pytest_dvae"}
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == {starts.get(name, name) for name in names}


def test_what_the_workflow_runs_is_what_the_package_says_it_supports():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8"))
    versions = workflow["jobs"]["test"]["strategy"]["matrix"]["python"]
    assert f">={versions[0]}" == PROJECT["project"]["requires-python"]
    classifiers = {f"Programming Language :: Python :: {version}" for version in versions}
    assert classifiers == {c for c in PROJECT["project"]["classifiers"] if c.startswith("Programming Language")}


@pytest.mark.skipif(not shutil.which("make"), reason="make is not installed")
@pytest.mark.parametrize(
    ("gpu", "there", "expected"),
    [
        (False, True, ["torch==2.13.0+cpu", "torch==2.13.0"]),  # the second is there with the first
        (False, False, ["torch==2.13.0+cpu", "torch==2.13.0"]),
        (True, True, ["torch==2.13.0"]),
    ],
)
def test_the_environment_has_torch_for_the_cpu_unless_there_is_a_gpu(gpu, there, expected, tmp_path):
    if shutil.which("nvidia-smi") and not gpu:
        pytest.skip("there is a GPU")
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    asked = tmp_path / "asked.txt"
    pip = f'echo "$@" >> {asked}\ncase "$*" in *+cpu) exit {int(not there)};; esac'
    programs = {".venv/bin/python": pip, "bin/uname": "echo Linux", **({"bin/nvidia-smi": ""} if gpu else {})}
    for name, lines in programs.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"#!/bin/sh\n{lines}\n")
        (tmp_path / name).chmod(0o755)
    path = f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"
    arguments = ["make", "venv", f"PYTHON={sys.executable}", "TORCH_INDEX=wheels"]
    made = subprocess.run(arguments, cwd=tmp_path, env={**os.environ, "PATH": path}, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    installs = [line for line in asked.read_text().splitlines() if "torch==" in line]
    assert [line.split()[-1] for line in installs] == expected
    assert all("--extra-index-url wheels" in line for line in installs)
    assert ("takes the one for CUDA" in made.stdout) == (not gpu and not there)
