"""Pytest test cases for your own models, and random factorizations for hypothesis (`strategies`)."""

from .contract import FactorizationContract
from .regression import ElboRegression

__all__ = ["ElboRegression", "FactorizationContract"]
