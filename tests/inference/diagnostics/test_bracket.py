"""The bracket of the evidence and the parts of its gap, on models where both are known."""

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
def bracketed():
    """Return the oracle of a perturbed guide, the cost of the best guide, shuffled sequences and their bracket."""
    model = linear_gaussian_surrogate(*DKF, {"z": 1, "x": 1}, T, seed=1, scale=0.6)
    oracle = Oracle(model, T)
    cost = oracle.fit_guide(300)
    model.requires_grad_(False)
    torch.manual_seed(0)
    for parameter in model.encoder.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    x = model.sample(N, T)["x"]
    windows = ArrayWindows(x, 1, groups=[f"clip {n // 3}" for n in range(N)])
    many = {"particles": 1000, "temperatures": 20, "chains": 4, "fitting": 100, "batch_size": N, "progress": False}
    result = bracket(model, windows, **many)
    order = torch.randperm(N, generator=torch.Generator().manual_seed(0))
    return oracle, cost, x[order], result


def test_the_bracket_contains_the_evidence_and_is_narrow(bracketed):
    """It holds to 0.1 nats for each real sequence, and on average for simulated ones."""
    oracle, _, x, result = bracketed
    evidence = oracle.evidence(x).numpy()
    assert np.abs(result.bounds["real"]["AIS"] - evidence).max() < 0.1
    gap = result.gap("simulated")["unknown"]
    assert abs(gap.mean) < 0.1
    assert gap.mean > -4 * gap.sequences - 1e-6
    above = result.bounds["real"]["IWAE"] - evidence
    assert above.mean() < 4 * above.std() / math.sqrt(N)
    assert all(result.estimate(name, "ELBO", data).mean > 0.1 for name in ("IWAE", "AIS") for data in DATA)


def test_the_parts_of_the_gap_are_the_known_costs(bracketed):
    """Each part is known: the loss of the perturbation, the gap of the best guide, and 0 for the family.

    The variance of log weights is about twice the gap; each ELBO is a mean of 1000 of them.
    """
    oracle, cost, x, result = bracketed
    evidence = oracle.evidence(x)
    total = (evidence - oracle.bound(x)).mean()
    parts = result.gap()
    error = 4 * math.sqrt(2 * float(total) / (1000 * N)) + 0.01
    assert min(cost, float(total) - cost) > 2 * error
    # the best guide reads all data and loses the same on every sequence
    assert parts["missing edges"].mean == pytest.approx(cost, abs=error)
    assert parts["amortisation"].mean == pytest.approx(float(total) - cost, abs=error)
    assert parts["family"].mean == pytest.approx(0, abs=error)
    assert result.added == {"z": ["z_{t-1}"]}


def test_a_bracket_is_printed_drawn_and_stored(bracketed):
    *_, result = bracketed
    again = Bracket.from_json(result.to_json())
    assert str(again) == str(result)
    for change in (lambda d: d["bounds"]["real"].pop("AIS"), lambda d: d["bounds"]["real"].update(ELBO=[1])):
        document = json.loads(result.to_json())
        change(document["attributes"])
        with pytest.raises(ValueError, match="not written by Bracket"):
            Bracket.from_json(json.dumps(document))
    assert {name for name in PARTS if name in str(result)} == {*PARTS}
    assert "z: z_{t-1}" in str(result)
    panels = result.plot().axes
    assert [panel.get_title(loc="left") for panel in panels] == ["real data", "simulated data"]
    assert panels[1].get_legend_handles_labels()[1] == [name for name in PARTS if name != "unknown"]


def test_a_backward_guide_has_no_fivo_bound_and_a_nonnormal_one_no_parts():
    model = linear_gaussian_surrogate(DKF[0], "q(z_t | z_{>t}, x_{1:T})", {"z": 1, "x": 1}, T).requires_grad_(False)
    result = bracket(model, torch.randn(2, T, 1), **{**FEW, "fitting": 0})
    assert "FIVO" not in result.bounds["real"]
    assert "backward" in result.notes[0]
    model = dvae.DynamicalVAE(*DKF, {"z": 2, "x": 1}, distributions={"q": dvae.distributions.FAMILIES["correlated"]})
    result = bracket(model, torch.randn(2, T, 1), **FEW)
    assert "are normals" in result.notes[0]
    assert list(result.gap("simulated")) == ["unknown"]
    assert "family" not in str(result)
