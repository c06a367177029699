"""Programs: validated batches, the factors of two factorizations, and the Pyro model and guide built from them."""

from typing import TYPE_CHECKING

import pyro

from ..lazy import importing

# Without it a second model silently receives the first one's parameters from Pyro's global store.
pyro.settings.set(module_local_params=True)

if not TYPE_CHECKING:
    __getattr__ = importing(__name__)
