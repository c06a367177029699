"""Writes the tables of docs/audits.md: what guides miss, what that costs, and guides that miss nothing."""

from collections.abc import Sequence
from pathlib import Path

import torch
import tyro

import dvae
from dvae.inference.evaluation.estimates import number

from .pages import DOCS, code, write

HIT_DVAE = "p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)"
KVAE = "p(z_t | z_{t-1}, a_{<t}) p(a_t | z_t, a_{<t}) p(x_t | a_t)"
COLLAPSED = "p(a_t | a_{<t}) p(x_t | a_t)"
TWO_LAYERS = "p(w) p(u_t | u_{t-1}, w) p(z_t | z_{t-1}, u_t) p(x_t | x_{<t}, z_t)"

FAMILY = {
    "VAE": ("p(z_t) p(x_t | z_t)", "q(z_t | x_t)"),
    "DKF": ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})"),
    "DKF, bidirectional": ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})"),
    "KVAE": (KVAE, "q(a_t | x_t) q(z_t | z_{t-1}, a_{1:T})"),
    "KVAE, z integrated out": (COLLAPSED, "q(a_t | x_t)"),
    "KVAE, a_{<t} and x_{>t} added": (COLLAPSED, "q(a_t | a_{<t}, x_{t:T})"),
    "STORN, filtering": ("p(z_t) p(x_t | x_{<t}, z_{<=t})", "q(z_t | x_{<=t})"),
    "STORN, smoothing": ("p(z_t) p(x_t | x_{<t}, z_{<=t})", "q(z_t | x_{1:T})"),
    "STORN, z_{<t} added": ("p(z_t) p(x_t | x_{<t}, z_{<=t})", "q(z_t | z_{<t}, x_{1:T})"),
    "VRNN": ("p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})", "q(z_t | x_{<=t}, z_{<t})"),
    "VRNN, x_{>t} added": ("p(z_t | x_{<t}, z_{<t}) p(x_t | x_{<t}, z_{<=t})", "q(z_t | z_{<t}, x_{1:T})"),
    "SRNN": ("p(z_t | x_{<t}, z_{t-1}) p(x_t | x_{<t}, z_t)", "q(z_t | z_{t-1}, x_{1:T})"),
    "RVAE, causal": ("p(z_t) p(x_t | z_{<=t})", "q(z_t | z_{<t}, x_{t:T})"),
    "RVAE, non-causal": ("p(z_t) p(x_t | z_{1:T})", "q(z_t | z_{<t}, x_{1:T})"),
    "DSAE": ("p(w) p(z_t | z_{<t}) p(x_t | z_t, w)", "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"),
    "DSAE, z_{<t} added": (
        "p(w) p(z_t | z_{<t}) p(x_t | z_t, w)",
        "q(w | x_{1:T}) q(z_t | z_{<t}, x_{1:T}, w)",
    ),
    "HiT-DVAE": (HIT_DVAE, "q(w | x_{1:T}) q(z_t | x_{1:T}, w)"),
    "HiT-DVAE, z_{<t} added": (HIT_DVAE, "q(w | x_{1:T}) q(z_t | z_{<t}, x_{1:T}, w)"),
    "two layers": (
        TWO_LAYERS,
        "q(w | x_{1:T}) q(u_t | u_{t-1}, z_{t-1}, x_{1:T}, w) q(z_t | z_{t-1}, u_t, x_{1:T}, w)",
    ),
    "two layers, u_{t-1} dropped": (
        TWO_LAYERS,
        "q(w | x_{1:T}) q(u_t | z_{t-1}, x_{1:T}, w) q(z_t | z_{t-1}, u_t, x_{1:T}, w)",
    ),
}


DERIVED = ("DKF", "SRNN", "DSAE", "HiT-DVAE", "two layers")
"""Whose guides are derived, and their arrows priced."""


def spread(price: torch.Tensor) -> str:
    """Mean, least and largest over random models."""
    mean, least, largest = (number(float(value)) for value in (price.mean(), price.min(), price.max()))
    return f"{mean} ({least} to {largest})"


def derived(names: Sequence[str]) -> str:
    """The guides of some models that miss nothing, by what they cost."""
    lines = ["| | guide | drawn | arrows | looped | KL by draws |", "|---|---|---|---:|---|---|"]
    for name in names:
        for guide, order, *rest in dvae.alternatives(FAMILY[name][0]).rows:
            lines.append(f"| {name} | {code(guide)} | {order} | {' | '.join(rest)} |")
    return "\n".join(lines) + "\n"


def arrows(names: Sequence[str], steps: int, seeds: int) -> str:
    """What each arrow of the derived guide is worth by itself."""
    lines = ["| | arrow | price of leaving it out |", "|---|---|---|"]
    for name in names:
        for arrow, price in dvae.arrow_prices(FAMILY[name][0], steps=steps, seeds=seeds).items():
            lines.append(f"| {name} | {code(arrow)} | {spread(price)} |")
    return "\n".join(lines) + "\n"


def row(name: str, generative: str, inference: str, steps: int, seeds: int) -> str:
    """A line of the table."""
    audit = dvae.audit(generative, inference)
    missing, redundant = (
        ", ".join(code(term) for terms in found.values() for term in terms) or "–"
        for found in (audit.missing, audit.redundant)
    )
    sizes = dict.fromkeys((*audit.generative.variables,), 1)
    price = dvae.price(generative, inference, sizes, steps=steps, seeds=seeds)
    cells = (name, code(generative), code(inference), missing, redundant, spread(price))
    return f"| {' | '.join(cells)} |"


HEADER = """| | model | guide | missing | redundant | price |
|---|---|---|---|---|---|
"""


def main(page: Path = DOCS / "audits.md", steps: int = 5, seeds: int = 5) -> None:
    """Write the tables.

    Args:
        page: where.
        steps: of the sequences whose price is computed.
        seeds: models of random weights.
    """
    rows = [row(name, *equations, steps, seeds) for name, equations in FAMILY.items()]
    write(page, HEADER + "\n".join(rows) + "\n")
    names = [name for name in DERIVED if name in FAMILY]
    write(page, derived(names), name="derived")
    write(page, arrows(names, steps, seeds), name="arrows")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
