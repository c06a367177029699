"""Writes the table of docs/audits.md: what each guide of the family misses, and what that costs in nats."""

from pathlib import Path

import tyro

import dvae

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


def row(name: str, generative: str, inference: str, steps: int, seeds: int) -> str:
    """A line of the table."""
    audit = dvae.audit(generative, inference)
    missing, redundant = (
        ", ".join(code(term) for terms in found.values() for term in terms) or "–"
        for found in (audit.missing, audit.redundant)
    )
    sizes = dict.fromkeys((*audit.generative.variables,), 1)
    price = dvae.price(generative, inference, sizes, steps=steps, seeds=seeds)
    cost = f"{price.mean():.3f} ({price.min():.3f} to {price.max():.3f})"
    cells = (name, code(generative), code(inference), missing, redundant, cost)
    return f"| {' | '.join(cells)} |"


HEADER = """| | model | guide | missing | redundant | price |
|---|---|---|---|---|---|
"""


def main(page: Path = DOCS / "audits.md", steps: int = 5, seeds: int = 5) -> None:
    """Write the table.

    Args:
        page: where.
        steps: of the sequences whose price is computed.
        seeds: models of random weights.
    """
    rows = [row(name, *equations, steps, seeds) for name, equations in FAMILY.items()]
    write(page, HEADER + "\n".join(rows) + "\n")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
