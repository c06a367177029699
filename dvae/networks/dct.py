"""The discrete cosine transform of sequences, truncated to their slow part.

Orthonormal DCT-II, as in Mao, Liu, Salzmann and Li, 2019, arXiv 1908.05436: coefficient k of a sequence of T steps is
sum_t w_k cos(pi (t + 1/2) k / T) v_t, with w_0 = sqrt(1/T) and w_k = sqrt(2/T) else.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy
import torch
from torch import Tensor


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # whoever asks first, others will differentiate through it
def cosine_basis(
    length: int, coefficients: int, dtype: torch.dtype = torch.float64, device: torch.device | None = None
) -> Tensor:
    """The first rows of the orthonormal DCT-II matrix.

    Args:
        length: T.
        coefficients: C, at most T.
        dtype, device: of the matrix, which all who ask for it share.

    Returns:
        (C, T) with orthonormal rows: `basis @ v` are the coefficients of v (T, D), and
        `basis.T @ c` the sequence of coefficients c (C, D).

    Raises:
        ValueError: C is not between 1 and T.
    """
    if not 1 <= coefficients <= length:
        raise ValueError(f"a sequence of {length} steps has 1 to {length} coefficients, not {coefficients}")
    return torch.from_numpy(scipy.fft.idct(np.eye(coefficients, length), axis=1, norm="ortho")).to(device, dtype)
