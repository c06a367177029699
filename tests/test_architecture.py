"""Architecture: imports follow the layers, each package has one import path, no path depends on a machine."""

import ast
import importlib
import importlib.util
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import networkx as nx
import pytest

import dvae

ROOT = Path(__file__).parent.parent
LAYERS = {
    "dvae": 0,
    "dvae.factorization": 1,
    "dvae.distributions": 1,
    "dvae.networks": 2,
    "dvae.data": 3,
    "dvae.program": 4,
    "dvae.inference": 5,
    "dvae.motion": 6,
    "dvae.tables": 6,
    "dvae.models": 7,
    "dvae.runs": 8,
    "dvae.testing": 8,
    "dvae.cli": 9,
    "dvae.command": 10,
    "dvae.__main__": 10,
}
# Only motion itself, and the methods and commands for motion, import it.
MOTION = re.compile(
    r"dvae\.(motion|models\.motion|models\.baselines)\b|dvae\.cli\.(checks|data|fitting|futures|assessment|loading|report|segments)$"
)
# Only tables and the commands for them import tables; methods do not.
TABLES = re.compile(r"dvae\.tables\b|dvae\.cli\.(checks|data|fitting|futures|assessment|loading|report|tables)$")

OPTIONAL = {"dvae.distributions.chain_kernel": "triton"}
"""Packages that are no dependencies, by the module that cannot be imported without them."""


@cache
def sources():
    """Return the file of each module, without following links."""
    files = [path for path in (ROOT / "dvae").rglob("*.py") if not {"models", "inference"} & set(path.parts)]
    files_by_module = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in files}
    for name in ("models", "inference"):
        files = (ROOT / name).rglob("*.py")
        files_by_module |= {".".join(("dvae", *path.relative_to(ROOT).with_suffix("").parts)): path for path in files}
    return files_by_module


def importable():
    """Return the modules whose packages are installed."""
    return [module for module in sources() if importlib.util.find_spec(OPTIONAL.get(module, "dvae"))]


def imports(module, path):
    """Return the absolute names of the project's modules that a module imports, anywhere in its file."""
    package = module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "dvae")
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            target = ".".join([*base, *([node.module] if node.module else [])])
            if target.split(".")[0] == "dvae":
                yield from (f"{target}.{alias.name}" for alias in node.names)


def named(path):
    """Return names in strings such as "dvae.models.family.vae:VAE", which are imported on demand."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and re.fullmatch(r"dvae(\.\w+)+:\w+", str(node.value)):
            yield node.value.replace(":", ".")


def layer(module):
    return max(rank for name, rank in LAYERS.items() if f"{module}.".startswith(f"{name}."))


def test_imports_follow_the_layers():
    for module, path in sources().items():
        if module == "dvae.__init__":  # the façade imports all layers
            continue
        for target in (*imports(module, path), *named(path)):
            assert layer(target) <= layer(module), f"{module} imports {target}"


def test_only_motion_methods_and_commands_import_motion():
    for module, path in sources().items():
        if module != "dvae.__init__" and not MOTION.match(module):
            assert not [target for target in imports(module, path) if target.startswith("dvae.motion")], module


def test_only_commands_import_tables():
    for module, path in sources().items():
        if module != "dvae.__init__" and not TABLES.match(module):
            assert not [target for target in imports(module, path) if target.startswith("dvae.tables")], module


def words(path):
    """Return the words in the names of a module."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        name = next((getattr(node, field) for field in ("name", "id", "attr", "arg") if hasattr(node, field)), None)
        yield from re.findall(r"[a-z]+", re.sub("([A-Z])", r"_\1", name or "").lower())


def test_names_in_the_core_do_not_mention_joints():
    for module, path in sources().items():
        if layer(module) < LAYERS["dvae.inference"]:
            assert not {*words(path)} & {"joints", "pose", "poses", "skeleton", "limb", "limbs", "bone", "bones"}, (
                module
            )


def test_the_core_and_inference_do_not_mention_motion():
    motion = re.compile(r"skeleton|\bmotion\b|zero velocity|multimodal_|\bADE\b", re.IGNORECASE)
    core = ("factorization", "distributions", "networks", "data", "program", "inference")
    for module, path in sources().items():
        if module.startswith(tuple(f"dvae.{part}" for part in core)):
            assert not motion.findall(path.read_text(encoding="utf-8")), module


def test_only_registries_name_motion_modules():
    """Registries are the only exception: they import by name on demand."""
    naming = {
        module: {target for target in named(path) if target.startswith("dvae.motion.")}
        for module, path in sources().items()
    }
    assert {module: targets for module, targets in naming.items() if targets} == {
        "dvae.models.registry": {
            "dvae.motion.metric_models.pose_prior.PosePrior",
            "dvae.motion.metric_models.action_classifier.ActionClassifier",
        },
        "dvae.runs.kinds": {
            "dvae.motion.data.protocols.Poses",
            "dvae.motion.data.dataset.MotionData",
            "dvae.motion.segments.embodied.SegmentSchema",
            "dvae.motion.segments.dataset.SegmentData",
        },
    }


def definitions(path):
    """Return the names of public classes, functions and types that a module defines."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names = [node.name]
        else:  # types are named like classes, constants in capitals
            targets = node.targets if isinstance(node, ast.Assign) else []
            names = [target.id for target in targets if isinstance(target, ast.Name) and not target.id.isupper()]
        yield from (name for name in names if not name.startswith("_"))


def test_public_names_are_unique():
    """Commands have the names of the functions that they run, so the command line is excluded."""
    places = {}
    for module, path in sources().items():
        for name in definitions(path) if not module.startswith(("dvae.cli", "dvae.command")) else ():
            places.setdefault(name, []).append(module)
    assert {name: modules for name, modules in places.items() if len(modules) > 1} == {}


def test_no_name_hides_a_module():
    for module in importable():
        package, _, name = module.removesuffix(".__init__").rpartition(".")
        if package:
            submodule = importlib.import_module(f"{package}.{name}")
            assert getattr(sys.modules[package], name) is submodule, module


def test_imports_have_no_cycles():
    graph = nx.DiGraph()
    for module, path in sources().items():
        for target in imports(module, path):
            while target not in sources() and f"{target}.__init__" not in sources():
                target = target.rpartition(".")[0]
            graph.add_edge(module, target)
    circles = [sorted(circle) for circle in nx.strongly_connected_components(graph) if len(circle) > 1]
    assert not circles


def test_methods_contain_no_training_loop():
    for path in (ROOT / "models").rglob("*.py"):
        names = {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
        assert not names & {"backward", "zero_grad", "optim", "DataLoader"}, path.name


@pytest.mark.parametrize("name", ["models", "inference"])
def test_a_second_import_path_is_an_error(name):
    command = [sys.executable, "-c", f"import {name}"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert f"import this package as dvae.{name}" in result.stderr


def test_the_public_names_exist():
    assert len(set(dvae.__all__)) == len(dvae.__all__)
    for name in dvae.__all__:
        assert getattr(dvae, name) is not None


def test_lazy_imports_match_the_imports_for_type_checkers():
    """Compare the names for type checkers with the table for lazy imports."""
    tree = ast.parse((ROOT / "dvae" / "__init__.py").read_text(encoding="utf-8"))
    imported = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level]
    places = {alias.name: node.module for node in imported for alias in node.names}
    del places["importing"]
    assert places == {name: dvae._MODULES.get(name) for name in dvae.__all__}
    assert set(dvae.__all__) <= set(dir(dvae))


@pytest.mark.parametrize(
    ("program", "unused"),
    [
        ("from dvae.cli import main; assert main(['--help']) == 0", "torch"),
        ("from dvae.cli import main; assert main(['fitt']) == 2", "torch"),
        ("from dvae.cli import main; assert main(['show', 'hitdvae']) == 2", "torch"),
        ("import dvae; dvae.audit(*map(dvae.Factorization.parse, ('p(z_t) p(x_t | z_t)', 'q(z_t | x_t)')))", "torch"),
        ("import dvae; list(dvae.methods())", "torch"),
        ("import dvae.motion", "roma"),
        ("import dvae.cli.fitting", "scipy.special"),
    ],
)
def test_slow_imports_are_lazy(program, unused):
    command = [sys.executable, "-c", f"{program}; import sys; assert {unused!r} not in sys.modules"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


WITHOUT = """
import sys
sys.modules |= dict.fromkeys(("roma", "pooch", "tensorboard"))
import dvae, torch
model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 2, "x": 3})
dvae.fit(model, torch.randn(8, 5, 3), steps=2, progress=False)
assert model.forecast(torch.randn(2, 5, 3), 3)["x"].shape == (1, 2, 3, 3)
dvae.motion.simulate(clips=2, frames=40)
dvae.motion.geometry.rotations.to_matrix(torch.ones(1, 3), "vector")
"""


def test_packages_of_an_extra_are_imported_on_use_only():
    process = subprocess.run([sys.executable, "-c", WITHOUT], cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.stderr.rstrip().endswith("ImportError: roma is not installed: pip install 'pyro-dvae[motion]'")


def test_every_module_can_be_imported_and_has_a_docstring():
    for module, path in sources().items():
        name = module.removesuffix(".__init__")
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or not path.read_text(), name
        if module in importable():
            importlib.import_module(name)


def test_no_file_contains_machine_paths():
    absolute = re.compile(r"""(?:^|[\s"'(=])/(?:home|root|work|tmp|Users|opt)/""", re.MULTILINE)
    others = [ROOT / name for name in ("Makefile", "README.md", "pyproject.toml", "constraints.txt", ".ci/run")]
    for path in [*sources().values(), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").rglob("*.py"), *others]:
        assert not absolute.search(path.read_text(encoding="utf-8")), path
