"""Derived guides: they miss nothing, they need every edge, and at their best the bound is the evidence."""

from dataclasses import replace

import networkx as nx
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import dvae
import dvae.factorization.inversion
from benchmarks.studies.audits import FAMILY
from dvae.factorization.graph import analytic_kl
from dvae.factorization.inversion import MarkovBoundaries, describe_order, faithful_inverse, guide, orders
from dvae.factorization.notation import Block, Factorization
from dvae.factorization.relations import Relation
from dvae.testing.strategies import factorizations

DKF = "p(z_t | z_{t-1}) p(x_t | z_t)"
HIT_DVAE = "p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)"
TWO_LAYERS = "p(u_t | u_{t-1}) p(z_t | z_{t-1}, u_t) p(x_t | z_t)"


@settings(max_examples=15, deadline=None)
@given(factorizations())
def test_markov_boundary_is_d_separation(pair):
    dag = Factorization.parse(pair[0]).dag(3)
    known, boundaries = {node for node in dag if node[0] == "x"}, MarkovBoundaries(dag)
    for node in sorted(set(dag) - known, key=str):
        boundary = boundaries.of(node, known)
        assert boundary == {u for u in known if not nx.is_d_separator(dag, {node}, {u}, known - {u})}
        assert nx.is_d_separator(dag, {node}, known - boundary, boundary) or boundary == known
        known = known | {node}


def fewer(guide, width):
    """The guide without one of the offsets, or static parents, that it reads, each in turn."""
    for factor in guide.factors:
        for parent in factor.parents:
            cuts = [None]
            if factor.local and parent.local:
                reads = [k for k in range(1 - width, width) if parent.relation.reads(k, 0)]
                cuts = [parent.relation & ~Relation.of([(k, k)]) for k in reads]
            for cut in cuts:
                left = () if cut is None or not cut.intervals else (replace(parent, relation=cut),)
                parents = [p for each in factor.parents for p in (left if each is parent else (each,))]
                less = replace(factor, parents=tuple(parents))
                yield replace(guide, factors=tuple(less if each is factor else each for each in guide.factors))


@settings(max_examples=15, deadline=None)
@given(factorizations(), st.data())
def test_a_derived_guide_is_exact_and_no_smaller_one_is(pair, data):
    generative = pair[0]
    order = data.draw(st.sampled_from(list(orders(generative))), label="order")
    found = faithful_inverse(generative, order=order)
    audit = dvae.audit(generative, found)
    assert audit.exact
    # A lag of 2 alone may make patterns periodic in time, of which relations have no end.
    assert not audit.redundant or "{t-2}" in generative
    if not audit.redundant:
        smaller = list(fewer(found, width=4))
        for less in data.draw(st.permutations(smaller))[:3]:
            assert not dvae.audit(generative, less).exact, less.text


@pytest.mark.parametrize(
    ("generative", "order", "expected"),
    [
        (DKF, [Block(("z",), -1)], "q(z_t | z_{t+1}, x_{<=t})"),
        ("p(z_t | z_{t-1}, c_t, pose) p(x_t | z_t)", None, "q(z_t | z_{t-1}, x_{t:T}, c_{t:T}, pose)"),
        (HIT_DVAE, None, "q(w | x_{1:T}) q(z_t | z_{<t}, x_{1:T}, w)"),
        (HIT_DVAE, [Block(("z",), 1), Block(("w",), 0)], "q(z_t | z_{<t}, x_{1:T}) q(w | z_{1:T}, x_{1:T})"),
        (TWO_LAYERS, [Block(("z",), 1), Block(("u",), 1)], "q(z_t | z_{<t}, x_{t:T}) q(u_t | u_{t-1}, z_{t-1:T})"),
        ("p(x_t | x_{<t})", None, ""),
    ],
)
def test_guides_worked_out_by_hand(generative, order, expected):
    found = faithful_inverse(generative, order=order)
    assert found == (Factorization.parse(expected) if expected else Factorization("q", ()))


@pytest.mark.parametrize("name", FAMILY)
def test_a_repaired_guide_keeps_the_order_and_misses_nothing(name):
    audit = dvae.audit(*FAMILY[name])
    repaired = dvae.audit(audit.generative, audit.repaired)
    assert repaired.exact
    assert not repaired.redundant
    assert repaired.inference.variables == tuple(name for block in audit.inference.blocks for name in block.names)
    if audit.exact and not audit.redundant:
        for factor in audit.inference.factors:
            reads = audit.repaired.factor(factor.child).parents
            assert {p.name: p.relation for p in reads} == {p.name: p.relation for p in factor.parents}


def test_alternatives_are_told_by_what_they_cost():
    found = dvae.alternatives("p(w) p(u_t | w) p(z_t | z_{t-1}, u_t) p(x_t | z_t)")
    texts = {each.inference.text for each in found.guides}
    assert len(texts) == len(found) == len(found.guides)
    loops = [bool(each.looped) for each in found.guides]
    assert loops == sorted(loops)
    for each in found.guides:
        assert each.edges == each.inference.dag(found.steps).number_of_edges()
        closed = analytic_kl(found.generative, each.inference)
        assert each.sampled == tuple(name for name in closed if not closed[name])
        assert all(text in str(found) for text in (each.inference.text, describe_order(each.order)))
    assert found[0] == found.guides[0].inference
    assert "<td>" in found._repr_html_()


def test_the_price_of_an_edge_is_that_of_the_guide_without_it():
    found = dvae.edge_costs(DKF, steps=3, seeds=2)
    assert list(found) == sorted(found, key=lambda edge: -found[edge].mean())
    without = dvae.kl_gap(DKF, "q(z_t | z_{t-1}, x_{>t})", {"z": 1, "x": 1}, steps=3, seeds=2)
    torch.testing.assert_close(found["x_t to z_t"], without, atol=1e-8, rtol=0)
    assert all((cost > 1e-6).all() for cost in found.values())  # none of a derived guide is for nothing
    spare = dvae.edge_costs(DKF, "q(z_t | z_{t-1}, x_{1:T})", steps=3, seeds=1)
    assert abs(spare["x_{<t} to z_t"]) < 1e-8


def test_a_model_takes_the_word():
    model = dvae.DynamicalVAE(DKF, "faithful", {"z": 2, "x": 3})
    assert model.inference == faithful_inverse(DKF)
    bound = dvae.SequenceELBO().terms(model, {"x": torch.randn(4, 5, 3)}).bound
    assert bound.shape == (4,)
    assert dvae.audit(DKF, "faithful").exact
    assert guide(Factorization.parse(DKF), "faithful", masks={}) == faithful_inverse(DKF)


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: faithful_inverse(DKF, order=[Block(("u",), 1)]), "latents"),
        (lambda: faithful_inverse(HIT_DVAE, order=[Block(("w", "z"), 1)]), "mixes static and local"),
        (lambda: dvae.alternatives(DKF, steps=0), "steps must be at least 1"),
        (
            lambda: faithful_inverse(
                Factorization.parse("p(z_t | z_{own}) p(x_t | z_t)", {"own": Relation.parse("<t").mask})
            ),
            "a custom mask",
        ),
        (lambda: dvae.alternatives("p(x_t | x_{<t})"), "has no latents"),
        (
            lambda: Factorization.parse(DKF).without("z", faithful_inverse(DKF).factors[0].parents[1]),
            "no edge from x_",
        ),
    ],
)
def test_errors_say_what_is_wrong(call, told):
    with pytest.raises(ValueError, match=told):
        call()
