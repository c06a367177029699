"""Recurrent networks of torch that support gradients in evaluation mode, also on a GPU.

cuDNN stores what the backward pass needs only in training mode. Some gradients are computed in evaluation mode, such as
those for sampling latents, for control and for completion. These classes therefore use training mode whenever gradients
are recorded. They reject dropout; without dropout, the mode has no other effect.

On some processors, oneDNN has no LSTM in half precision. There, an LSTM under autocast runs in float32.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from torch import nn
from typing_extensions import override


class _Differentiable(nn.RNNBase):
    """A recurrent network that is in training mode whenever gradients are recorded, as cuDNN requires."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        if self.dropout:
            raise ValueError(f"dropout must be 0, got {self.dropout}: this network would apply it in evaluation, too")

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
    """`torch.nn.LSTM` without dropout, in float32 if the processor does not support the precision of autocast."""

    @override
    def forward(self, *args: Any) -> Any:
        weight = next(self.parameters())
        on_cpu = weight.device.type == "cpu" and torch.is_autocast_enabled("cpu")
        if not on_cpu or _runs_lstm(torch.get_autocast_dtype("cpu"), torch.is_grad_enabled()):
            return super().forward(*args)
        entries, states = (*args, None)[:2]
        with torch.autocast("cpu", enabled=False):
            states = states and tuple(state.to(weight.dtype) for state in states)
            return super().forward(entries.to(weight.dtype), states)


class RNN(_Differentiable, nn.RNN):
    """`torch.nn.RNN`, without dropout."""


@cache
def _runs_lstm(precision: torch.dtype, training: bool) -> bool:
    """Return whether this processor can run an LSTM in a precision; the test on a single entry runs once."""
    with torch.inference_mode(False), torch.set_grad_enabled(training), torch.autocast("cpu", precision):
        entry, weight, bias = (torch.zeros(shape, requires_grad=training) for shape in ((1, 1, 1), (4, 1), (4,)))
        try:
            outputs = torch.lstm(
                entry, (entry, entry), [weight, weight, bias, bias], True, 1, 0.0, training, False, True
            )
            if training:
                outputs[0].sum().backward()
        except RuntimeError:
            return False
    return True
