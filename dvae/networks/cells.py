"""torch's recurrent networks, with a gradient in evaluation mode on a GPU too.

cuDNN keeps what the gradient is made of in training alone, which without dropout, as here, means nothing else; latents
are sampled, and control and completion descend, in evaluation.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from typing_extensions import override


class _Differentiable(nn.RNNBase):
    @override
    def forward(self, *args: Any) -> Any:
        mode, self.training = self.training, torch.is_grad_enabled()
        try:
            return super().forward(*args)
        finally:
            self.training = mode


class GRU(_Differentiable, nn.GRU):
    """`torch.nn.GRU`, of no dropout."""


class LSTM(_Differentiable, nn.LSTM):
    """`torch.nn.LSTM`, of no dropout."""


class RNN(_Differentiable, nn.RNN):
    """`torch.nn.RNN`, of no dropout."""
