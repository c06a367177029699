"""The grammar: parsing, masks, order of drawing, and errors."""

import contextlib
import html
import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvae.factorization.notation import Block, Factorization, Parent, check_pair
from dvae.factorization.relations import NotationError, Relation
from dvae.testing.strategies import factorizations

HIT_DVAE = "p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)"
inf = math.inf


def parse(text, **masks):
    return Factorization.parse(text, masks=masks)


def band(T):
    t = np.arange(T)
    return (t[:, None] - t >= 1) & (t[:, None] - t <= 2)


# -------------------------------------------------------------------------------------------------- relations


@pytest.mark.parametrize(
    ("text", "intervals", "name"),
    [
        ("t-1", ((-1, -1),), "{t-1}"),
        ("t\N{MINUS SIGN}3", ((-3, -3),), "{t-3}"),
        ("<t", ((-inf, -1),), "{<t}"),
        (r"\geq t", ((0, inf),), "{>=t}"),
        ("<=t-2", ((-inf, -2),), "{<=t-2}"),
        ("t-2:t+1", ((-2, 1),), "{t-2:t+1}"),
        ("1:t-1", ((-inf, -1),), "{<t}"),
    ],
)
def test_relations_are_offset_intervals_with_one_canonical_name(text, intervals, name):
    relation = Relation.parse(text)
    assert relation.intervals == intervals
    assert relation.name == name
    assert Relation.parse(name[1:-1]) == relation


ends = st.integers(-4, 4)
relations = st.lists(
    st.tuples(ends | st.just(-inf), ends | st.just(inf)).filter(lambda i: i[0] <= i[1]), max_size=3
).map(Relation.of)


@given(relations, relations, st.integers(1, 9))
def test_relations_compose_like_their_masks(a, b, T):
    assert ((a | b).mask(T) == (a.mask(T) | b.mask(T))).all()
    assert ((a & b).mask(T) == (a.mask(T) & b.mask(T))).all()
    assert ((~a).mask(T) == ~a.mask(T)).all()
    assert ~~a == a
    assert ~(a | b) == ~a & ~b
    joined = Relation.of([])
    for part in a.parts:
        joined = joined | Relation.parse(part.name[1:-1])
    assert joined == a


# ---------------------------------------------------------------------------------------------------- reading


def test_fonts_are_ignored():
    latex = r"p_{\theta_{\mathbf{w}}}(\mathbf{w}) p(\mathbf z_t \mid \boldsymbol{z}_{<t}, \bm{x}_{t-1}, \mathbf{w}) "
    latex += r"p(\mathbf{x}_t \mid \mathbf{x}_{1:\mathrm{t}-1}, \mathbf{z}_t, \boldsymbol{w})"
    assert parse(latex) == parse(HIT_DVAE)
    assert parse(r"p(\mathrm{arm\_left}_t | \mathrm{arm\_left}_{<t})") == parse("p(arm_left_t | arm_left_{<t})")
    with pytest.raises(NotationError, match="z_1 names one step"):
        parse(r"p(\mathbf{z}_1)")


@given(factorizations())
def test_displayed_factors_are_parsed_back(pair):
    for f in map(parse, pair):
        latex = f._repr_latex_().strip("$").partition("=")[2]
        markdown = re.sub("<sub>(.*?)</sub>", r"_{\1}", f._repr_html_()).replace("_{<i>t</i>}", "_t").partition("=")[2]
        plain = html.unescape(re.sub("</?(?:i|span)>", "", markdown))
        assert parse(f.text) == f
        for text in (latex, plain):
            assert sorted(parse(text).factors, key=str) == sorted(f.factors, key=str)


def test_attributes_of_a_factorization():
    f = parse("p(z_t | z_{t-1}, c_t, pose) p(x_t | z_t, arm_left_{<t})")
    assert f.kind == "p"
    assert f.variables == ("z", "x")
    assert f.context == ("c", "pose", "arm_left")
    assert [f.local(name) for name in ("z", "c", "pose", "arm_left")] == [True, True, False, True]
    assert str(f.factor("x")) == "p(x_t | z_t, arm_left_{<t})"
    assert f.factor("x").parent("z") == Parent("z", True, Relation.parse("t"))
    with pytest.raises(ValueError, match=r"no factor for 'pose'.*z, x"):
        f.factor("pose")
    with pytest.raises(ValueError, match="no variable 'y'"):
        f.local("y")
    with pytest.raises(TypeError, match="equations"):
        parse(5)


tokens = ["p(", "q(", ")", " | ", ", ", "x_t", "z_t", "z_{<t}", "x_{1:T}", "x_{t-1}", "w", *"zxt_{}<=>:T-+1|\\ "]


@settings(max_examples=150)
@given(st.lists(st.sampled_from(tokens), max_size=12).map("".join))
def test_any_text_is_parsed_or_a_value_error(text):
    with contextlib.suppress(ValueError):
        assert parse(text).factors


@pytest.mark.parametrize(
    ("text", "column", "expected"),
    [
        ("r(x)", 0, "expected a factor: p(...) or q(...)"),
        ("p(z_t | z_{<<t})", 10, "unknown relation {<<t}; known are t, {t-1}"),
        ("p(z_t | z_t-1)", 8, "braces are missing: write z_{t-1}"),
        ("p(z_t | z_<t)", 10, "a subscript needs braces: write z_{<t}"),
        ("p(z_t | x_{t:t-1})", 10, "the range {t:t-1} is empty; write the earlier step first: {t-1:t}"),
        ("p(z_t | x_{<t", 10, '"{" without "}"'),
        ("p(z_t | z_{t-1}", 15, 'expected "," or ")"'),
        ("p(z_t |)", 7, "expected a variable"),
        ("p(z_{<=t} | w)", 2, "a factor is for one step: write p(z_t | ...), not z_{<=t}"),
        ("p(z_{1:T} | x_t)", 12, "z_{1:T} has no step t to which x_t could refer; write x_{1:T}"),
        ("p(z_t) q(x_t)", 7, "p and q in one factorization"),
    ],
)
def test_syntax_errors_point_at_their_column(text, column, expected):
    with pytest.raises(NotationError) as error:
        parse(text)
    message, line, caret = str(error.value).split("\n")
    assert message.startswith(expected)
    assert line == "    " + text
    assert caret == "    " + " " * column + "^"


def test_a_factor_of_all_steps_is_its_chain_rule():
    assert parse("p(x_{1:T} | y_{1:T}, w)") == parse("p(x_t | x_{<t}, y_{1:T}, w)")
    assert parse("p(w) p(x_{1:T} | w)").text == "p(w) p(x_t | x_{<t}, w)"


# ------------------------------------------------------------------------------------------------------ masks


def test_masks_have_one_row_or_column_for_static_ends():
    f = parse("q(w | x_{1:T}) q(v | w) q(z_t | z_{t-1}, x_{>=t}, w)")
    shapes = {(c, p): f.mask(c, p, 5).shape for c, p in [("z", "z"), ("z", "w"), ("w", "x"), ("v", "w"), ("v", "z")]}
    expected = {("z", "z"): (5, 5), ("z", "w"): (5, 1), ("w", "x"): (1, 5), ("v", "w"): (1, 1), ("v", "z"): (1, 5)}
    assert shapes == expected
    assert f.mask("w", "x", 5).all()
    assert f.mask("z", "w", 5).all()
    assert not f.mask("v", "z", 5).any()
    assert (f.mask("z", "x", 5) == np.triu(np.ones((5, 5), dtype=bool))).all()


def test_custom_masks_are_parsed_validated_and_ordered():
    f = parse("p(z_t | z_{band}, z_{t-3}) p(x_t | z_t)", band=band)
    t = np.arange(6)
    lag = t[:, None] - t
    assert (f.mask("z", "z", 6) == ((lag >= 1) & (lag <= 3))).all()
    assert f.blocks == (Block(("z",), 1), Block(("x",), 0))
    assert f.text == "p(z_t | z_{band}, z_{t-3}) p(x_t | z_t)"
    assert Factorization.parse(f.text, masks=f.masks) == f
    assert hash(f) == hash(Factorization.parse(f.text, masks=f.masks))
    static = parse("q(w | x_{first})", first=lambda T: np.arange(T)[None] < 3)
    assert static.mask("w", "x", 5).tolist() == [[True, True, True, False, False]]
    assert parse("q(z_t | z_{own})", own=lambda T: band(T).T).blocks == (Block(("z",), -1),)
    for text, custom_mask, message in (
        ("q(w | x_{own})", band, "static"),
        ("p(x_t | z_{own})", np.eye, "expected"),
        ("p(x_t | z_{own})", lambda T: True, "expected"),
        ("p(x_t | x_{own})", lambda T: np.tril(np.ones((T, T), dtype=bool)), "reads"),
    ):
        with pytest.raises(ValueError, match=message):
            parse(text, own=custom_mask)


# ----------------------------------------------------------------------------------------------------- blocks


@pytest.mark.parametrize(
    ("text", "blocks"),
    [
        (HIT_DVAE, [("w", 0), ("zx", 1)]),
        ("p(x_t | x_{<t}, z_t) p(z_t | x_{<t}, z_{t-1})", [("zx", 1)]),
        ("p(z_t | z_{<t}) p(x_t | x_{<t}, z_{1:T})", [("z", 1), ("x", 1)]),
        ("q(w | x_{1:T}) q(z_t | x_{1:T}, w)", [("w", 0), ("z", 0)]),
        ("q(z_t | u_t, z_{t+1}) q(u_t | z_{>t})", [("uz", -1)]),
        ("q(z_t | z_{t-1}) q(u_t | u_{t+1}, z_{1:T})", [("z", 1), ("u", -1)]),
        ("q(w | z_{1:T}) q(z_t | x_{1:T})", [("z", 0), ("w", 0)]),
        ("p(x_t | c_{>=t}, x_{t-1})", [("x", 1)]),
    ],
)
def test_blocks_have_the_expected_variables_and_directions(text, blocks):
    assert parse(text).blocks == tuple(Block(tuple(names), direction) for names, direction in blocks)


@given(factorizations(), st.integers(1, 5))
def test_blocks_draw_parents_before_children(pair, T):
    for f in map(parse, pair):
        dag = f.dag(T)
        nodes = [node for node in dag if node[0] in f.context]
        for block in f.blocks:
            steps = [None] if not f.local(block.names[0]) else range(1, T + 1)[:: block.direction or 1]
            nodes += [(name, t) for t in steps for name in block.names]
        assert sorted(nodes, key=str) == sorted(dag, key=str)
        position = {node: i for i, node in enumerate(nodes)}
        assert all(position[parent] < position[child] for parent, child in dag.edges)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "p(z_t | x_{<=t}) p(x_t | z_t)",
            "p(z_t | x_{<=t}) reads x_{<=t}, but x_t is drawn after z_t (cycle x_2 -> z_2 -> x_2); "
            "did you mean x_{<t}?",
        ),
        (
            "p(z_t | x_{>=t}) p(x_t | z_t)",
            "p(z_t | x_{>=t}) reads x_{>=t}, but a generative model is drawn forward in time "
            "(cycle x_2 -> z_2 -> x_2); did you mean x_{<t}?",
        ),
        (
            "p(x_t | x_t)",
            "p(x_t | x_t) reads x_t, but x_t is the variable that it draws (cycle x_2 -> x_2); did you mean x_{t-1}?",
        ),
        ("q(z_t | z_{1:T})", "backward"),
        ("q(z_t | z_{t-1}, u_{t+1}) q(u_t | z_{t-2})", "reads"),
        ("p(w | x_{1:T}) p(x_t | w)", "p(w | x_{1:T}) reads x_{1:T}, but x is drawn from w (cycle x_2 -> w -> x_2)"),
        ("p(a | b) p(b | a)", "p(a | b) reads b, but b is drawn from a (cycle b -> a -> b)"),
    ],
)
def test_a_cyclic_factorization_is_an_error_that_names_the_cycle(text, message):
    with pytest.raises(ValueError) as error:
        parse(text)
    assert message in str(error.value)


# --------------------------------------------------------------------------------------------------- the pair


@pytest.mark.parametrize(
    ("inference", "observed", "sizes", "message"),
    [
        (
            "q(w)",
            ["x"],
            None,
            "the latent z has no factor in the guide; add q(z_t | ...), or name z as observed, or sum z out if it is "
            "discrete: sizes={'z': dvae.Discrete(states)}",
        ),
        ("p(w) p(z_t)", ["x"], None, "expected p(...) for the generative model"),
        ("q(w) q(z)", ["x"], None, "z has one value per step in the generative model"),
        ("q(w) q(z_t) q(u_t)", ["x"], None, "q(u_t): no latent u in"),
        ("q(w) q(z_t) q(x_t | z_t)", ["x"], None, "q(x_t | z_t): x is observed"),
        ("q(w) q(z_t)", ["y"], None, "observed"),
        ("q(w) q(z_t)", ["x"], {"w": 1, "x": 1}, "missing"),
        ("q(w) q(z_t)", ["x"], {"w": 1, "z": 1, "x": 1, "v": 1}, "equations have"),
    ],
)
def test_an_inconsistent_pair_is_an_error(inference, observed, sizes, message):
    with pytest.raises(ValueError) as error:
        check_pair(parse("p(w) p(z_t | w) p(x_t | z_t)"), parse(inference), observed=observed, sizes=sizes)
    assert message in str(error.value)
