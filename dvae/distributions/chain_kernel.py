"""The loops of a Gaussian chain as one Triton kernel each, for a GPU.

`distributions.chain` describes a step, allocates all tensors and computes the gradients of the weights. A program of a
kernel runs all steps of a block of sequences. It loads each weight once, before its loop, and the compiler keeps the
weights in shared memory. Sizes are padded with zeros to powers of two. Products are in float32, not in TF32.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from .chain_tensors import Buffers, Gradients, Slopes, Weights

ROWS = 16
"""Sequences of a program: the fewest rows of `tl.dot`, since the batches of the family fill few programs."""


def supports(noise: Tensor, base: Tensor, gates: Tensor | None, weights: Weights) -> bool:
    """Return whether the kernels can run a chain.

    All tensors must be of type float32, with at most one layer between h_t and (loc, raw), and offsets of elements must
    fit into 32 bits. Shared memory must hold the padded weights and two tiles of activations. From 256 columns on, the
    operands of a product overflow the registers.
    """
    before, recurrent, first, after = weights
    steps, batch, size = noise.shape
    pairs = [tensor for layer in (*before, *after) for tensor in layer]
    tensors = [tensor for tensor in (noise, base, gates, recurrent, first, *pairs) if tensor is not None]
    last, width = after[0][0] if after else first, first.shape[1]
    shapes = [*(weight.shape for weight, _ in before), *[(size, last.shape[1])] * 2]
    if after:
        shapes.append(first.shape)
    if recurrent is not None:
        shapes += [(width, recurrent.shape[1] - width), (width, width)] * 4
    tiles = [(padded(rows), padded(columns)) for rows, columns in shapes]
    widest = max(map(max, tiles))
    limit = 232448  # of an H100; the interpreter has none
    if noise.is_cuda:
        limit = triton.runtime.driver.active.utils.get_device_properties(noise.device.index)["max_shared_mem"]
    return (
        all(tensor.dtype == torch.float32 for tensor in tensors)
        and len(after) <= 1
        and batch > 0
        and (steps + 1) * batch * 4 * widest < 2**31
        and widest <= 128
        and 4 * (sum(rows * columns for rows, columns in tiles) + 2 * ROWS * widest) <= limit
    )


def run_forward(noise: Tensor, weights: Weights, buffers: Buffers, activation: str) -> None:
    """Run the forward loop, and write to `buffers`."""
    features, lstm, hidden, *results = buffers
    stored = tuple(features[:-1] if lstm else features)  # an LSTM's inputs contain the last ones
    written = stored, *(lstm or (None,) * 4), tuple(hidden), *results
    _launch(_forward, noise, weights, [noise], written, RELU=activation == "relu")


def run_backward(
    factors: Tensor,
    to_value: Tensor,
    to_states: Tensor | None,
    weights: Weights,
    slopes: Slopes,
    to: Gradients,
) -> None:
    """Run the backward loop, and write to `to`."""
    lstm = slopes.lstm or (None,) * 4
    read = [factors, to_value, *lstm, to_states, slopes.features, slopes.hidden]
    _launch(_backward, to_value, weights, read, (tuple(to.features), to.gates, tuple(to.hidden), to.out))


def _launch(
    kernel: Any, values: Tensor, weights: Weights, read: list[Any], written: tuple[Any, ...], **options: bool
) -> None:
    """Run a kernel for `values` of shape (T, B, D)."""
    steps, batch, size = values.shape
    before, recurrent, first, after = weights
    last = after[0][0] if after else first
    sizes = size, *(weight.shape[0] for weight, _ in before)
    with torch.cuda.device_of(values):
        kernel[(triton.cdiv(batch, ROWS),)](
            _contiguous([before, recurrent, first, last]),
            _contiguous(read),
            written,
            steps,
            batch,
            SIZES=sizes,
            W=first.shape[1],
            H=last.shape[1],
            ROWS=ROWS,
            num_warps=8,
            num_stages=1,  # more stages copy inputs of later steps to shared memory, 30 KiB each for a VRNN
            **options,
        )


def _contiguous(item: Any) -> Any:
    """Return nested tuples of contiguous tensors."""
    if isinstance(item, Tensor):
        return item.contiguous()
    return None if item is None else tuple(map(_contiguous, item))


@triton.constexpr_function
def padded(size: int) -> int:
    """Return the size of a tile's side."""
    return max(16, triton.next_power_of_2(size))


@triton.jit
def _load(pointer: tl.tensor, rows: tl.tensor, valid: tl.tensor, SIZE: tl.constexpr, stride: tl.tensor) -> tl.tensor:
    """Load SIZE columns of each valid row, padded with zeros."""
    columns = tl.arange(0, padded(SIZE))
    return tl.load(pointer + rows[:, None] * stride + columns, mask=valid[:, None] & (columns < SIZE), other=0.0)


@triton.jit
def _store(
    pointer: tl.tensor, rows: tl.tensor, valid: tl.tensor, SIZE: tl.constexpr, stride: tl.tensor, value: tl.tensor
) -> None:
    """Store the first SIZE columns of each valid row."""
    columns = tl.arange(0, padded(SIZE))
    tl.store(pointer + rows[:, None] * stride + columns, value, mask=valid[:, None] & (columns < SIZE))


@triton.jit
def _matrix(
    pointer: tl.tensor, OUT: tl.constexpr, IN: tl.constexpr, stride: tl.tensor, TRANSPOSED: tl.constexpr
) -> tl.tensor:
    """Load a weight (OUT, IN) or its transpose, padded with zeros."""
    rows, columns = tl.arange(0, padded(OUT)), tl.arange(0, padded(IN))
    if TRANSPOSED:
        places, mask = rows * stride + columns[:, None], (rows < OUT) & (columns < IN)[:, None]
    else:
        places, mask = rows[:, None] * stride + columns, (rows < OUT)[:, None] & (columns < IN)
    return tl.load(pointer + places, mask=mask, other=0.0)


@triton.jit
def _weights(
    before: tl.tuple,
    recurrent: tl.tensor,
    last: tl.tensor,
    SIZES: tl.constexpr,
    W: tl.constexpr,
    H: tl.constexpr,
    TRANSPOSED: tl.constexpr,
) -> tl.tuple:
    """Load the weights of `before`, of the gates on f_t and on h_{t-1}, and of (loc, raw)."""
    matrices: tl.tuple = ()
    entering: tl.tuple = ()
    carried: tl.tuple = ()
    for i in tl.static_range(len(before)):
        matrices += (_matrix(before[i][0], SIZES[i + 1], SIZES[i], SIZES[i], TRANSPOSED),)
    if recurrent is not None:
        F: tl.constexpr = SIZES[len(before)]
        for k in tl.static_range(4):
            gate = recurrent + k * W * (F + W)
            entering += (_matrix(gate, W, F, F + W, TRANSPOSED),)
            carried += (_matrix(gate + F, W, W, F + W, TRANSPOSED),)
    D: tl.constexpr = SIZES[0]
    return matrices, entering, carried, _matrix(last, D, H, H, TRANSPOSED), _matrix(last + D * H, D, H, H, TRANSPOSED)


@triton.jit
def _product(value: tl.tensor, matrix: tl.tensor) -> tl.tensor:
    return tl.dot(value, matrix, input_precision="ieee")


@triton.jit
def _sigmoid(value: tl.tensor) -> tl.tensor:
    return 1 / (1 + tl.exp(-value))


@triton.jit
def _tanh(value: tl.tensor) -> tl.tensor:
    return 2 * _sigmoid(2 * value) - 1


@triton.jit
def _softplus(value: tl.tensor) -> tl.tensor:
    small = tl.exp(-tl.abs(value))
    one = 1 + small  # log(1 + small) without cancellation
    return tl.maximum(value, 0.0) + tl.where(one == 1, small, tl.log(one) * small / (one - 1))


@triton.jit
def _activate(value: tl.tensor, RELU: tl.constexpr) -> tl.tensor:
    return tl.where(value < 0, 0.0, value) if RELU else _tanh(value)  # unlike maximum, it keeps NaN


@triton.jit(do_not_specialize=["steps", "batch"])
def _forward(
    weights: tl.tuple,
    read: tl.tuple,
    written: tl.tuple,
    steps: tl.tensor,
    batch: tl.tensor,
    SIZES: tl.constexpr,
    W: tl.constexpr,
    H: tl.constexpr,
    ROWS: tl.constexpr,
    RELU: tl.constexpr,
) -> None:
    before, recurrent, first, last = weights
    noise = read[0]
    features, inputs, activated, cells, squashed, hidden, out, soft, values = written
    D: tl.constexpr = SIZES[0]
    F: tl.constexpr = SIZES[len(before)]
    matrices, entering, carried, to_loc, to_raw = _weights(before, recurrent, last, SIZES, W, H, True)
    if len(hidden) > 0:
        to_hidden = _matrix(first, H, W, W, True)
    biases: tl.tuple = ()
    for i in tl.static_range(len(before)):
        one = tl.arange(0, 1)
        biases += (_load(before[i][1], one, one == 0, SIZES[i + 1], 0),)
    block = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    valid = block < batch
    value = tl.full((ROWS, padded(D)), 0.0, tl.float32)
    output = tl.full((ROWS, padded(W)), 0.0, tl.float32)
    cell = tl.full((ROWS, padded(W)), 0.0, tl.float32)
    for t in range(steps):
        rows = t * batch + block
        state = value
        for i in tl.static_range(len(before)):
            state = tl.where(t > 0, _activate(_product(state, matrices[i]) + biases[i], RELU), 0.0)
            if i < len(features):
                _store(features[i], rows, valid, SIZES[i + 1], SIZES[i + 1], state)
        if recurrent is not None:
            _store(inputs, rows, valid, F, F + W, state)
            activations: tl.tuple = ()
            for k in tl.static_range(4):
                gate = _load(activated + k * W, rows, valid, W, 4 * W)
                gate += _product(state, entering[k]) + _product(output, carried[k])
                gate = _tanh(gate) if k == 2 else _sigmoid(gate)
                _store(activated + k * W, rows, valid, W, 4 * W, gate)
                activations += (gate,)
            cell = activations[1] * cell + activations[0] * activations[2]
            squashed_cell = _tanh(cell)
            output = activations[3] * squashed_cell
            _store(cells, rows, valid, W, W, cell)
            _store(squashed, rows, valid, W, W, squashed_cell)
            _store(inputs + F, rows + batch, valid, W, F + W, output)
            state = output
        if len(hidden) > 0:
            state = _activate(_load(hidden[0], rows, valid, H, H) + _product(state, to_hidden), RELU)
            _store(hidden[0], rows, valid, H, H, state)
        loc = _load(out, rows, valid, D, 2 * D) + _product(state, to_loc)
        raw = _load(out + D, rows, valid, D, 2 * D) + _product(state, to_raw)
        scale = _softplus(raw)
        value = loc + scale * _load(noise, rows, valid, D, D)
        _store(out, rows, valid, D, 2 * D, loc)
        _store(out + D, rows, valid, D, 2 * D, raw)
        _store(soft + D, rows, valid, D, 2 * D, scale)
        _store(values, rows, valid, D, D, value)


@triton.jit(do_not_specialize=["steps", "batch"])
def _backward(
    weights: tl.tuple,
    read: tl.tuple,
    written: tl.tuple,
    steps: tl.tensor,
    batch: tl.tensor,
    SIZES: tl.constexpr,
    W: tl.constexpr,
    H: tl.constexpr,
    ROWS: tl.constexpr,
) -> None:
    before, recurrent, first, last = weights
    factors, to_value, by_cell, by_output, cell_by_state, forget, to_states, slopes, hidden_slopes = read
    to_features, to_gates, to_hidden, to_out = written
    D: tl.constexpr = SIZES[0]
    matrices, entering, carried, by_loc, by_raw = _weights(before, recurrent, last, SIZES, W, H, False)
    if len(to_hidden) > 0:
        by_hidden = _matrix(first, H, W, W, False)
    block = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    valid = block < batch
    into_value = tl.full((ROWS, padded(D)), 0.0, tl.float32)
    into_state = tl.full((ROWS, padded(W)), 0.0, tl.float32)
    into_cell = tl.full((ROWS, padded(W)), 0.0, tl.float32)
    for step in range(steps):
        rows = (steps - 1 - step) * batch + block
        into_value += _load(to_value, rows, valid, D, D)
        to_loc = _load(to_out, rows, valid, D, 2 * D) + into_value
        to_raw = _load(to_out + D, rows, valid, D, 2 * D) + _load(factors + D, rows, valid, D, 2 * D) * into_value
        _store(to_out, rows, valid, D, 2 * D, to_loc)
        _store(to_out + D, rows, valid, D, 2 * D, to_raw)
        gradient = _product(to_loc, by_loc) + _product(to_raw, by_raw)
        if len(to_hidden) > 0:
            gradient *= _load(hidden_slopes[0], rows, valid, H, H)
            _store(to_hidden[0], rows, valid, H, H, gradient)
            gradient = _product(gradient, by_hidden)
        if recurrent is not None:
            to_state = gradient + into_state + _load(to_states, rows, valid, W, W)
            into_cell += to_state * _load(cell_by_state, rows, valid, W, W)
            gradient, into_state = 0.0, 0.0
            for k in tl.static_range(4):
                if k < 3:
                    gate = _load(by_cell + k * W, rows, valid, W, 3 * W) * into_cell
                else:
                    gate = _load(by_output, rows, valid, W, W) * to_state
                _store(to_gates + k * W, rows, valid, W, 4 * W, gate)
                gradient += _product(gate, entering[k])
                into_state += _product(gate, carried[k])
            into_cell *= _load(forget, rows, valid, W, W)
        for i in tl.static_range(len(before) - 1, -1, -1):
            gradient *= _load(slopes[i], rows, valid, SIZES[i + 1], SIZES[i + 1])
            _store(to_features[i], rows, valid, SIZES[i + 1], SIZES[i + 1], gradient)
            gradient = _product(gradient, matrices[i])
        into_value = gradient
