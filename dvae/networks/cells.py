"""torch's recurrent networks, with a gradient in evaluation mode on a GPU too.

cuDNN keeps what the gradient is made of in training alone, and latents are sampled, and control and completion descend,
in evaluation. The mode changes nothing else where there is no dropout, which is refused.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from typing_extensions import override


class _Differentiable(nn.RNNBase):
    """In training, for cuDNN, wherever gradients are recorded."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        if self.dropout:
            raise ValueError(f"dropout is {self.dropout}; a recurrent network here has none, as evaluation would, too")

    @override
    def forward(self, *args: Any) -> Any:
        mode, self.training = self.training, torch.is_grad_enabled()
        try:
            return super().forward(*args)
        finally:
            self.training = mode


class GRU(_Differentiable, nn.GRU):
    """`torch.nn.GRU`, without dropout."""


class LSTM(_Differentiable, nn.LSTM):
    """`torch.nn.LSTM`, without dropout."""


class RNN(_Differentiable, nn.RNN):
    """`torch.nn.RNN`, without dropout."""
