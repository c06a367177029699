"""Tests for models of one's own; needs pytest. `strategies` draws random factorizations, with hypothesis."""

from .contract import FactorizationContract
from .regression import ElboRegression

__all__ = ["ElboRegression", "FactorizationContract"]
