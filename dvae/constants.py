"""Cached constant tensors, copied to a device once instead of at every step."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor


@lru_cache(maxsize=4096)
@torch.inference_mode(False)  # a constant first requested in inference mode must still work under autograd
def _cached_tensor(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=device)


def constant(values: Any, like: Tensor) -> Tensor:
    """Return a cached tensor of numbers, with the dtype and device of `like`. Do not modify it.

    Args:
        values: a number, or nested tuples of numbers.
        like: any tensor of the wanted dtype, on the wanted device.
    """
    return _cached_tensor(values, like.dtype, like.device)


def indices(values: Any, like: Tensor) -> Tensor:
    """Return a cached tensor of integer indices, for `index_select`, on the device of `like`. Do not modify it."""
    return _cached_tensor(tuple(values), torch.long, like.device)


@lru_cache(maxsize=32)  # small, because the mask of a long series is large
@torch.inference_mode(False)
def visible(relation: Any, length: int, device: torch.device) -> Tensor:
    """Return the cached mask (T, T) of a `Relation`, True at [t, s] if step t reads step s. Do not modify it."""
    return torch.as_tensor(relation.mask(length), device=device)
