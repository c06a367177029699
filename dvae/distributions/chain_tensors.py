"""The tensors that the loops of a Gaussian chain read and write, for `chain` and `chain_kernel`."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Weights(NamedTuple):
    """Weights of a step, with biases where the loop adds them: `before` and `after` hold (weight, bias) pairs."""

    before: list[tuple[Tensor, Tensor]]
    recurrent: Tensor | None
    first: Tensor
    after: list[tuple[Tensor, Tensor]]


class Buffers(NamedTuple):
    """Tensors (T, B, ...) that the forward loop writes; `hidden`, `out` and the gates contain the known terms before.

    Those of the LSTM are its inputs [f_t, h_{t-1}] at T + 1 steps, its activated gates, c_t and tanh(c_t).
    """

    features: list[Tensor]
    lstm: tuple[Tensor, Tensor, Tensor, Tensor] | None
    hidden: list[Tensor]
    out: Tensor
    soft: Tensor
    values: Tensor


class Slopes(NamedTuple):
    """Derivatives (T, B, ...) of all activations.

    Those of the LSTM are the factors from the gradient of c_t to those of (i, f, g), from the gradient of h_t to those
    of o and c_t, and from the gradient of c_t to that of c_{t-1}.
    """

    features: list[Tensor]
    lstm: tuple[Tensor, Tensor, Tensor, Tensor] | None
    hidden: list[Tensor]


class Gradients(NamedTuple):
    """Gradients (T, B, ...) of each layer's outputs before its activation, which the backward loop writes.

    Before, `out` contains the gradients from the locations and scales.
    """

    features: list[Tensor]
    gates: Tensor | None
    hidden: list[Tensor]
    out: Tensor
