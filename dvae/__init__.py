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

Public names and subpackages are imported at first use, because importing torch takes seconds.
"""

import sys
from typing import TYPE_CHECKING

from .lazy import importing

__version__ = "0.1.0"

if sys.flags.optimize > 1:  # Pyro edits its own docstrings at import
    raise ImportError("dvae needs Pyro, which needs docstrings: run python without -OO (PYTHONOPTIMIZE=2); -O is fine")

if TYPE_CHECKING:
    from . import distributions, motion, networks, tables
    from .data import views
    from .data.sequences import ArrayWindows
    from .factorization.graph import Alternatives, Audit, alternatives, audit
    from .factorization.inversion import faithful
    from .factorization.notation import Factorization
    from .inference.bounds.annealing import annealed_bound
    from .inference.bounds.elbo import SequenceELBO, Terms, importance_bound
    from .inference.bounds.local import local_guide
    from .inference.bounds.particles import particle_bound
    from .inference.diagnostics.bracket import Bracket, bracket
    from .inference.diagnostics.calibration import calibrate
    from .inference.diagnostics.checks import predictive_checks
    from .inference.diagnostics.posteriors import Descent, Posterior, posterior
    from .inference.diagnostics.stein import stein_discrepancy
    from .inference.diagnostics.traversal import traverse
    from .inference.diagnostics.yardstick import reference_posterior
    from .inference.evaluation.compare import compare
    from .inference.evaluation.comparison import Comparison
    from .inference.evaluation.conformal import Tubes, conformal
    from .inference.evaluation.evaluate import evaluate
    from .inference.evaluation.evaluation import Evaluation
    from .inference.training import schedules
    from .inference.training.fit import Fit, fit
    from .inference.training.gradnorm import GradNorm
    from .inference.training.objectives import Evidence
    from .inference.training.options import Stage, Training
    from .inference.training.svi import SVI
    from .models.registry import method, methods
    from .program.model import DynamicalVAE
    from .program.oracle import Oracle, arrow_prices, model_arrow_prices, model_price, price, twin
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
    "distributions",
    "evaluate",
    "faithful",
    "fit",
    "importance_bound",
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
        "data": "views",
        "data.sequences": "ArrayWindows",
        "factorization.graph": "Alternatives Audit alternatives audit",
        "factorization.inversion": "faithful",
        "factorization.notation": "Factorization",
        "program.oracle": "Oracle arrow_prices model_arrow_prices model_price price twin",
        "inference.bounds.annealing": "annealed_bound",
        "inference.bounds.elbo": "SequenceELBO Terms importance_bound",
        "inference.bounds.local": "local_guide",
        "inference.bounds.particles": "particle_bound",
        "inference.diagnostics.bracket": "Bracket bracket",
        "inference.diagnostics.calibration": "calibrate",
        "inference.diagnostics.checks": "predictive_checks",
        "inference.diagnostics.posteriors": "Descent Posterior posterior",
        "inference.diagnostics.stein": "stein_discrepancy",
        "inference.diagnostics.traversal": "traverse",
        "inference.diagnostics.yardstick": "reference_posterior",
        "inference.evaluation.compare": "compare",
        "inference.evaluation.comparison": "Comparison",
        "inference.evaluation.conformal": "Tubes conformal",
        "inference.evaluation.evaluate": "evaluate",
        "inference.evaluation.evaluation": "Evaluation",
        "inference.training": "schedules",
        "inference.training.fit": "Fit fit",
        "inference.training.gradnorm": "GradNorm",
        "inference.training.objectives": "Evidence",
        "inference.training.options": "Stage Training",
        "inference.training.svi": "SVI",
        "models.registry": "method methods",
        "program.model": "DynamicalVAE",
        "program.rollout": "InputNoise SelfFeeding",
        "program.summed": "Discrete",
        "runs.ablation": "Ablation ablate",
        "runs.directory": "load",
    }.items()
    for name in names.split()
}


if not TYPE_CHECKING:  # type checkers read the imports above
    __getattr__ = importing(__name__, _PLACES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
