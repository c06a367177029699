"""Audits: dependencies of exact posteriors by d-separation, compared with published guides."""

import doctest
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import assume, given, settings
from matplotlib.patches import Circle, FancyArrowPatch, Rectangle

import dvae.factorization.graph
import dvae.factorization.inversion
import dvae.factorization.notation
from benchmarks.studies.audits import FAMILY
from benchmarks.studies.results import read
from dvae.factorization.graph import analytic_kl, audit
from dvae.factorization.notation import Factorization
from dvae.testing.strategies import factorizations

DKF = "p(z_t | z_{t-1}) p(x_t | z_t)"
STORN = "p(z_t) p(x_t | x_{<t}, z_{<=t})"
HIT_DVAE = "p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)"

# name: (generative, inference, missing, redundant), derived by hand
PUBLISHED = {
    "dkf mean field": (DKF, "q(z_t | x_{1:T})", {"z": ("z_{t-1}",)}, {}),
    "dkf backward": (DKF, "q(z_t | z_{t+1}, x_{<=t})", {}, {}),
    "dkf backward, all": (DKF, "q(z_t | z_{>t}, x_{1:T})", {}, {"z": ("x_{>t}", "z_{>=t+2}")}),
    "storn original": (STORN, "q(z_t | x_{<t})", {"z": ("x_{>=t}", "z_{<t}")}, {"z": ("x_{<t}",)}),
    "long lag": ("p(z_t | z_{t-25:t-1}) p(x_t | z_t)", "q(z_t | z_{t-9:t-1}, x_{>=t})", {"z": ("z_{t-25:t-10}",)}, {}),
}
"""Guides that the stored table of audits does not list."""


@pytest.mark.parametrize("name", PUBLISHED)
def test_audits_of_published_guides_match_those_by_hand(name):
    generative, inference, missing, redundant = PUBLISHED[name]
    result = audit(generative, inference)
    assert result.missing == missing
    assert result.redundant == redundant
    assert result.exact == (not missing)


@settings(max_examples=20, deadline=None)
@given(factorizations())
def test_a_guide_with_its_missing_parents_added_is_exact(pair):
    # A {t-2} alone makes patterns periodic in time, and relations list only a few periods.
    assume(not any(lag in text for text in pair for lag in ("{t-2}", "{t+2}")))
    inference = Factorization.parse(pair[1])
    missing = audit(*pair).missing_parents
    text = ""
    for factor in inference.factors:
        reads = ", ".join(map(str, (*factor.parents, *missing.get(factor.child, ()))))
        text += f"q({factor.child}{'_t' if factor.local else ''}{' | ' if reads else ''}{reads})"
    richer = Factorization.parse(text)
    # With more parents its order of drawing may change, and the exact conditionals with it.
    assume(richer.blocks == inference.blocks)
    assert audit(pair[0], richer).exact


@pytest.mark.parametrize(
    ("generative", "inference", "hidden", "analytic"),
    [
        (DKF, "q(z_t | z_{t-1}, x_{t:T})", (), {"z": True}),
        (DKF, "q(z_t | z_{>t}, x_{1:T})", (), {"z": False}),
        (HIT_DVAE, "q(w | x_{1:T}) q(z_t | x_{1:T}, w)", (), {"w": True, "z": True}),
        ("p(w) p(z_t | w) p(x_t | z_t)", "q(z_t | x_{1:T}) q(w | z_{1:T})", (), {"z": False, "w": True}),
        ("p(z_t | z_{t-4}) p(x_t | z_t)", "q(z_t | z_{t+2}, x_{1:T})", (), {"z": False}),
        # parents of a hidden mean count as parents
        ("p(z_t | x_{t-1}) p(x_t | z_t)", "q(z_t | z_{t+1}, x_{1:T})", (), {"z": True}),
        ("p(z_t | x_{t-1}) p(x_t | z_t, x_{t-8})", "q(z_t | z_{t+7}, x_{1:T})", ("x",), {"z": False}),
        (
            "p(z_t | x_{t-1}) p(y_t | y_{t-1}, u) p(x_t | y_t) p(u)",
            "q(z_t | x_t) q(u | z_{1:T})",
            ("x", "y"),
            {"z": False, "u": True},
        ),
    ],
)
def test_analytic_kl_is_used_only_if_unbiased(generative, inference, hidden, analytic):
    is_unbiased = analytic_kl(Factorization.parse(generative), Factorization.parse(inference), {*hidden})
    assert is_unbiased == analytic


def test_custom_masks_are_evaluated_at_the_given_length():
    masks = {"far": far}
    pair = (
        Factorization.parse("p(z_t | z_{far}) p(x_t | z_t)", masks=masks),
        Factorization.parse("q(z_t | z_{>t}, x_{1:T})"),
    )
    assert analytic_kl(*pair, steps=9) == {"z": True}
    assert analytic_kl(*pair, steps=10) == {"z": False}


def first(length):
    return np.arange(length)[None] < 1


def far(length):
    return np.eye(length, k=-9, dtype=bool)


@pytest.mark.parametrize(
    ("generative", "inference", "missing"),
    [
        ("p(z_t) p(x_t | z_{first})", "q(z_t | x_t)", True),
        ("p(z_t) p(x_t | z_{first})", "q(z_t | x_{1:T})", False),
        ("p(z_t | z_{far}) p(x_t | z_t)", "q(z_t | z_{<t}, x_{1:T})", False),
    ],
)
def test_custom_masks_are_audited_over_all_steps_of_one_length(generative, inference, missing):
    model = Factorization.parse(generative, masks={"first": first, "far": far})
    result = audit(model, inference, steps=12)
    assert bool(result.missing) == missing
    assert "at T = 12" in result.verdict
    assert result.steps == 12
    assert audit("p(z_t) p(x_t | z_t)", "q(z_t | x_t)").steps is None


@pytest.mark.parametrize(
    "module", [dvae.factorization.graph, dvae.factorization.inversion, dvae.factorization.notation]
)
def test_examples_in_docstrings_run(module):
    assert doctest.testmod(module, extraglobs={"dvae": dvae}).failed == 0


def documented():
    """Return name -> (generative, inference, missing, redundant) of the stored table of audits, as lists of terms."""
    rows = read("audits/guides").rows
    return {name: [re.findall("`(.*?)`", cell) for cell in cells] for name, *cells, _ in rows}


DOCUMENTED = documented()


@pytest.mark.parametrize("name", DOCUMENTED)
def test_the_stored_table_of_audits_agrees_with_audit(name):
    (generative,), (inference,), missing, redundant = DOCUMENTED[name]
    result = audit(generative, inference)
    assert missing == [term for terms in result.missing.values() for term in terms]
    assert redundant == [term for terms in result.redundant.values() for term in terms]


def test_the_audits_page_lists_the_models_of_its_script():
    assert {name: (p, q) for name, ((p,), (q,), *_) in DOCUMENTED.items()} == FAMILY


def test_without_a_guide_the_prior_is_used_and_an_empty_one_needs_no_latents():
    result = audit("p(z_t | z_{t-1}) p(x_t | z_t)", None)
    assert str(result.inference) == "q(z_{1:T}) = ∏_t q(z_t | z_{t-1})"
    assert [str(parent) for parent in result.missing["z"]] == ["x_{>=t}"]
    with pytest.raises(ValueError, match="latent"):
        audit("p(z_t) p(x_t | z_t)", "")
    for guide in (None, ""):
        assert audit("p(x_t | x_{<t})", guide).exact


def test_an_audit_is_printed_as_a_table():
    result = audit(*FAMILY["HiT-DVAE"])
    assert str(result).splitlines()[:3] == [
        "guide factor         missing  redundant",
        "q(w | x_{1:T})       -        -",
        "q(z_t | x_{1:T}, w)  z_{<t}   -",
    ]
    assert str(result).splitlines()[-1].startswith("not exact: ")
    assert result.table().row_count == 2
    assert "<td>z_{&lt;t}</td>" in result._repr_html_()


# ---------------------------------------------------------------------------------------------------- drawing


@pytest.fixture
def ax():
    figure, ax = plt.subplots(figsize=(8, 6))
    yield ax
    plt.close(figure)


def edges(ax):
    return [patch for patch in ax.patches if isinstance(patch, FancyArrowPatch)]


def test_no_edge_passes_behind_a_node(ax):
    f = Factorization.parse("p(u_t | u_{<t}) p(z_t | z_{<t}, u_t) p(x_t | x_{<t}, z_t)")
    assert f.draw(4, ax=ax) is ax
    assert len(edges(ax)) == f.dag(4).number_of_edges()
    nodes = [patch for patch in ax.patches if isinstance(patch, Circle)]
    assert len(nodes) == len(f.dag(4))
    centres, radius = np.array([node.center for node in nodes]), nodes[0].radius
    ax.figure.canvas.draw()  # fixes the aspect, and so the curves
    for edge in edges(ax):
        on_screen = edge.get_transform().transform_path(edge.get_path()).to_polygons(closed_only=False)
        path = ax.transData.inverted().transform(np.concatenate(on_screen))
        distance = np.linalg.norm(path[:, None] - centres, axis=-1).min(axis=0)
        assert (distance < 1.2 * radius).sum() == 2


def test_an_audit_draws_missing_and_redundant_edges(ax):
    audit(*FAMILY["VRNN"]).draw(3, ax=ax)
    assert [edge.get_linestyle() for edge in edges(ax)].count("--") == 3  # x_2, x_3 -> z_1 and x_3 -> z_2
    ax.clear()
    audit(*FAMILY["DKF, bidirectional"]).draw(3, ax=ax)
    assert [edge.get_linestyle() for edge in edges(ax)].count(":") == 3
    ax.clear()
    audit("p(z_t | pose, c_t) p(x_t | z_t)", "q(z_t | x_t)").draw(2, ax=ax)  # context that the guide ignores
    assert sum(isinstance(patch, Rectangle) for patch in ax.patches) == 3
