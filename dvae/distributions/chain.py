"""A Gaussian chain as one autograd function: the loop over z_{t-1} that no guide of a state-space model can avoid.

With everything else hoisted out, a step is

    h_t = act(base_t + z_{t-1} W),  further layers,  (loc_t, raw_t) = h_t V + c
    z_t = loc_t + (softplus(raw_t) + s) e_t

The forward loop writes into preallocated tensors. The backward loop is written by hand: the derivatives of all
activations are taken for all steps at once, each step is then three products and two elementwise operations, and the
gradients of the weights are one product each over all steps together.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

DERIVATIVES = {  # of the activation, in terms of its value
    "tanh": lambda value: torch.addcmul(torch.ones((), dtype=value.dtype, device=value.device), value, value, value=-1),
    "relu": lambda value: (value > 0).to(value.dtype),
}
IN_PLACE = {"tanh": torch.Tensor.tanh_, "relu": torch.Tensor.relu_}


class GaussianChain(torch.autograd.Function):
    """Draws (T, B, D), and their locations and scales, of a Gaussian chain; steps run in the order given.

    Args (of `apply`):
        base: (T, B, H) the first layer's share of what is not drawn, bias included.
        noise: (T, B, D) standard normal.
        min_scale: s.
        activation: "tanh" or "relu".
        weight: (H, D) of z_{t-1}.
        layers: weight (H', H) and bias (H',) of every further layer, the last one without activation: (2 D, H').
    """

    @staticmethod
    def forward(
        ctx: Any,
        base: Tensor,
        noise: Tensor,
        min_scale: float,
        activation: str,
        weight: Tensor,
        *layers: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Run the chain; see the class."""
        steps, batch, size = noise.shape
        weights, biases = layers[::2], layers[1::2]
        act = IN_PLACE[activation]
        hidden = [base.new_empty(steps, batch, w.shape[1]) for w in weights]
        transposed = [w.t() for w in weights]
        inner = list(zip(transposed[:-1], biases[:-1], [h.unbind(0) for h in hidden[1:]], strict=True))
        recurrent, final = weight.t(), transposed[-1]
        # z = (loc + s e) + softplus(raw) e: the least scale enters with the bias, outside the loop
        least = min_scale * noise
        offset = biases[-1] + torch.cat([least, torch.zeros_like(noise)], dim=-1)
        out, values = torch.empty_like(offset), torch.empty_like(noise)
        value = base.new_zeros(batch, size)
        for t, (base_t, first, last, offset_t, out_t, loc, raw, noise_t, new) in enumerate(
            zip(
                base.unbind(0),
                hidden[0].unbind(0),
                hidden[-1].unbind(0),
                offset.unbind(0),
                out.unbind(0),
                out[..., :size].unbind(0),
                out[..., size:].unbind(0),
                noise.unbind(0),
                values.unbind(0),
                strict=True,
            )
        ):
            act(torch.addmm(base_t, value, recurrent, out=first))
            previous = first
            for matrix, bias, cells in inner:
                previous = act(torch.addmm(bias, previous, matrix, out=cells[t]))
            torch.addmm(offset_t, last, final, out=out_t)
            value = torch.addcmul(loc, functional.softplus(raw), noise_t, out=new)
        scales = functional.softplus(out[..., size:]) + min_scale
        ctx.activation = activation
        ctx.save_for_backward(noise, values, out, weight, *weights, *hidden)
        return values, out[..., :size] - least, scales

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of base, weight and layers from those of the draws, locations and scales."""
        noise, values, out, weight, *rest = ctx.saved_tensors
        weights, hidden = rest[: len(rest) // 2], rest[len(rest) // 2 :]
        steps, _, size = noise.shape
        to_value, to_loc, to_scale = gradients
        sigmoid = torch.sigmoid(out[..., size:])
        # (loc, raw) receive  c + M * (g, g)  from the gradient g of the value, here twice side by side
        factor = torch.cat([torch.ones_like(noise), noise * sigmoid], dim=-1)
        offset = torch.cat([to_loc, to_scale * sigmoid], dim=-1)
        twice = torch.cat([to_value, to_value], dim=-1).unbind(0)
        recurrent = torch.cat([weight, weight], dim=1)
        slopes = [DERIVATIVES[ctx.activation](h) for h in hidden]
        to_out = torch.empty_like(out)
        to_hidden = [torch.empty_like(h) for h in hidden]
        back = [
            (w, slope.unbind(0), cells.unbind(0))
            for w, slope, cells in zip(weights[::-1], slopes[::-1], to_hidden[::-1], strict=True)
        ]
        factors, offsets, outs = factor.unbind(0), offset.unbind(0), to_out.unbind(0)
        carried = twice[-1]
        for t in range(steps - 1, -1, -1):
            gradient = torch.addcmul(offsets[t], factors[t], carried, out=outs[t])
            for matrix, slope, cells in back:
                gradient = torch.mm(gradient, matrix, out=cells[t]).mul_(slope[t])
            if t:
                carried = torch.addmm(twice[t - 1], gradient, recurrent)
        before = torch.cat([torch.zeros_like(values[:1]), values[:-1]])
        to_weight = to_hidden[0].flatten(0, 1).t() @ before.flatten(0, 1)
        to_layers: list[Tensor] = []
        for incoming, activations in zip([*to_hidden[1:], to_out], hidden, strict=True):
            to_layers += [incoming.flatten(0, 1).t() @ activations.flatten(0, 1), incoming.sum((0, 1))]
        return to_hidden[0], None, None, None, to_weight, *to_layers
