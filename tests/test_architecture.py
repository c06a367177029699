"""The house rules: imports run one way, one path leads to each package, nothing is tied to one machine."""

import ast
import importlib
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
}
# Motion is an application: beside itself, the methods and commands for it import it, and nothing else does.
MOTION = re.compile(
    r"dvae\.(motion|models\.motion|models\.baselines)\b|dvae\.cli\.(checks|data|fitting|futures|assessment|loading|report|segments)$"
)
# Tables likewise, but that any method is fitted to them.
TABLES = re.compile(r"dvae\.tables\b|dvae\.cli\.(checks|data|fitting|futures|assessment|loading|report|tables)$")


@cache
def sources():
    """Module name -> file, without going through the links."""
    files = [path for path in (ROOT / "dvae").rglob("*.py") if not {"models", "inference"} & set(path.parts)]
    found = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in files}
    for name in ("models", "inference"):
        files = (ROOT / name).rglob("*.py")
        found |= {".".join(("dvae", *path.relative_to(ROOT).with_suffix("").parts)): path for path in files}
    return found


def imports(module, path):
    """Absolute names of the modules of this project that a module imports, wherever in the file it does."""
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
    """What a module names by strings such as "dvae.models.family.vae:VAE", to be imported when it is asked for."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and re.fullmatch(r"dvae(\.\w+)+:\w+", str(node.value)):
            yield node.value.replace(":", ".")


def layer(module):
    return max(rank for name, rank in LAYERS.items() if f"{module}.".startswith(f"{name}."))


def test_imports_run_one_way():
    for module, path in sources().items():
        if module == "dvae.__init__":  # the façade shows all of them
            continue
        for target in (*imports(module, path), *named(path)):
            assert layer(target) <= layer(module), f"{module} imports {target}"


def test_motion_is_imported_by_its_own_methods_and_commands_alone():
    for module, path in sources().items():
        if module != "dvae.__init__" and not MOTION.match(module):
            assert not [target for target in imports(module, path) if target.startswith("dvae.motion")], module


def test_tables_are_imported_by_commands_alone():
    for module, path in sources().items():
        if module != "dvae.__init__" and not TABLES.match(module):
            assert not [target for target in imports(module, path) if target.startswith("dvae.tables")], module


def words(path):
    """Those of which the names in a module are made."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        name = next((getattr(node, field) for field in ("name", "id", "attr", "arg") if hasattr(node, field)), None)
        yield from re.findall(r"[a-z]+", re.sub("([A-Z])", r"_\1", name or "").lower())


def test_the_core_has_no_name_for_a_joint():
    for module, path in sources().items():
        if layer(module) < LAYERS["dvae.inference"]:
            assert not {*words(path)} & {"joints", "pose", "poses", "skeleton", "limb", "limbs", "bone", "bones"}, (
                module
            )


def test_the_core_and_inference_do_not_speak_of_motion():
    motion = re.compile(r"skeleton|\bmotion\b|zero velocity|multimodal_|\bADE\b", re.IGNORECASE)
    core = ("factorization", "distributions", "networks", "data", "program", "inference")
    for module, path in sources().items():
        if module.startswith(tuple(f"dvae.{part}" for part in core)):
            assert not motion.findall(path.read_text(encoding="utf-8")), module


def test_registries_alone_name_motion():
    """The one exception: what is known by name is imported when its name is given."""
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
    """Public classes, functions and types that a module defines, by name."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names = [node.name]
        else:  # a type has a name like a class, a constant is in capitals
            targets = node.targets if isinstance(node, ast.Assign) else []
            names = [target.id for target in targets if isinstance(target, ast.Name) and not target.id.isupper()]
        yield from (name for name in names if not name.startswith("_"))


def test_no_two_public_things_share_a_name():
    """Commands have the names of what they run, so the command line alone may repeat one."""
    places = {}
    for module, path in sources().items():
        for name in definitions(path) if not module.startswith(("dvae.cli", "dvae.command")) else ():
            places.setdefault(name, []).append(module)
    assert {name: modules for name, modules in places.items() if len(modules) > 1} == {}


def test_nothing_hides_a_module_of_its_name():
    for module in sources():
        package, _, name = module.removesuffix(".__init__").rpartition(".")
        if package:
            loaded = importlib.import_module(f"{package}.{name}")
            assert getattr(sys.modules[package], name) is loaded, module


def test_there_are_no_circles():
    graph = nx.DiGraph()
    for module, path in sources().items():
        for target in imports(module, path):
            while target not in sources() and f"{target}.__init__" not in sources():
                target = target.rpartition(".")[0]
            graph.add_edge(module, target)
    circles = [sorted(circle) for circle in nx.strongly_connected_components(graph) if len(circle) > 1]
    assert not circles


def test_methods_hold_no_loop_and_no_optimiser():
    for path in (ROOT / "models").rglob("*.py"):
        names = {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
        assert not names & {"backward", "zero_grad", "optim", "DataLoader"}, path.name


@pytest.mark.parametrize("name", ["models", "inference"])
def test_a_second_import_path_is_refused(name):
    command = [sys.executable, "-c", f"import {name}"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert f"import this package as dvae.{name}" in result.stderr


def test_the_public_names_exist():
    assert len(set(dvae.__all__)) == len(dvae.__all__)
    for name in dvae.__all__:
        assert getattr(dvae, name) is not None


def test_what_is_shown_is_found_where_it_is_imported_from():
    """Names that type checkers read, and the table by which they are imported when they are used."""
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
def test_what_takes_long_to_import_is_imported_when_it_is_used(program, unused):
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


def test_packages_of_an_extra_are_needed_where_they_are_used():
    done = subprocess.run([sys.executable, "-c", WITHOUT], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stderr.rstrip().endswith("ImportError: roma is not installed: pip install 'pyro-dvae[motion]'")


def test_every_module_can_be_imported_and_says_what_it_is():
    for module, path in sources().items():
        name = module.removesuffix(".__init__")
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or not path.read_text(), name
        importlib.import_module(name)


def test_nothing_is_tied_to_one_machine():
    absolute = re.compile(r"""(?:^|[\s"'(=])/(?:home|root|work|tmp|Users|opt)/""", re.MULTILINE)
    kept = [ROOT / name for name in ("Makefile", "README.md", "pyproject.toml", "constraints.txt", ".ci/run")]
    for path in [*sources().values(), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").rglob("*.py"), *kept]:
        assert not absolute.search(path.read_text(encoding="utf-8")), path


@pytest.mark.slow
def test_readme_example_beats_zero_velocity():
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert "steps=600" in example
    variables = {}
    exec(compile(example.replace("steps=600", "steps=120"), "README.md", "exec"), variables)  # a fifth does
    scores = variables["scores"]
    for error in ("ADE", "FDE", "MMADE", "MMFDE"):
        assert scores["model"][error].mean < 0.9 * scores["zero velocity"][error].mean
        behind = scores.difference("model", "zero velocity", error)
        assert behind.mean < -5 * behind.standard_error
