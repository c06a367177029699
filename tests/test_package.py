"""What a package must be: one version, every module of the tree in it, and files beside it that say the same."""

import tomllib
from pathlib import Path

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
    names = {".".join(("dvae", *path.parts)) for path in found | {Path("models"), Path("inference")}}
    starts = {"dvae.command": "dvae_command", "dvae.testing.plugin": "pytest_dvae"}
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == {starts.get(name, name) for name in names}


def test_what_the_workflow_runs_is_what_the_package_says_it_supports():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8"))
    versions = workflow["jobs"]["test"]["strategy"]["matrix"]["python"]
    assert f">={versions[0]}" == PROJECT["project"]["requires-python"]
    classifiers = {f"Programming Language :: Python :: {version}" for version in versions}
    assert classifiers == {c for c in PROJECT["project"]["classifiers"] if c.startswith("Programming Language")}
