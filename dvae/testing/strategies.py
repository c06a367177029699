"""Random factorizations for property tests, as hypothesis strategies."""

from __future__ import annotations

from hypothesis import strategies as st

PAST = ("{t-1}", "{t-2}", "{<t}", "{t-2:t-1}")
NOW = ("t", "{<=t}", "{t-1:t}")
ANY = (*PAST, *NOW, "{t+1}", "{>t}", "{>=t}", "{1:T}")
BACKWARD = {
    "{t-1}": "{t+1}",
    "{t-2}": "{t+2}",
    "{<t}": "{>t}",
    "{t-2:t-1}": "{t+1:t+2}",
    "{<=t}": "{>=t}",
    "{t-1:t}": "{t:t+1}",
}


@st.composite
def factorizations(draw: st.DrawFn) -> tuple[str, str]:
    """Draw pairs (generative, inference) of equations that are valid together.

    Variables are the observed x, one or two local latents z and u, and possibly a static latent w. Factors are written
    in random order, not always in their order of sampling. Some guides run backward in time.

    Example::

        @given(factorizations())
        def test_bound(pair):
            generative, inference = map(dvae.Factorization.parse, pair)
    """
    latents = draw(st.sampled_from([("z",), ("z", "u")]))
    shared = ["w"] if draw(st.booleans()) else []

    order = draw(st.permutations([*latents, "x"]))
    # Either all local variables share one loop over time, or each reads earlier ones at any step and its own past.
    layered = draw(st.booleans())
    generative = ["p(w)"] if shared else []
    for i, child in enumerate(order):
        reads = {}
        for j, parent in enumerate(order):
            earlier, later = (ANY, ()) if layered else (PAST + NOW, PAST)
            allowed = earlier if j < i else PAST if j == i else later
            if allowed and draw(st.booleans()):
                reads[parent] = draw(st.sampled_from(allowed))
        generative.append(_factor("p", child, reads, [name for name in shared if draw(st.booleans())]))

    flip = BACKWARD if draw(st.booleans()) else {}
    static_first = draw(st.booleans())
    order = draw(st.permutations(latents))
    inference = []
    for i, child in enumerate(order):
        reads = {"x": draw(st.sampled_from(ANY))} if draw(st.booleans()) else {}
        for j, parent in enumerate(order):
            if draw(st.booleans()):
                relation = draw(st.sampled_from(PAST + NOW if j < i else PAST))
                reads[parent] = flip.get(relation, relation)
        visible = [name for name in shared if static_first and draw(st.booleans())]
        inference.append(_factor("q", child, reads, visible))
    if shared:
        sources = ["x"] if static_first else ["x", *latents]
        parents = [f"{name}_{{1:T}}" for name in sources if draw(st.booleans())]
        inference.append(f"q(w | {', '.join(parents)})" if parents else "q(w)")
    return " ".join(draw(st.permutations(generative))), " ".join(draw(st.permutations(inference)))


def _factor(kind: str, child: str, reads: dict[str, str], static: list[str]) -> str:
    parents = [f"{name}_{relation}" for name, relation in reads.items()] + static
    return f"{kind}({child}_t{' | ' if parents else ''}{', '.join(parents)})"
