"""Tests for your own models, with pytest. `strategies` draws random factorizations, with hypothesis."""

from .contract import FactorizationContract
from .regression import ElboRegression

__all__ = ["ElboRegression", "FactorizationContract"]
