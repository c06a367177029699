"""The bracket of the evidence and the parts of its gap, where all of them are known."""

import json
import math

import numpy as np
import pytest
import torch

import dvae
from dvae import Bracket, Oracle, bracket, linear_gaussian_surrogate
from dvae.data.sequences import ArrayWindows
from dvae.inference.diagnostics.bracket import DATA, PARTS

T, N = 3, 12
DKF = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})")
FEW = {"particles": 8, "temperatures": 3, "chains": 2, "fitting": 2, "progress": False}


@pytest.fixture(scope="module")
def known():
    """The oracle of a model whose guide is off, the cost of the best one, sequences by clip, and their bracket."""
    model = linear_gaussian_surrogate(*DKF, {"z": 1, "x": 1}, T, seed=1, scale=0.6)
    oracle = Oracle(model, T)
    cost = oracle.fit_guide(300)
    model.requires_grad_(False)
    torch.manual_seed(0)
    for parameter in model.encoder.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    x = model.sample(N, T)["x"]
    windows = ArrayWindows(x, 1, clips=[f"clip {n // 3}" for n in range(N)])
    many = {"particles": 1000, "temperatures": 20, "chains": 4, "fitting": 100, "batch_size": N, "progress": False}
    found = bracket(model, windows, **many)
    order = torch.randperm(N, generator=torch.Generator().manual_seed(0))
    return oracle, cost, x[order], found


def test_the_bracket_holds_the_evidence_and_is_narrow(known):
    """Sequence by sequence on real data, to .1 nat; of simulated ones the two sides are as near to each other."""
    oracle, _, x, found = known
    evidence = oracle.evidence(x).numpy()
    assert np.abs(found.bounds["real"]["AIS"] - evidence).max() < 0.1
    gap = found.gap("simulated")["unknown"]
    assert abs(gap.mean) < 0.1
    assert gap.mean > -4 * gap.sequences - 1e-6
    above = found.bounds["real"]["IWAE"] - evidence
    assert above.mean() < 4 * above.std() / math.sqrt(N)
    assert all(found.estimate(name, "ELBO", data).mean > 0.1 for name in ("IWAE", "AIS") for data in DATA)


def test_the_parts_of_the_gap_are_what_they_cost(known):
    """Amortisation is what the guide lost by being off, missing edges the price of the best one, the family nothing.

    Logarithms of weights have a variance of about twice the gap that they are of, and of ELBOs each is a mean of 1000.
    """
    oracle, cost, x, found = known
    evidence = oracle.evidence(x)
    total = (evidence - oracle.bound(x)).mean()
    parts = found.gap()
    error = 4 * math.sqrt(2 * float(total) / (1000 * N)) + 0.01
    assert min(cost, float(total) - cost) > 2 * error
    # of the best guide, which reads all data, every sequence loses the same
    assert parts["missing edges"].mean == pytest.approx(cost, abs=error)
    assert parts["amortisation"].mean == pytest.approx(float(total) - cost, abs=error)
    assert parts["family"].mean == pytest.approx(0, abs=error)
    assert found.added == {"z": ["z_{t-1}"]}


def test_it_is_shown_and_kept(known):
    *_, found = known
    again = Bracket.from_json(found.to_json())
    assert str(again) == str(found)
    for change in (lambda d: d["bounds"]["real"].pop("AIS"), lambda d: d["bounds"]["real"].update(ELBO=[1])):
        document = json.loads(found.to_json())
        change(document["attributes"])
        with pytest.raises(ValueError, match="not written by Bracket"):
            Bracket.from_json(json.dumps(document))
    assert {name for name in PARTS if name in str(found)} == {*PARTS}
    assert "z: z_{t-1}" in str(found)
    panels = found.plot().axes
    assert [panel.get_title(loc="left") for panel in panels] == ["real data", "simulated data"]
    assert panels[1].get_legend_handles_labels()[1] == [name for name in PARTS if name != "unknown"]


def test_a_guide_that_goes_backward_has_no_fivo_and_a_law_that_is_no_normal_no_parts():
    model = linear_gaussian_surrogate(DKF[0], "q(z_t | z_{>t}, x_{1:T})", {"z": 1, "x": 1}, T).requires_grad_(False)
    found = bracket(model, torch.randn(2, T, 1), **{**FEW, "fitting": 0})
    assert "FIVO" not in found.bounds["real"]
    assert "backward" in found.notes[0]
    model = dvae.DynamicalVAE(*DKF, {"z": 2, "x": 1}, distributions={"q": dvae.distributions.FAMILIES["correlated"]})
    found = bracket(model, torch.randn(2, T, 1), **FEW)
    assert "are normals" in found.notes[0]
    assert list(found.gap("simulated")) == ["unknown"]
    assert "family" not in str(found)
