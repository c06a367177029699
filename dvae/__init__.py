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
"""

import sys

__version__ = "0.1.0"

if sys.flags.optimize > 1:  # Pyro fills in its docstrings as it is imported
    raise ImportError("dvae needs Pyro, which needs docstrings: run python without -OO (PYTHONOPTIMIZE=2); -O is fine")

import pyro

# Without it a second model silently receives the first one's parameters from Pyro's global store.
pyro.settings.set(module_local_params=True)

from . import laws, motion, networks, views  # noqa: E402
from .graph import Audit, audit  # noqa: E402
from .inference import schedules  # noqa: E402
from .inference.bounds import SequenceELBO, Terms, importance_bound  # noqa: E402
from .inference.calibration import calibrate  # noqa: E402
from .inference.checks import predictive_checks  # noqa: E402
from .inference.compare import compare  # noqa: E402
from .inference.comparison import Comparison  # noqa: E402
from .inference.evaluate import evaluate  # noqa: E402
from .inference.evaluation import Evaluation  # noqa: E402
from .inference.fit import Fit, fit  # noqa: E402
from .inference.objectives import Evidence  # noqa: E402
from .inference.particles import particle_bound  # noqa: E402
from .inference.svi import SVI  # noqa: E402
from .inference.training import Stage, Training  # noqa: E402
from .inference.traversal import traverse  # noqa: E402
from .models.registry import method, methods  # noqa: E402
from .motion import energies  # noqa: E402
from .notation import Factorization  # noqa: E402
from .oracle import Oracle, price, twin  # noqa: E402
from .program.model import DynamicalVAE  # noqa: E402
from .program.rollout import SelfFeeding  # noqa: E402
from .runs.directory import load  # noqa: E402

__all__ = [
    "SVI",
    "Audit",
    "Comparison",
    "DynamicalVAE",
    "Evaluation",
    "Evidence",
    "Factorization",
    "Fit",
    "Oracle",
    "SelfFeeding",
    "SequenceELBO",
    "Stage",
    "Terms",
    "Training",
    "audit",
    "calibrate",
    "compare",
    "evaluate",
    "fit",
    "importance_bound",
    "laws",
    "load",
    "method",
    "methods",
    "motion",
    "networks",
    "particle_bound",
    "predictive_checks",
    "price",
    "schedules",
    "traverse",
    "twin",
    "views",
]
