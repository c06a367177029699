"""Constants of programs on the device where they are used: brought there once, not at every step."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor


@lru_cache(maxsize=4096)
@torch.inference_mode(False)  # so that gradients may be taken through them, whoever asked first
def _made(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=device)


def constant(values: Any, like: Tensor) -> Tensor:
    """These numbers, nested tuples of them, of the type and on the device of a tensor; not to be written to."""
    return _made(values, like.dtype, like.device)


def indices(values: Any, like: Tensor) -> Tensor:
    """These places along an axis, for `index_select`, on the device of a tensor."""
    return _made(tuple(values), torch.long, like.device)


@lru_cache(maxsize=32)  # of a long series each is large
@torch.inference_mode(False)
def visible(relation: Any, length: int, device: torch.device) -> Tensor:
    """The mask (T, T) of a relation; not to be written to."""
    return torch.as_tensor(relation.mask(length), device=device)
