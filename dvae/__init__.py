"""Dynamical variational autoencoders from their factorizations, on torch and Pyro.

>>> import dvae
>>> model = dvae.DynamicalVAE(
...     generative="p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)",
...     inference="q(w | x_{1:T}) q(z_t | x_{1:T}, w)",
...     sizes={"w": 32, "z": 16, "x": 48},
...     network=dvae.networks.Attention(width=64, heads=4),
... )
>>> dvae.audit(model.generative, model.inference).missing
{'z': ('z_{<t}',)}

Torch takes seconds to import, so that what is named here, and every subpackage, is imported when it is first used.
"""

import sys
from typing import TYPE_CHECKING

from .lazy import importing

__version__ = "0.1.0"

if sys.flags.optimize > 1:  # Pyro fills in its docstrings as it is imported
    raise ImportError("dvae needs Pyro, which needs docstrings: run python without -OO (PYTHONOPTIMIZE=2); -O is fine")

if TYPE_CHECKING:
    from . import laws, motion, networks, tables, views
    from .data import ArrayWindows
    from .graph import Alternatives, Audit, alternatives, audit
    from .inference import schedules
    from .inference.annealing import annealed_bound
    from .inference.bounds import SequenceELBO, Terms, importance_bound
    from .inference.bracket import Bracket, bracket
    from .inference.calibration import calibrate
    from .inference.checks import predictive_checks
    from .inference.compare import compare
    from .inference.comparison import Comparison
    from .inference.conformal import Tubes, conformal
    from .inference.evaluate import evaluate
    from .inference.evaluation import Evaluation
    from .inference.fit import Fit, fit
    from .inference.gradnorm import GradNorm
    from .inference.local import local_guide
    from .inference.objectives import Evidence
    from .inference.particles import particle_bound
    from .inference.posteriors import Descent, Posterior, posterior
    from .inference.stein import stein_discrepancy
    from .inference.svi import SVI
    from .inference.training import Stage, Training
    from .inference.traversal import traverse
    from .inference.yardstick import reference_posterior
    from .inversion import faithful
    from .models.registry import method, methods
    from .notation import Factorization
    from .oracle import Oracle, arrow_prices, model_arrow_prices, model_price, price, twin
    from .program.model import DynamicalVAE
    from .program.rollout import InputNoise, SelfFeeding
    from .program.summed import Discrete
    from .runs.ablation import Ablation, ablate
    from .runs.directory import load

__all__ = [
    "SVI",
    "Ablation",
    "Alternatives",
    "ArrayWindows",
    "Audit",
    "Bracket",
    "Comparison",
    "Descent",
    "Discrete",
    "DynamicalVAE",
    "Evaluation",
    "Evidence",
    "Factorization",
    "Fit",
    "GradNorm",
    "InputNoise",
    "Oracle",
    "Posterior",
    "SelfFeeding",
    "SequenceELBO",
    "Stage",
    "Terms",
    "Training",
    "Tubes",
    "ablate",
    "alternatives",
    "annealed_bound",
    "arrow_prices",
    "audit",
    "bracket",
    "calibrate",
    "compare",
    "conformal",
    "evaluate",
    "faithful",
    "fit",
    "importance_bound",
    "laws",
    "load",
    "local_guide",
    "method",
    "methods",
    "model_arrow_prices",
    "model_price",
    "motion",
    "networks",
    "particle_bound",
    "posterior",
    "predictive_checks",
    "price",
    "reference_posterior",
    "schedules",
    "stein_discrepancy",
    "tables",
    "traverse",
    "twin",
    "views",
]

_PLACES = {
    name: module
    for module, names in {
        "data": "ArrayWindows",
        "graph": "Alternatives Audit alternatives audit",
        "inference": "schedules",
        "inference.annealing": "annealed_bound",
        "inference.bounds": "SequenceELBO Terms importance_bound",
        "inference.bracket": "Bracket bracket",
        "inference.calibration": "calibrate",
        "inference.checks": "predictive_checks",
        "inference.compare": "compare",
        "inference.comparison": "Comparison",
        "inference.conformal": "Tubes conformal",
        "inference.evaluate": "evaluate",
        "inference.evaluation": "Evaluation",
        "inference.fit": "Fit fit",
        "inference.gradnorm": "GradNorm",
        "inference.objectives": "Evidence",
        "inference.local": "local_guide",
        "inference.particles": "particle_bound",
        "inference.posteriors": "Descent Posterior posterior",
        "inference.stein": "stein_discrepancy",
        "inference.svi": "SVI",
        "inference.training": "Stage Training",
        "inference.traversal": "traverse",
        "inference.yardstick": "reference_posterior",
        "models.registry": "method methods",
        "notation": "Factorization",
        "inversion": "faithful",
        "oracle": "Oracle arrow_prices model_arrow_prices model_price price twin",
        "program.model": "DynamicalVAE",
        "program.rollout": "InputNoise SelfFeeding",
        "program.summed": "Discrete",
        "runs.ablation": "Ablation ablate",
        "runs.directory": "load",
    }.items()
    for name in names.split()
}


if not TYPE_CHECKING:  # which knows them all
    __getattr__ = importing(__name__, _PLACES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
