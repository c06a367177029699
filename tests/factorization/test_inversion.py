"""Derived guides are exact, and every edge of them is necessary."""

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
def test_markov_boundaries_agree_with_d_separation(pair):
    dag = Factorization.parse(pair[0]).dag(3)
    given_nodes, boundaries = {node for node in dag if node[0] == "x"}, MarkovBoundaries(dag)
    for node in sorted(set(dag) - given_nodes, key=str):
        boundary = boundaries.of(node, given_nodes)
        assert boundary == {u for u in given_nodes if not nx.is_d_separator(dag, {node}, {u}, given_nodes - {u})}
        assert nx.is_d_separator(dag, {node}, given_nodes - boundary, boundary) or boundary == given_nodes
        given_nodes = given_nodes | {node}


def smaller_guides(guide, width):
    """Yield the guide without one of its offsets or static parents, for each of them."""
    for factor in guide.factors:
        for parent in factor.parents:
            cuts = [None]
            if factor.local and parent.local:
                reads = [k for k in range(1 - width, width) if parent.relation.reads(k, 0)]
                cuts = [parent.relation & ~Relation.of([(k, k)]) for k in reads]
            for cut in cuts:
                reduced = () if cut is None or not cut.intervals else (replace(parent, relation=cut),)
                parents = [p for each in factor.parents for p in (reduced if each is parent else (each,))]
                smaller_factor = replace(factor, parents=tuple(parents))
                yield replace(
                    guide, factors=tuple(smaller_factor if each is factor else each for each in guide.factors)
                )


@settings(max_examples=15, deadline=None)
@given(factorizations(), st.data())
def test_a_derived_guide_is_exact_and_no_smaller_one_is(pair, data):
    generative = pair[0]
    order = data.draw(st.sampled_from(list(orders(generative))), label="order")
    derived = faithful_inverse(generative, order=order)
    audit = dvae.audit(generative, derived)
    assert audit.exact
    # A lag of 2 alone may make patterns periodic in time, and their relations would be infinite.
    assert not audit.redundant or "{t-2}" in generative
    if not audit.redundant:
        smaller = list(smaller_guides(derived, width=4))
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
def test_derived_guides_match_those_by_hand(generative, order, expected):
    derived = faithful_inverse(generative, order=order)
    assert derived == (Factorization.parse(expected) if expected else Factorization("q", ()))


@pytest.mark.parametrize("name", FAMILY)
def test_a_repaired_guide_is_exact_and_keeps_the_order(name):
    audit = dvae.audit(*FAMILY[name])
    repaired = dvae.audit(audit.generative, audit.repaired)
    assert repaired.exact
    assert not repaired.redundant
    assert repaired.inference.variables == tuple(name for block in audit.inference.blocks for name in block.names)
    if audit.exact and not audit.redundant:
        for factor in audit.inference.factors:
            reads = audit.repaired.factor(factor.child).parents
            assert {p.name: p.relation for p in reads} == {p.name: p.relation for p in factor.parents}


def test_alternatives_list_their_costs():
    alternatives = dvae.alternatives("p(w) p(u_t | w) p(z_t | z_{t-1}, u_t) p(x_t | z_t)")
    texts = {entry.inference.text for entry in alternatives.guides}
    assert len(texts) == len(alternatives) == len(alternatives.guides)
    loops = [bool(entry.sequential) for entry in alternatives.guides]
    assert loops == sorted(loops)
    for entry in alternatives.guides:
        assert entry.edges == entry.inference.dag(alternatives.steps).number_of_edges()
        closed = analytic_kl(alternatives.generative, entry.inference)
        assert entry.sampled == tuple(name for name in closed if not closed[name])
        assert all(text in str(alternatives) for text in (entry.inference.text, describe_order(entry.order)))
    assert alternatives[0] == alternatives.guides[0].inference
    assert "<td>" in alternatives._repr_html_()


def test_the_cost_of_an_edge_is_the_gap_of_the_guide_without_it():
    costs = dvae.edge_costs(DKF, steps=3, seeds=2)
    assert list(costs) == sorted(costs, key=lambda edge: -costs[edge].mean())
    without = dvae.kl_gap(DKF, "q(z_t | z_{t-1}, x_{>t})", {"z": 1, "x": 1}, steps=3, seeds=2)
    torch.testing.assert_close(costs["x_t to z_t"], without, atol=1e-8, rtol=0)
    assert all((cost > 1e-6).all() for cost in costs.values())  # every edge of a derived guide is necessary
    redundant = dvae.edge_costs(DKF, "q(z_t | z_{t-1}, x_{1:T})", steps=3, seeds=1)
    assert abs(redundant["x_{<t} to z_t"]) < 1e-8


def test_a_model_accepts_faithful_as_its_guide():
    model = dvae.DynamicalVAE(DKF, "faithful", {"z": 2, "x": 3})
    assert model.inference == faithful_inverse(DKF)
    bound = dvae.SequenceELBO().terms(model, {"x": torch.randn(4, 5, 3)}).bound
    assert bound.shape == (4,)
    assert dvae.audit(DKF, "faithful").exact
    assert guide(Factorization.parse(DKF), "faithful", masks={}) == faithful_inverse(DKF)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: faithful_inverse(DKF, order=[Block(("u",), 1)]), "latents"),
        (lambda: faithful_inverse(HIT_DVAE, order=[Block(("w", "z"), 1)]), "mixes static and local"),
        (lambda: dvae.alternatives(DKF, steps=0), "`steps` must be at least 1"),
        (
            lambda: faithful_inverse(
                Factorization.parse("p(z_t | z_{own}) p(x_t | z_t)", {"own": Relation.parse("<t").mask})
            ),
            "has the custom mask",
        ),
        (lambda: dvae.alternatives("p(x_t | x_{<t})"), "has no latents"),
        (
            lambda: Factorization.parse(DKF).without("z", faithful_inverse(DKF).factors[0].parents[1]),
            "no edge from x_",
        ),
    ],
)
def test_wrong_arguments_are_an_error(call, message):
    with pytest.raises(ValueError, match=message):
        call()
