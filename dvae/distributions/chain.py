"""A Gaussian chain as one autograd function: the sequential loop over z_{t-1} in the guide of a state-space model.

All terms that do not depend on z_{t-1} are computed before the loop. A step of the loop is

    f_t = features of z_{t-1}, 0 at the first step                        layers `before`; z_{t-1} itself without them
    h_t, c_t = LSTM([f_t, h_{t-1}], c_{t-1})                              if there is a cell; otherwise h_t = f_t
    (loc_t, raw_t) = further layers of (base_t + h_t V)
    z_t = loc_t + (softplus(raw_t) + s) e_t

The forward loop writes to preallocated tensors. The backward loop is written by hand. It computes the derivatives of
all activations at all steps at once, so each step needs only its products and a few elementwise operations. The
gradient of each weight is one product over all steps.

On a GPU, `chain_kernel` can run each of the two loops as one Triton kernel; `KERNEL` selects it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .chain_tensors import Buffers, Gradients, Slopes, Weights

DERIVATIVES = {  # derivative of each activation as a function of its output
    "tanh": lambda value: torch.addcmul(torch.ones((), dtype=value.dtype, device=value.device), value, value, value=-1),
    "relu": lambda value: (value > 0).to(value.dtype),
}
IN_PLACE = {"tanh": torch.Tensor.tanh_, "relu": torch.Tensor.relu_}
KERNEL: str | None = None
"""Device type on which Triton kernels run the loops: "cuda", or None for no kernels.

They are off by default, because they were only tested with Triton's interpreter. Chains that they do not support, and
all chains without Triton, run the loops of torch's operations.
"""


def gaussian_chain(
    base: Tensor,
    noise: Tensor,
    layers: Sequence[tuple[Tensor, Tensor | None]],
    *,
    before: Sequence[tuple[Tensor, Tensor]] = (),
    cell: tuple[Tensor, Tensor] | None = None,
    min_scale: float = 0.0,
    activation: str = "tanh",
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Draw from a Gaussian chain.

    Args:
        base: contribution (T, B, H) of the known inputs to the first of `layers`, including the bias of this layer.
        noise: standard normal noise e (T, B, D).
        layers: weight (out, in) and bias (out,) of each layer from h_t to (loc, raw), with the activation between two
            layers. The bias of the first layer is ignored, because it is part of `base`.
        before: weight and bias of each layer from z_{t-1} to f_t; the activation follows each of them.
        cell: parameters of the LSTM, or None without an LSTM. The first item is the contribution (T, B, 4 W) of the
            known inputs to the gates in torch's order, biases included. The second item is the weight (4 W, F + W) of
            [f_t, h_{t-1}].
        min_scale: s, lower bound of the scale.
        activation: "tanh" or "relu".

    Returns:
        Draws z, locations and scales, (T, B, D) each, and the states h (T, B, W) of the LSTM or None.
    """
    gates, recurrent = cell or (None, None)
    (first, _), *rest = layers
    tensors = [tensor for layer in (*before, *rest) for tensor in layer]
    return GaussianChain.apply(noise, base, gates, min_scale, activation, len(before), recurrent, first, *tensors)


class GaussianChain(torch.autograd.Function):
    """The autograd function behind `gaussian_chain`."""

    @staticmethod
    def forward(
        ctx: Any,
        noise: Tensor,
        base: Tensor,
        gates: Tensor | None,
        min_scale: float,
        activation: str,
        count: int,
        recurrent: Tensor | None,
        first: Tensor,
        *tensors: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return draws, locations, scales and states, as `gaussian_chain` does."""
        steps, batch, size = noise.shape
        before, after = _layers(tensors[: 2 * count]), _layers(tensors[2 * count :])

        def empty(width: int) -> Tensor:
            return base.new_empty(steps, batch, width)

        # z = (loc + s e) + softplus(raw) e: the minimum scale s is added with the bias, outside the loop
        min_noise = min_scale * noise
        # Each step adds its products in place to the terms known before the loop. `addmm` with `out` copies these terms
        # at every step, which takes as long as the product.
        out = torch.cat([min_noise, torch.zeros_like(noise)], dim=-1) + (after[-1][1] if after else base)
        known = [base, *(bias.expand(steps, batch, -1) for _, bias in after)][: len(after)]
        hidden = [terms.clone(memory_format=torch.contiguous_format) for terms in known]
        features = [empty(weight.shape[0]) for weight, _ in before]
        lstm, states = None, None
        if gates is not None and recurrent is not None:
            width = gates.shape[-1] // 4
            entering = recurrent.shape[1] - width
            inputs = base.new_zeros(steps + 1, batch, entering + width)
            if features:
                features[-1] = inputs[:steps, :, :entering]
            lstm = inputs, gates.clone(memory_format=torch.contiguous_format), empty(width), empty(width)
            states = inputs[1:, :, entering:]
        for feature in features:
            feature[0] = 0
        weights = Weights(before, recurrent, first, after)
        buffers = Buffers(features, lstm, hidden, out, torch.empty_like(out), empty(size))
        ctx.kernel = _kernel(noise, base, gates, weights)
        loop = ctx.kernel.run_forward if ctx.kernel else _forward
        loop(noise, weights, buffers, activation)
        ctx.activation, ctx.count = activation, count
        ctx.lists = (len(features), len(hidden))
        soft, values = buffers.soft, buffers.values
        saved = *(lstm or (None,) * 4), *tensors, *features, *hidden
        ctx.save_for_backward(noise, values, out, recurrent, first, *saved)
        return values, out[..., :size] - min_noise, soft[..., size:] + min_scale, states

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of base, gates, weights and biases, given the gradients of the results of `forward`."""
        noise, values, out, recurrent, first, inputs, activated, cells, squashed, *rest = ctx.saved_tensors
        n_features, n_hidden = ctx.lists
        count = ctx.count
        tensors = rest[: len(rest) - n_features - n_hidden]
        features = rest[len(tensors) : len(tensors) + n_features]
        hidden = rest[len(tensors) + n_features :]
        weights = Weights(_layers(tensors[: 2 * count]), recurrent, first, _layers(tensors[2 * count :]))
        steps, _, size = noise.shape
        to_value, to_loc, to_scale, to_states = gradients
        slope_of = DERIVATIVES[ctx.activation]

        sigmoid = torch.sigmoid(out[..., size:])
        # the gradient of (loc, raw) is c + M * (g, g), where g is the gradient of the value
        factors = torch.cat([torch.ones_like(noise), noise * sigmoid], dim=-1)
        lstm_slopes = None
        if inputs is not None:
            width = cells.shape[-1]
            i, f, g, o = activated.split(width, dim=-1)
            previous = torch.cat([torch.zeros_like(cells[:1]), cells[:-1]])
            by_cell = torch.stack([g * i * (1 - i), previous * f * (1 - f), i * (1 - g * g)], dim=-2)
            lstm_slopes = by_cell, squashed * o * (1 - o), o * (1 - squashed * squashed), f
        slopes = Slopes([slope_of(f) for f in features], lstm_slopes, [slope_of(h) for h in hidden])
        to = Gradients(
            [f.new_zeros(f.shape) for f in features],
            None if inputs is None else torch.empty_like(activated),
            [torch.empty_like(h) for h in hidden],
            torch.cat([to_loc, to_scale * sigmoid], dim=-1),
        )
        loop = ctx.kernel.run_backward if ctx.kernel else _backward
        loop(factors, to_value, to_states, weights, slopes, to)

        earlier = torch.cat([torch.zeros_like(values[:1]), values[:-1]])
        to_layers = [*to.hidden, to.out]  # gradient of each layer's output
        to_recurrent = None
        if to.gates is None:
            to_first = _product(to_layers[0], features[-1] if features else earlier)
        else:
            to_first = _product(to_layers[0], inputs[1:, :, -width:])
            to_recurrent = _product(to.gates, inputs[:steps])
        to_tensors: list[Tensor] = []
        for grad, entered in zip(to.features, [earlier, *features], strict=False):
            to_tensors += [_product(grad[1:], entered[1:]), grad[1:].sum((0, 1))]
        for grad, entered in zip(to_layers[1:], hidden, strict=True):
            to_tensors += [_product(grad, entered), grad.sum((0, 1))]
        return None, to_layers[0], to.gates, None, None, None, to_recurrent, to_first, *to_tensors


def _kernel(noise: Tensor, base: Tensor, gates: Tensor | None, weights: Weights) -> Any:
    """Return the module `chain_kernel` if it can run the loops of these tensors, otherwise None."""
    if noise.device.type != KERNEL:
        return None
    try:
        from . import chain_kernel
    except ImportError:  # Triton comes with torch's builds for CUDA only
        return None
    return chain_kernel if chain_kernel.supports(noise, base, gates, weights) else None


def _forward(noise: Tensor, weights: Weights, buffers: Buffers, activation: str) -> None:
    """Run the forward loop with torch's operations, and write to `buffers`.

    (Over 60 lines, because the tensors of the loop are too many to pass between functions.)
    """
    before, recurrent, first, after = weights
    features, lstm, hidden, out, soft, values = buffers
    steps, batch, size = noise.shape
    act = IN_PLACE[activation]
    zero = out.new_zeros(())
    if lstm is not None and recurrent is not None:
        inputs, activated, cells, squashed = lstm
        width = cells.shape[-1]
        entering = inputs.shape[-1] - width
        cell_steps = list(
            zip(
                inputs[:steps].unbind(0),
                inputs[:steps, :, :entering].unbind(0),
                inputs[1:, :, entering:].unbind(0),
                activated.unbind(0),
                activated[..., : 2 * width].unbind(0),
                *(part.unbind(0) for part in activated.split(width, dim=-1)),
                cells.unbind(0),
                squashed.unbind(0),
                strict=True,
            )
        )
        product, carried_cell = recurrent.t(), cells.new_zeros(batch, width)
    pre = [(weight.t(), bias, f.unbind(0)) for (weight, bias), f in zip(before, features, strict=True)]
    matrices = [first.t(), *(weight.t() for weight, _ in after)]
    post = [h.unbind(0) for h in hidden]
    last = list(
        zip(
            out.unbind(0),
            out[..., :size].unbind(0),
            soft.unbind(0),
            soft[..., size:].unbind(0),
            noise.unbind(0),
            values.unbind(0),
            strict=True,
        )
    )
    value = out.new_zeros(batch, size)
    for t in range(steps):
        state = value
        if t:
            for matrix, bias, target in pre:
                state = act(torch.addmm(bias, state, matrix, out=target[t]))
        elif pre:
            state = pre[-1][2][0]
        if lstm is not None:
            entry, slot, new, gate, two, i, f, g, o, c, s = cell_steps[t]
            if not pre and t:
                slot.copy_(state)
            gate.addmm_(entry, product)
            two.sigmoid_()
            g.tanh_()
            o.sigmoid_()
            carried_cell = torch.mul(f, carried_cell, out=c).addcmul_(i, g)
            state = torch.mul(o, torch.tanh(c, out=s), out=new)
        for layer, matrix in zip(post, matrices, strict=False):
            state = act(layer[t].addmm_(state, matrix))
        into, loc, both, scale, e, new_value = last[t]
        # softplus of both halves in one call, since on a slice it is not vectorised and takes three times as long
        torch.logaddexp(into.addmm_(state, matrices[-1]), zero, out=both)
        value = torch.addcmul(loc, scale, e, out=new_value)


def _backward(
    factors: Tensor,
    to_value: Tensor,
    to_states: Tensor | None,
    weights: Weights,
    slopes: Slopes,
    to: Gradients,
) -> None:
    """Run the backward loop with torch's operations, and write to `to`."""
    before, recurrent, first, after = weights
    size = to_value.shape[-1]
    # the gradient of the value is stored twice, for (g, g)
    twice = torch.cat([to_value, to_value], dim=-1).unbind(0)
    factors_at, outs = factors.unbind(0), to.out.unbind(0)
    # layers after h_t in reverse: weight, slope of the layer's input, gradient of that input
    back = [
        (weight, slope.unbind(0), grad.unbind(0))
        for (weight, _), slope, grad in zip(after[::-1], slopes.hidden[::-1], to.hidden[::-1], strict=True)
    ]
    pre: list[Any] = [
        (following, slope.unbind(0), grad.unbind(0))
        for following, slope, grad in zip(
            [*(weight for weight, _ in before), None][1:], slopes.features, to.features, strict=True
        )
    ][::-1]
    # the weight of z_{t-1}, stored twice to match (g, g)
    entry = before[0][0] if before else first if recurrent is None else recurrent[:, :size]
    entry = torch.cat([entry, entry], dim=1)
    if slopes.lstm is not None and recurrent is not None and to.gates is not None and to_states is not None:
        width = to_states.shape[-1]
        entering = recurrent.shape[1] - width
        by_cell, by_output, cell_by_state, forget = (slope.unbind(0) for slope in slopes.lstm)
        three = to.gates[..., : 3 * width].unflatten(-1, (3, width)).unbind(0)
        fourth, all_gates = to.gates[..., 3 * width :].unbind(0), to.gates.unbind(0)
        state_gradients = to_states.unbind(0)
        into_cell = into_state = to.out.new_zeros(to_states.shape[1:])
    carried = twice[-1]
    for t in range(len(twice) - 1, -1, -1):
        gradient = outs[t].addcmul_(factors_at[t], carried)
        for matrix, slope, target in back:
            gradient = torch.mm(gradient, matrix, out=target[t]).mul_(slope[t])
        if recurrent is not None:
            to_state = torch.add(state_gradients[t], into_state).addmm_(gradient, first)
            into_cell = torch.addcmul(into_cell, to_state, cell_by_state[t])
            torch.mul(by_cell[t], into_cell.unsqueeze(1), out=three[t])
            torch.mul(by_output[t], to_state, out=fourth[t])
            if not t:
                break
            into_cell = into_cell * forget[t]
            if pre:
                to_inputs = torch.mm(all_gates[t], recurrent)
                into_state = to_inputs[:, entering:]
                gradient = torch.mul(to_inputs[:, :entering], pre[0][1][t], out=pre[0][2][t])
            else:
                gradient = all_gates[t]
                into_state = torch.mm(gradient, recurrent[:, entering:])
        elif not t:
            break
        elif pre:
            gradient = torch.mm(gradient, first, out=pre[0][2][t]).mul_(pre[0][1][t])
        for matrix, slope, target in pre[1:]:
            gradient = torch.mm(gradient, matrix, out=target[t]).mul_(slope[t])
        carried = twice[t - 1].addmm_(gradient, entry)


def _layers(tensors: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
    return list(zip(tensors[::2], tensors[1::2], strict=True))


def _product(gradient: Tensor, entered: Tensor) -> Tensor:
    """Return the gradient of a layer's weight, (H, F).

    Args:
        gradient: gradient of the layer's outputs, (T, B, H).
        entered: inputs of the layer, (T, B, F).
    """
    return gradient.flatten(0, 1).t() @ entered.flatten(0, 1)
