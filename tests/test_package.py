"""The package: one version, all modules of the tree, and consistent metadata."""

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


def test_the_version_is_the_same_in_all_files():
    assert PROJECT["project"]["dynamic"] == ["version"]
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "dvae.__version__"}
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == dvae.__version__
    assert f"version = {{{dvae.__version__}}}" in (ROOT / "README.md").read_text(encoding="utf-8")
    assert f"## [{dvae.__version__}] - {citation['date-released']}\n" in (ROOT / "CHANGELOG.md").read_text("utf-8")


def test_every_package_of_the_tree_is_installed():
    """Compare by name, because two packages are links, and two start before dvae is imported."""
    folders = {path.parent.relative_to(ROOT / "dvae") for path in (ROOT / "dvae").rglob("__init__.py")}
    for linked in ("models", "inference"):
        folders |= {path.parent.relative_to(ROOT) for path in (ROOT / linked).rglob("__init__.py")}
    names = {".".join(("dvae", *path.parts)) for path in folders}
    starts = {"dvae.command": "dvae_command", "dvae.testing.plugin": "pytest_dvae"}
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == {starts.get(name, name) for name in names}


def test_the_workflow_tests_the_supported_versions():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8"))
    versions = workflow["jobs"]["test"]["strategy"]["matrix"]["python"]
    assert f">={versions[0]}" == PROJECT["project"]["requires-python"]
    classifiers = {f"Programming Language :: Python :: {version}" for version in versions}
    assert classifiers == {c for c in PROJECT["project"]["classifiers"] if c.startswith("Programming Language")}


@pytest.mark.skipif(not shutil.which("make") or not shutil.which("timeout"), reason="make or timeout is not installed")
@pytest.mark.parametrize("failing", ["", "pytest", "bench ", "cards"])
def test_measurements_on_a_gpu_follow_failed_tests_in_an_existing_environment(failing, tmp_path):
    shutil.copy(ROOT / "Makefile", tmp_path)
    (tmp_path / "env" / "bin").mkdir(parents=True)
    python = tmp_path / "env" / "bin" / "python3"
    python.write_text(f'#!/bin/sh\necho "$@" >> log.txt\ncase "$*" in *"{failing or "none"}"*) exit 3;; esac\n')
    python.chmod(0o755)
    process = subprocess.run(["make", "gpu", "ENV=env"], cwd=tmp_path, capture_output=True, text=True)
    assert bool(process.returncode) == bool(failing), process.stderr
    modules = [line.split()[1] for line in (tmp_path / "log.txt").read_text().splitlines()]
    assert modules == ["pytest", "benchmarks.bench", "benchmarks.studies.cards"]
    assert not (tmp_path / ".venv").exists()


@pytest.mark.skipif(not shutil.which("make"), reason="make is not installed")
@pytest.mark.parametrize(
    ("gpu", "is_available", "expected"),
    [
        (False, True, ["torch==2.13.0+cpu", "torch==2.13.0"]),  # the first installation satisfies the second
        (False, False, ["torch==2.13.0+cpu", "torch==2.13.0"]),
        (True, True, ["torch==2.13.0"]),
    ],
)
def test_the_environment_has_torch_for_the_cpu_without_a_gpu(gpu, is_available, expected, tmp_path):
    if shutil.which("nvidia-smi") and not gpu:
        pytest.skip("there is a GPU")
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    log = tmp_path / "asked.txt"
    pip = f'echo "$@" >> {log}\ncase "$*" in *+cpu) exit {int(not is_available)};; esac'
    programs = {".venv/bin/python": pip, "bin/uname": "echo Linux", **({"bin/nvidia-smi": ""} if gpu else {})}
    for name, lines in programs.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"#!/bin/sh\n{lines}\n")
        (tmp_path / name).chmod(0o755)
    path = f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"
    arguments = ["make", "venv", f"PYTHON={sys.executable}", "TORCH_INDEX=wheels"]
    process = subprocess.run(arguments, cwd=tmp_path, env={**os.environ, "PATH": path}, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    installs = [line for line in log.read_text().splitlines() if "torch==" in line]
    assert [line.split()[-1] for line in installs] == expected
    assert all("--extra-index-url wheels" in line for line in installs)
    assert ("takes the one for CUDA" in process.stdout) == (not gpu and not is_available)
