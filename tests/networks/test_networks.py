"""The contract of every network: masks hold, single steps equal all steps at once, and padding changes nothing."""

import copy
import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dvae.factorization.relations import Relation
from dvae.networks import Attention, Dense, FrameGraph, Input, Linear, NodeGraph, Recurrent, SelfAttention
from dvae.networks.loop import memoizing, shift
from dvae.networks.recurrent import tie

T = 6
NETWORKS = {
    "linear": Linear(steps=T),
    "gru": Recurrent(4, cell="gru", hidden=(5,)),
    "lstm": Recurrent(4, hidden=(5, 3)),
    "lstm, two layers, embedded": Recurrent(4, layers=2, embed=3, hidden=(5,)),
    "lstm, extracted": Recurrent(4, extract={"z": (3, 2), "w": (4,)}, hidden=(5,)),
    "lstm, separate, join_current": Recurrent(4, extract={"c": (3,)}, separate=True, join_current=True, hidden=()),
    "lstm, averaged": Recurrent(
        4, extract=dict.fromkeys([*"zxuvcw", *(f"y{i}" for i in range(6))], (4,)), mean=True, hidden=(5,)
    ),
    "attention": Attention(8, heads=2),
    "attention, two layers": Attention(8, heads=4, layers=2, feedforward=6),
    "attention, extracted": Attention(8, heads=2, nearest=False, extract={"z": NodeGraph(2), "x": (3,), "w": (4,)}),
    "attention, sinusoids": Attention(8, heads=2, layers=2, nearest=False, positions="sinusoids", start=False),
    "lstm, poses": Recurrent(4, extract={"z": NodeGraph(2), "x": NodeGraph(2)}, hidden=(5,)),
    "dense": Dense((5, 4)),
}
RELATIONS = [
    *("t", "t-1", "t+1", "t-2:t-1", "t-1:t+2", "<t", "<=t", "<=t-2", "<=t+1", ">t", ">=t", ">=t+2", ">=t-1"),
    "1:T",
]
COMPOSED = {
    "all but t": ~Relation.parse("t"),
    "past and t+2": Relation.parse("<t") | Relation.parse("t+2"),
    "recent or old": Relation.parse("t-1") | Relation.parse("<=t-3"),
}


def even_steps(length):
    return np.arange(length)[None, :] % 2 == np.zeros((length, 1))


def band(length):
    steps = np.arange(length)
    return abs(steps[:, None] - steps - 1) <= 1


CUSTOM = {
    "even steps": Relation.custom("even", even_steps),
    "band": Relation.custom("band", band),
    "past, even steps": Relation.parse("<t") & Relation.custom("even", even_steps),
}


def build(kind, inputs, local=True, size=2, dtype=torch.float64):
    return NETWORKS[kind].build(inputs, local, size).to(dtype)


def supports(kind, relation):
    if kind == "dense":
        return relation.intervals is not None and relation.pointwise
    return relation.intervals is not None or "attention" in kind or kind == "linear"


def draw(inputs, batch, steps=T, dtype=torch.float64, lengths=None):
    """Return random parents, with zeros at padding."""
    shapes = {p.name: (batch, p.size) if p.relation is None else (batch, steps, p.size) for p in inputs}
    values = {name: torch.randn(shape, dtype=dtype) for name, shape in shapes.items()}
    if lengths is not None:
        pad = torch.arange(steps) >= lengths[:, None]
        values |= {name: v.masked_fill(pad[..., None], 0) for name, v in values.items() if v.dim() == 3}
    return values


def reads(network, parents, name):
    """Return which steps of a parent the features of each step depend on: (T, T), or (1, T) for a static child."""

    def features(value):
        out = network({**parents, name: value}, T)
        return (out @ torch.linspace(1.0, 2.0, out.shape[-1], dtype=out.dtype)).flatten()  # one number for each step

    jacobian = torch.autograd.functional.jacobian(features, parents[name])
    return (jacobian != 0).any(-1)[:, 0].numpy()


# ------------------------------------------------------------------------------------------------------ masks

EVERY = {text: Relation.parse(text) for text in RELATIONS} | COMPOSED | CUSTOM


@pytest.mark.parametrize(
    ("kind", "relation"), [(k, r) for m, k in enumerate(NETWORKS) for n, r in enumerate(EVERY) if (m + n) % 6 == 0]
)
def test_features_depend_exactly_on_the_steps_of_the_mask(kind, relation):
    relation = EVERY[relation]
    if not supports(kind, relation):
        with pytest.raises(ValueError, match=r"use networks\.(Recurrent or networks\.)?Attention"):
            build(kind, [Input("z", 2, relation)])
        return
    inputs = [Input("z", 2, relation), Input("c", 1, Relation.parse("t-1")), Input("w", 2)]
    network = build(kind, inputs)
    mask = np.broadcast_to(relation.mask(T), (T, T))
    assert np.array_equal(reads(network, draw(inputs, 1), "z"), mask)


ENCODERS = {
    "whole": ({"x": "1:T", "u": "1:T", "w": None}, set()),
    "past": ({"x": "<=t", "w": None}, set()),
    "future": ({"x": ">=t", "u": ">=t"}, set()),
    "whole, then its own past": ({"x": "1:T", "w": None, "z": "<t"}, {"z"}),
    "whole, then what another sight shows": ({"x": "1:T", "u": "<=t", "c": "t-1", "z": "<t"}, {"u", "z"}),
}


def encoder_inputs(pair):
    return [Input(name, 3, relation and Relation.parse(relation)) for name, relation in ENCODERS[pair][0].items()]


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("pair", ENCODERS)
def test_an_encoder_respects_its_masks_in_single_steps_and_ragged_batches(pair, layers):
    inputs, live = encoder_inputs(pair), ENCODERS[pair][1]
    network = SelfAttention(8, heads=4, layers=layers, extract={"x": NodeGraph(2)}).build(inputs, True, 2).double()
    parents = draw(inputs, 1)
    for parent in inputs:
        if parent.relation is not None:
            assert np.array_equal(
                reads(network, parents, parent.name), np.broadcast_to(parent.relation.mask(T), (T, T))
            )
    lengths = torch.tensor([3, T, 1])
    for ragged in (None, lengths):
        parents = draw(inputs, 3, lengths=ragged)
        together = network(parents, T, ragged)
        is_step = torch.ones(3, T, 1) if ragged is None else (torch.arange(T) < lengths[:, None])[..., None]
        stepwise = by_steps(network, parents, live, 1, ragged)
        torch.testing.assert_close(stepwise * is_step, together * is_step, rtol=0, atol=1e-10)
    for i, n in enumerate(lengths.tolist()):
        single = network({k: v[i : i + 1, :n] if v.dim() == 3 else v[i : i + 1] for k, v in parents.items()}, n)
        torch.testing.assert_close(together[i : i + 1, :n], single, rtol=0, atol=1e-10)


def test_attention_weights_are_those_of_the_layers():
    """Weights sum to one and are zero at hidden steps, and the layers use the values that they mix."""
    inputs = [Input("z", 2, Relation.parse("<t")), Input("x", 3, Relation.parse("1:T")), Input("w", 2)]
    network = Attention(8, heads=2, layers=2, extract={"x": NodeGraph(2)}).build(inputs, True, 2).double()
    parents = draw(inputs, 3)
    outputs = []
    for layer in network.layers:
        layer.out.register_forward_pre_hook(lambda _, arguments: outputs.append(arguments[0]))
    network(parents, T)
    attention = network.attention(parents, T)
    values = network.extractors.of(parents, None)
    tokens, _ = network.tokens(network.ranged, values, 3, T, None)
    hidden = ~torch.cat([torch.ones(T, 1, dtype=torch.bool), torch.tril(torch.ones(T, T), -1).bool()], 1)
    for layer, weights, output in zip(network.layers, attention, outputs, strict=False):
        torch.testing.assert_close(weights.sum(-1), torch.ones(3, 2, T, dtype=torch.float64))
        assert (weights[..., : T + 1].masked_select(hidden) == 0).all()
        torch.testing.assert_close((weights @ layer.project(tokens)[1]).transpose(1, 2).flatten(2), output)


def sinusoids(size):
    """Return the position encodings of the first T steps by their formula."""
    step, entry = np.ogrid[:T, :size]
    phase = step / 10_000 ** (entry // 2 * 2 / size)
    return torch.from_numpy(np.where(entry % 2, np.cos(phase), np.sin(phase)))


def test_sinusoids_are_added_to_queries_and_tokens():
    inputs = [Input("z", 2, Relation.parse("t")), Input("x", 3, Relation.parse("<t"))]
    network = Attention(8, heads=2, positions="sinusoids").build(inputs, True, 2).double()
    parents, plain = draw(inputs, 3), Attention(8, heads=2).build(inputs, True, 2).double()
    plain.load_state_dict(network.state_dict())
    queries, without = (each.queries(parents, 3, T) for each in (network, plain))
    torch.testing.assert_close(queries - without, sinusoids(8).expand(3, T, 8))
    (tokens, bias), (without, _) = (each.tokens(each.ranged, parents, 3, T, None) for each in (network, plain))
    torch.testing.assert_close(tokens[:, 1:] - without[:, 1:], sinusoids(8).expand(3, T, 8))
    assert {*bias.unique().tolist()} == {0.0, -np.inf}


def test_an_encoder_adds_sinusoids_to_its_tokens():
    inputs = [Input("x", 3, Relation.parse("1:T"))]
    network = SelfAttention(8, heads=2, positions="sinusoids").build(inputs, True, 2).double()
    parents = draw(inputs, 3)
    (layer,) = network.layers
    stream = network.embed(parents["x"]) + sinusoids(8)
    keys, values = layer.project(layer.norm_query(stream))
    expected = network.norm(layer(stream, keys, values, torch.zeros(T, T, dtype=torch.float64)))
    torch.testing.assert_close(network(parents, T), expected)


def test_only_the_first_step_reads_a_start_token_that_others_do_not():
    inputs = [Input("z", 2, Relation.parse("t")), Input("x", 3, Relation.parse("<t"))]
    network = Attention(8, heads=2, start=False).build(inputs, True, 2).double()
    (weights,) = network.attention(draw(inputs, 3), T)
    torch.testing.assert_close(weights[:, :, :, 0], (torch.arange(T) == 0).double().expand(3, 2, T))


@pytest.mark.parametrize("steps", [1, 6])
def test_a_frame_graph_reads_the_first_frames_and_random_windows_in_training(steps):
    network = FrameGraph(4, width=5, blocks=2, extract={"x": NodeGraph(2)})
    network = network.build([Input("x", 3, Relation.parse("1:T"))], False, 2).double()
    x = torch.randn(64, steps, 3, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(lambda x: network.eval()({"x": x}, steps), x[:1])[0, :, 0]
    assert jacobian.abs().amax((0, 2)).bool().tolist() == [t < 4 for t in range(steps)]
    starts = {s: network.eval()({"x": x[:, s:]}, steps - s) for s in range(max(1, steps - 3))}
    trained = network.train()({"x": x}, steps)
    matching_starts = [
        {s for s, features in starts.items() if torch.equal(features[i], row)} for i, row in enumerate(trained)
    ]
    assert set.union(*matching_starts) == set(starts)
    assert all(matching_starts)
    lengths = torch.randint(1, steps + 1, (64,))
    ragged = network.eval()({"x": x}, steps, lengths)
    for i, n in enumerate(lengths.tolist()):
        torch.testing.assert_close(ragged[i : i + 1], network({"x": x[i : i + 1, :n]}, n), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("size", "features"), [(6, 4)])
def test_node_features_equal_the_published_convolutions_of_each_frame(size, features):
    module = NodeGraph(2, coordinates=3).build(size).double()
    poses = torch.randn(3, 5, size, dtype=torch.float64)

    def convolution(layer, nodes):
        products = torch.einsum("ij,...jf,of->...io", layer.adjacency, nodes, layer.weight)
        return torch.tanh(products + layer.bias)

    nodes = convolution(module.first, poses.unflatten(-1, (features // 2, -1)))
    for block in module.blocks:
        nodes = nodes + convolution(block[1], convolution(block[0], nodes))
    assert module.features == features
    torch.testing.assert_close(module(poses), nodes.flatten(-2), rtol=0, atol=1e-12)


# --------------------------------------------------------------------------------------- one step at a time

FORWARD = {"z": "<t", "x": "t-1", "u": "t-2:t", "v": "<=t"}
BACKWARD = {"z": ">t", "x": "t+1", "u": "t:t+2", "v": ">=t"}
SPLITS = [set(split) for n in range(1, 4) for split in itertools.combinations("zxu", n)] + [{"z", "x", "u", "v"}]


def by_steps(network, parents, live, direction, lengths=None):
    """Return the features by `start` and `step`. Values that are not drawn yet are None, so reading them fails."""
    batch, steps = parents["x"].shape[:2]
    fixed = {name: value for name, value in parents.items() if name not in live}
    state = network.start(fixed, batch, steps, lengths)
    draws = {name: [None] * steps for name in live}
    now = [p.name for p in network.inputs if p.name in live and p.relation.mask(1)[0, 0]]
    features = [None] * steps
    for t in range(steps)[::direction]:
        for name in now:
            draws[name][t] = parents[name][:, t]
        features[t], state = network.step(state, t, draws)
        for name in live - set(now):
            draws[name][t] = parents[name][:, t]
    return torch.stack(features, 1)


def loop_inputs(kind, direction):
    relations = FORWARD if direction > 0 else BACKWARD
    pick = {name: Relation.parse(text) for name, text in relations.items()}
    if kind == "dense":
        pick |= {"z": pick["x"], "v": pick["u"]}
    return [
        *(Input(name, size, pick[name]) for name, size in (("z", 2), ("x", 3), ("u", 1), ("v", 2))),
        Input("c", 2, pick["u"] if kind == "dense" else Relation.parse("1:T")),
        Input("w", 2),
    ]


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("kind", NETWORKS)
def test_single_steps_equal_all_steps_at_once(kind, direction):
    inputs = loop_inputs(kind, direction)
    network = build(kind, inputs)
    lengths = torch.tensor([T, 1, 4])
    for ragged in (None, lengths):
        parents = draw(inputs, 3, lengths=ragged)
        together = network(parents, T, ragged)
        is_step = torch.ones(3, T, 1) if ragged is None else (torch.arange(T) < lengths[:, None])[..., None]
        for live in SPLITS:
            for grad in (True, False):
                with torch.set_grad_enabled(grad):
                    stepwise = by_steps(network, parents, live, direction, ragged)
                torch.testing.assert_close(stepwise * is_step, together * is_step, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", ["dense", "gru", "lstm, two layers, embedded"])
def test_chunks_after_a_selection_equal_steps(kind):
    """A chunk of several steps starts at selected rows; `x` is known and `z` is drawn."""
    inputs = [Input("z", 2, Relation.parse("t-1")), Input("x", 3, Relation.parse("t"))]
    if kind != "dense":
        inputs = [Input("z", 2, Relation.parse("<t")), Input("x", 3, Relation.parse("<=t"))]
    network, rows = build(kind, inputs), torch.tensor([2, 0, 1])
    parents = draw(inputs, 3)
    expected = network(parents, T)[rows]
    state = network.select(network.start({"x": parents["x"]}, 3, T), rows)
    draws = {"z": list(parents["z"][rows].unbind(1))}
    chunk, _ = network.forward_chunk(state, 0, T, draws)
    torch.testing.assert_close(chunk, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("pair", [("<t", ">t"), ("<=t-2", ">t"), ("<=t-3", ">=t")])
def test_a_stack_refuses_parents_that_skip_steps(pair):
    """The backward memory reads forward states, which contain the skipped steps."""
    first, second = map(Relation.parse, pair)
    with pytest.raises(ValueError, match=r"every parent with a past or future must be read over \{1:T\}"):
        Recurrent(4, stack=True).build([Input("x", 2, first | second)], True, 2)


# ---------------------------------------------------------------------------------------------------- padding


@pytest.mark.parametrize("kind", NETWORKS)
def test_padding_changes_nothing(kind):
    names = ["t-1", "t:t+1"] if kind == "dense" else ["<t", ">=t", "1:T", "t+1", "<=t-2", "t-1:t+2"]
    inputs = [Input(f"y{i}", 2, Relation.parse(text)) for i, text in enumerate(names)]
    network = build(kind, inputs)
    lengths = torch.tensor([3, T, 1])
    parents = draw(inputs, 3, lengths=lengths)
    padded = network(parents, T, lengths)
    for i, n in enumerate(lengths.tolist()):
        single = network({name: v[i : i + 1, :n] for name, v in parents.items()}, n)
        torch.testing.assert_close(padded[i : i + 1, :n], single, rtol=0, atol=1e-10)


# ------------------------------------------------------------------------------------------------ shared work


def recurrent_pair():
    past = [Input("x", 2, Relation.parse("<t"))]
    first = build("lstm", [*past, Input("z", 1, Relation.parse("t"))])
    second = build("lstm", [Input("x", 2, Relation.parse("1:T")), Input("z", 1, Relation.parse("t-1"))])
    return first, second, draw(second.inputs, 3)


def test_a_tied_past_is_evaluated_once_and_has_the_gradients_of_all_uses():
    first, second, parents = recurrent_pair()
    tie(first, second)
    untied = copy.deepcopy(second)  # this one copies the memory
    calls = []
    first.past.layers[0].register_forward_hook(lambda *_: calls.append(1))

    def outputs(other):
        return first(parents, T).square().sum() + other(parents, T).cos().sum()

    memory = list(first.past.parameters())
    with memoizing():
        gradients = torch.autograd.grad(outputs(second), memory)
    assert len(calls) == 1
    untied_output = outputs(untied)
    assert len(calls) == 2
    copied = list(untied.past.parameters())
    expected = [
        a + b
        for a, b in zip(
            torch.autograd.grad(untied_output, memory, retain_graph=True),
            torch.autograd.grad(untied_output, copied),
            strict=True,
        )
    ]
    torch.testing.assert_close(gradients, tuple(expected), rtol=0, atol=1e-12)


@given(steps=st.integers(1, 6), lag=st.integers(-8, 8))
def test_shift_reads_zero_outside_of_the_sequence(steps, lag):
    values = torch.arange(1.0, steps + 1)[None, :, None]
    expected = [values[0, t + lag, 0].item() if 0 <= t + lag < steps else 0.0 for t in range(steps)]
    assert shift(values, lag).flatten().tolist() == expected
