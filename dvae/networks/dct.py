"""The discrete cosine transform of sequences, truncated to their slow part.

Orthonormal DCT-II, as in Mao, Liu, Salzmann and Li, 2019, arXiv 1908.05436: coefficient k of a sequence of T steps is
sum_t w_k cos(pi (t + 1/2) k / T) v_t, with w_0 = sqrt(1/T) and w_k = sqrt(2/T) else.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.fft import idct
from torch import Tensor


def cosine_basis(length: int, coefficients: int) -> Tensor:
    """The first rows of the orthonormal DCT-II matrix.

    Args:
        length: T.
        coefficients: C, at most T.

    Returns:
        (C, T) in double precision, with orthonormal rows: `basis @ v` are the coefficients of v (T, D), and
        `basis.T @ c` the sequence of coefficients c (C, D).

    Raises:
        ValueError: C is not between 1 and T.
    """
    if not 1 <= coefficients <= length:
        raise ValueError(f"a sequence of {length} steps has 1 to {length} coefficients, not {coefficients}")
    return torch.from_numpy(idct(np.eye(coefficients, length), axis=1, norm="ortho"))
