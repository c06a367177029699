"""Registry of the methods of this package and of installed packages; a method's file is imported on first use."""

from __future__ import annotations

import ast
from collections import UserDict
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec, resolve_name
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typing_extensions import override

from ..options import nearest, tuples

if TYPE_CHECKING:
    from ..inference.training.recipe import Trainable
    from .method import Method

METHODS = {
    "vae": "dvae.models.family.vae:VAE",
    "dkf": "dvae.models.family.dkf:DKF",
    "storn": "dvae.models.family.storn:STORN",
    "vrnn": "dvae.models.family.vrnn:VRNN",
    "srnn": "dvae.models.family.srnn:SRNN",
    "rvae-causal": "dvae.models.family.rvae:CausalRVAE",
    "rvae-noncausal": "dvae.models.family.rvae:NonCausalRVAE",
    "dsae": "dvae.models.family.dsae:DSAE",
    "kvae": "dvae.models.family.kvae:KVAE",
    "rslds": "dvae.models.family.rslds:RSLDS",
    "csdi": "dvae.models.family.csdi:CSDI",
    "autoregressive": "dvae.models.family.autoregressive:Autoregressive",
    "moglow": "dvae.models.baselines.moglow:MoGlow",
    "moglow-paths": "dvae.models.baselines.moglow_paths:MoGlowPaths",
    "erd": "dvae.models.baselines.erd:ERD",
    "aclstm": "dvae.models.baselines.aclstm:ACLSTM",
    "hit-dvae": "dvae.models.motion.hit_dvae:HiTDVAE",
    "gsps": "dvae.models.motion.gsps:GSPS",
    "denoiser": "dvae.models.motion.denoiser:MotionDenoiser",
    "trajevae": "dvae.models.motion.trajevae:TrajeVAE",
    "cvae-rnn": "dvae.models.baselines.cvae_rnn:CVAERNN",
    "motion-infilling": "dvae.models.baselines.motion_infilling:MotionInfilling",
    "cvae": "dvae.models.baselines.cvae:CVAE",
    "bom": "dvae.models.baselines.bom:BestOfMany",
    "bom-parts": "dvae.models.baselines.bom_parts:BoMParts",
    "mt-vae": "dvae.models.baselines.mt_vae:MTVAE",
    "rhp": "dvae.models.baselines.rhp:RHP",
    "pose-knows": "dvae.models.baselines.pose_knows:PoseKnows",
    "dlow": "dvae.models.baselines.dlow:DLow",
    "dsf": "dvae.models.baselines.dsf:DSF",
    "mix-and-match": "dvae.models.motion.mix_and_match:MixAndMatchMotion",
    "motion-latent": "dvae.models.motion.motion_latent:MotionLatent",
    "equations": "dvae.models.family.equations:Equations",
}
METRIC_MODELS = {
    "pose-prior": "dvae.motion.metric_models.pose_prior:PosePrior",
    "action-classifier": "dvae.motion.metric_models.action_classifier:ActionClassifier",
}
"""Models that are fitted like methods and that evaluate what methods generate."""


class Registry(UserDict[str, Any]):
    """A mapping from names to classes, each imported on access.

    Args:
        builtin: mapping from name to "module:class".
        group: entry-point group through which installed packages add classes.

    Raises:
        ValueError: if an entry point has a name that already exists.
    """

    def __init__(self, builtin: Mapping[str, str], group: str) -> None:
        super().__init__({name: EntryPoint(name, value, group) for name, value in builtin.items()})
        for entry in entry_points(group=group):
            if entry.name in builtin:
                raise ValueError(
                    f"the entry point {entry.value} has the name {entry.name!r}, which {group} already has; rename it"
                )
            self[entry.name] = entry

    @override
    def __getitem__(self, name: str) -> type[Any]:
        return self.data[name].load()  # type: ignore[no-any-return]

    def texts(self, name: str, *attributes: str) -> list[str | None]:
        """Return attributes of a class; literals are read from its file, because importing torch takes seconds.

        Args:
            name: name of a method or metric model.
            attributes: attributes of the class or of its bases, such as "source".

        Returns:
            Values of the attributes; None for each attribute that is an option, a field of the dataclass.
        """
        literals = _literals(*self.data[name].value.split(":"))
        if not literals.keys() >= {*attributes}:
            kind = self[name]
            options = {field.name for field in fields(kind)}
            literals = {
                attribute: None if attribute in options else getattr(kind, attribute) for attribute in attributes
            }
        return [literals[attribute] for attribute in attributes]


@cache
def _literals(module: str, name: str) -> dict[str, str | None]:
    """Return the texts that a class and its bases assign to attributes, read from the source file.

    Args:
        module: name of the module, which is not imported.
        name: name of the class.

    Returns:
        Text of each attribute, or None for a field of the dataclass; empty if the source file does not exist.
    """
    package, *parts = module.split(".")
    spec = find_spec(package)  # finding the module itself would import its packages
    file = Path(spec.origin or "").parent.joinpath(*parts).with_suffix(".py") if spec is not None else Path()
    if not file.is_file():
        return {}
    tree = ast.parse(file.read_bytes())
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    imported = {
        alias.asname or alias.name: (
            resolve_name("." * node.level + (node.module or ""), module.rpartition(".")[0]),
            alias.name,
        )
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    if name not in classes:
        return _literals(*imported[name]) if name in imported else {}
    texts: dict[str, str | None] = {}
    for base in reversed(classes[name].bases):
        if isinstance(base, ast.Name):
            texts |= _literals(module, base.id)
    for line in classes[name].body:
        if isinstance(line, ast.Assign | ast.AnnAssign):
            target = line.target if isinstance(line, ast.AnnAssign) else line.targets[0]
            attribute = ast.unparse(target)
            texts.pop(attribute, None)
            if isinstance(line, ast.AnnAssign) and "ClassVar" not in ast.unparse(line.annotation):
                texts[attribute] = None
            elif isinstance(line.value, ast.Constant) and isinstance(line.value.value, str):
                texts[attribute] = line.value.value
    return texts


@cache
def methods() -> Registry:
    """Return every known method by name: from this package and from installed ones (entry points "dvae.methods").

    Example:
        >>> "hit-dvae" in dvae.methods(), dvae.methods()["vae"].generative
        (True, 'p(z_t) p(x_t | z_t)')
    """
    return Registry(METHODS, "dvae.methods")


@cache
def metric_models() -> Registry:
    """Return every known metric model by name, including entry points "dvae.metric_models"."""
    return Registry(METRIC_MODELS, "dvae.metric_models")


def method(name: str, **options: Any) -> Method:
    """Return a method by its name, with options in place of its defaults.

    Args:
        name: name of a method, one of `methods()`, such as "srnn".
        options: values that replace the defaults of the method's fields.

    Raises:
        ValueError: if the name or an option is unknown; the message names the nearest known one.

    Example:
        >>> dvae.method("srnn", latent=8).build({"x": 48}).sizes["z"]
        8
    """
    return _create(methods(), "method", name, options)  # type: ignore[no-any-return]


def metric_model(name: str, **options: Any) -> Trainable:
    """Return a metric model by its name, with options in place of its defaults."""
    return _create(metric_models(), "metric model", name, options)  # type: ignore[no-any-return]


def _create(table: Mapping[str, type[Any]], category: str, name: str, options: Mapping[str, Any]) -> Any:
    if name not in table:
        raise ValueError(f"unknown {category} {name!r}{nearest(name, table)}; known: {', '.join(table)}")
    kind = table[name]
    option_names = {field.name for field in fields(kind)}
    for option in options:
        if option not in option_names:
            raise ValueError(
                f"{name} has no option {option!r}{nearest(option, option_names)}; its options are "
                f"{', '.join(sorted(option_names))}"
            )
    return kind(**options)


def configured(config: Mapping[str, Any]) -> Trainable:
    """Return the method or metric model of a configuration written by `Trainable.config`."""
    if "method" not in config:
        raise ValueError(f"the configuration has no key 'method'; its keys are {', '.join(config) or '(none)'}")
    options = tuples(config)
    name = options.pop("method")
    return metric_model(name, **options) if name in metric_models() else method(name, **options)
