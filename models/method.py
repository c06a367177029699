"""What a method is: two equations, its networks and heads, and how it is trained. And the registry of them."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib.metadata import entry_points
from typing import Any, ClassVar, Literal

from ..heads import FixedNormal, HeadSpec, Normal, StudentT
from ..inference.objectives import Evidence, Objective
from ..inference.schedules import Linear, Schedule
from ..model import DynamicalVAE
from ..networks import NetworkSpec


@dataclass(frozen=True)
class Method:
    """A method of the literature. A subclass is one file of this package: its equations, networks and sizes.

    Args:
        latent: size of z.
        emission: distribution of x: "fixed" (normal, one learned scale per coordinate), "normal" (scale read from the
            parents) or "student" (Student t).
        residual: the mean of x_t is an offset from x_{t-1}, which the factor must read. Sharper one step ahead, but a
            free run can drift without bound.
        warm_up: steps over which the KL weight rises from 0 to 1.
        self_feeding: final probability that a frame of x's history is the model's own mean. It rises from 0 over a
            third of training, after the first tenth.

    Raises:
        ValueError: when an option is out of range.
    """

    name: ClassVar[str]
    source: ClassVar[str]
    generative: ClassVar[str]
    inference: ClassVar[str]

    latent: int = 16
    emission: Literal["fixed", "normal", "student"] = "fixed"
    residual: bool = False
    warm_up: int = 500
    self_feeding: float = 0.0

    def __post_init__(self) -> None:
        if self.latent < 1:
            raise ValueError(f"latent is {self.latent}; it must be at least 1")
        if self.warm_up < 0:
            raise ValueError(f"warm_up is {self.warm_up}; it must be at least 0")
        if not 0 <= self.self_feeding <= 1:
            raise ValueError(f"self_feeding is {self.self_feeding}; it must be a probability, between 0 and 1")

    def sizes(self) -> dict[str, int]:
        """Sizes of the latents."""
        return {"z": self.latent}

    def networks(self) -> Mapping[str, NetworkSpec]:
        """Networks by factor."""
        raise NotImplementedError

    def heads(self) -> Mapping[str, HeadSpec]:
        """Heads by factor."""
        kinds: dict[str, HeadSpec] = {
            "normal": Normal(residual=self.residual),
            "fixed": FixedNormal(scale=0.1, learned=True, residual=self.residual),
            "student": StudentT(residual=self.residual),
        }
        if self.emission not in kinds:
            raise ValueError(f"unknown emission {self.emission!r}; known: {', '.join(kinds)}")
        return {"p(x)": kinds[self.emission]}

    def build(self, data: Mapping[str, int]) -> DynamicalVAE:
        """The model for data of these sizes, such as {"x": 60}."""
        return DynamicalVAE(self.generative, self.inference, {**self.sizes(), **data}, self.networks(), self.heads())

    def objective(self) -> Objective:
        """What training minimises."""
        return Evidence(kl_weight=Linear(0.0, 1.0, steps=self.warm_up) if self.warm_up else 1.0)

    def feeding(self, steps: int) -> Schedule | float:
        """Probability of self-feeding over a run of `steps`."""
        if not self.self_feeding:
            return 0.0
        return Linear(0.0, self.self_feeding, steps=max(steps // 3, 1), delay=steps // 10)

    def config(self) -> dict[str, Any]:
        """The method in JSON's types; `from_config` reads it."""
        return {"method": self.name, **asdict(self)}


@cache
def methods() -> dict[str, type[Method]]:
    """Every known method by name: those of this package and of installed packages (entry points "dvae.methods")."""
    from . import dkf, equations, hit_dvae, srnn, vae, vrnn

    own: list[type[Method]] = [vae.VAE, dkf.DKF, srnn.SRNN, vrnn.VRNN, hit_dvae.HiTDVAE, equations.Equations]
    table = {method.name: method for method in own}
    for entry in entry_points(group="dvae.methods"):
        if entry.name in table:
            raise ValueError(f"the entry point {entry.value} has the name of a method that exists: {entry.name}")
        table[entry.name] = entry.load()
    return table


def method(name: str, **options: Any) -> Method:
    """A method by its name, with options in place of its defaults.

    Raises:
        ValueError: an unknown name or option, with the nearest known one.
    """
    table = methods()
    if name not in table:
        raise ValueError(f"unknown method {name!r}{_nearest(name, table)}; known: {', '.join(table)}")
    known = {field.name for field in fields(table[name])}
    for option in options:
        if option not in known:
            raise ValueError(
                f"{name} has no option {option!r}{_nearest(option, known)}; it has {', '.join(sorted(known))}"
            )
    return table[name](**options)


def from_config(config: Mapping[str, Any]) -> Method:
    """The method that `Method.config` wrote."""
    options = {key: tuple(v) if isinstance(v, list) else v for key, v in config.items() if key != "method"}
    if "method" not in config:
        raise ValueError(f"the configuration names no method: it holds {', '.join(config) or 'nothing'}")
    return method(config["method"], **options)


def _nearest(name: str, known: Any) -> str:
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
