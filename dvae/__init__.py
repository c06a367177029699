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

__version__ = "0.2.0"

if sys.flags.optimize > 1:  # Pyro edits its own docstrings at import
    raise ImportError("dvae needs Pyro, which needs docstrings: run python without -OO (PYTHONOPTIMIZE=2); -O is fine")

if TYPE_CHECKING:
    from . import distributions, motion, networks, tables
    from .data import views
    from .data.sequences import ArrayWindows
    from .factorization.graph import Alternatives, Audit, alternatives, audit
    from .factorization.inversion import faithful_inverse
    from .factorization.notation import Factorization
    from .inference.bounds.annealing import annealed_bound
    from .inference.bounds.elbo import SequenceELBO, Terms, iwae_bound
    from .inference.bounds.particles import fivo_bound
    from .inference.bounds.semi_amortized import semi_amortized_guide
    from .inference.diagnostics.bracket import Bracket, bracket
    from .inference.diagnostics.calibration import calibrate
    from .inference.diagnostics.checks import predictive_checks
    from .inference.diagnostics.posteriors import Descent, Posterior, posterior
    from .inference.diagnostics.reference_posterior import reference_posterior
    from .inference.diagnostics.stein import stein_discrepancy
    from .inference.diagnostics.traversal import traverse
    from .inference.diagnostics.weight_posterior import weight_posterior
    from .inference.evaluation.compare import compare
    from .inference.evaluation.comparison import Comparison
    from .inference.evaluation.conformal import PredictionBands, conformal_bands
    from .inference.evaluation.ensemble import Ensemble
    from .inference.evaluation.evaluate import evaluate
    from .inference.evaluation.evaluation import Evaluation
    from .inference.training import schedules
    from .inference.training.checkpoints import load_weights
    from .inference.training.fit import Fit, fit
    from .inference.training.gradnorm import GradNorm
    from .inference.training.objectives import Evidence
    from .inference.training.options import Stage, Training
    from .inference.training.svi import SVI
    from .models.registry import method, methods
    from .program.enumeration import Discrete
    from .program.model import DynamicalVAE
    from .program.oracle import Oracle, edge_costs, kl_gap, linear_gaussian_surrogate, model_edge_costs, model_kl_gap
    from .program.rollout import InputNoise, ScheduledSampling
    from .runs.ablation import Ablation, ablate
    from .runs.backtest import Backtest, backtest
    from .runs.directory import load

__all__ = [
    "SVI",
    "Ablation",
    "Alternatives",
    "ArrayWindows",
    "Audit",
    "Backtest",
    "Bracket",
    "Comparison",
    "Descent",
    "Discrete",
    "DynamicalVAE",
    "Ensemble",
    "Evaluation",
    "Evidence",
    "Factorization",
    "Fit",
    "GradNorm",
    "InputNoise",
    "Oracle",
    "Posterior",
    "PredictionBands",
    "ScheduledSampling",
    "SequenceELBO",
    "Stage",
    "Terms",
    "Training",
    "ablate",
    "alternatives",
    "annealed_bound",
    "audit",
    "backtest",
    "bracket",
    "calibrate",
    "compare",
    "conformal_bands",
    "distributions",
    "edge_costs",
    "evaluate",
    "faithful_inverse",
    "fit",
    "fivo_bound",
    "iwae_bound",
    "kl_gap",
    "linear_gaussian_surrogate",
    "load",
    "load_weights",
    "method",
    "methods",
    "model_edge_costs",
    "model_kl_gap",
    "motion",
    "networks",
    "posterior",
    "predictive_checks",
    "reference_posterior",
    "schedules",
    "semi_amortized_guide",
    "stein_discrepancy",
    "tables",
    "traverse",
    "views",
    "weight_posterior",
]

_MODULES = {
    name: module
    for module, names in {
        "data": "views",
        "data.sequences": "ArrayWindows",
        "factorization.graph": "Alternatives Audit alternatives audit",
        "factorization.inversion": "faithful_inverse",
        "factorization.notation": "Factorization",
        "program.oracle": "Oracle edge_costs model_edge_costs model_kl_gap kl_gap linear_gaussian_surrogate",
        "inference.bounds.annealing": "annealed_bound",
        "inference.bounds.elbo": "SequenceELBO Terms iwae_bound",
        "inference.bounds.semi_amortized": "semi_amortized_guide",
        "inference.bounds.particles": "fivo_bound",
        "inference.diagnostics.bracket": "Bracket bracket",
        "inference.diagnostics.calibration": "calibrate",
        "inference.diagnostics.checks": "predictive_checks",
        "inference.diagnostics.posteriors": "Descent Posterior posterior",
        "inference.diagnostics.stein": "stein_discrepancy",
        "inference.diagnostics.traversal": "traverse",
        "inference.diagnostics.weight_posterior": "weight_posterior",
        "inference.diagnostics.reference_posterior": "reference_posterior",
        "inference.evaluation.compare": "compare",
        "inference.evaluation.comparison": "Comparison",
        "inference.evaluation.conformal": "PredictionBands conformal_bands",
        "inference.evaluation.ensemble": "Ensemble",
        "inference.evaluation.evaluate": "evaluate",
        "inference.evaluation.evaluation": "Evaluation",
        "inference.training": "schedules",
        "inference.training.fit": "Fit fit",
        "inference.training.gradnorm": "GradNorm",
        "inference.training.objectives": "Evidence",
        "inference.training.checkpoints": "load_weights",
        "inference.training.options": "Stage Training",
        "inference.training.svi": "SVI",
        "models.registry": "method methods",
        "program.model": "DynamicalVAE",
        "program.rollout": "InputNoise ScheduledSampling",
        "program.enumeration": "Discrete",
        "runs.ablation": "Ablation ablate",
        "runs.backtest": "Backtest backtest",
        "runs.directory": "load",
    }.items()
    for name in names.split()
}


if not TYPE_CHECKING:  # type checkers read the imports above
    __getattr__ = importing(__name__, _MODULES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
