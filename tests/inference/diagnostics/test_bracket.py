"""The bracket of the evidence and the parts of its gap, where all of them are known."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import dvae
from dvae import Bracket, Oracle, bracket, twin
from dvae.cli import main
from dvae.data.sequences import ArrayWindows
from dvae.data.views import View
from dvae.inference.diagnostics.bracket import DATA, PARTS

T, N = 3, 12
DKF = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})")
HMM = {"k": dvae.Discrete(2), "x": 1}
FEW = {"particles": 8, "temperatures": 3, "chains": 2, "fitting": 2, "progress": False}


@pytest.fixture(scope="module")
def known():
    """The oracle of a model whose guide is off, the cost of the best one, sequences by clip, and their bracket."""
    model = twin(*DKF, {"z": 1, "x": 1}, T, seed=1, scale=0.6)
    oracle = Oracle(model, T)
    cost = oracle.fit_guide(300)
    model.requires_grad_(False)
    torch.manual_seed(0)
    for parameter in model.encoder.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    x = model.sample(N, T)["x"]
    windows = ArrayWindows(x, 1, clips=[f"clip {n // 3}" for n in range(N)])
    found = bracket(
        model, windows, particles=1000, temperatures=20, chains=4, fitting=100, batch_size=N, progress=False
    )
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
    """Amortisation is what the guide lost by being off, missing arrows the price of the best one, the family nothing.

    Logarithms of weights have a variance of about twice the gap that they are of, and of ELBOs each is a mean of 1000.
    """
    oracle, cost, x, found = known
    evidence = oracle.evidence(x)
    total = (evidence - oracle.bound(x)).mean()
    parts = found.gap()
    error = 4 * math.sqrt(2 * float(total) / (1000 * N)) + 0.01
    assert min(cost, float(total) - cost) > 2 * error
    # of the best guide, which reads all data, every sequence loses the same
    assert parts["missing arrows"].mean == pytest.approx(cost, abs=error)
    assert parts["amortisation"].mean == pytest.approx(float(total) - cost, abs=error)
    assert parts["family"].mean == pytest.approx(0, abs=error)
    assert found.added == {"z": ["z_{t-1}"]}


def test_errors_are_clustered_by_clip_on_real_data_alone(known):
    *_, found = known
    values = found.bounds["real"]["IWAE"] - found.bounds["real"]["ELBO"]
    clips = [clip for _, clip, _ in found.keys]
    sums = np.array([values[[c == clip for c in clips]].sum() for clip in sorted({*clips})])
    deviations = (sums - 3 * values.mean()) / N
    assert found.estimate("IWAE", "ELBO").sequences == pytest.approx(math.sqrt(4 / 3 * (deviations**2).sum()))
    values = found.bounds["simulated"]["IWAE"]
    assert found.estimate("IWAE", data="simulated").sequences == pytest.approx(values.std(ddof=1) / math.sqrt(N))
    whole, frame = (found.estimate("IWAE", frame=frame) for frame in (False, True))
    assert frame.mean == pytest.approx(whole.mean / T)
    with pytest.raises(KeyError, match="no 'upper' of real data"):
        found.estimate("upper")


def test_intervals_hold_the_mean_as_often_as_they_say(known):
    """Of bounds that clips have in common, in sets that were drawn a thousand times."""
    *_, found = known
    random, held = np.random.default_rng(0), []
    keys = [("test", f"clip {n // 2}", n) for n in range(N)]
    for _ in range(1000):
        values = 3 + random.normal(size=N // 2).repeat(2) + 0.5 * random.normal(size=N)
        drawn = replace(found, keys=keys, bounds={"real": {"ELBO": np.zeros(N), "AIS": values}})
        below, above = drawn.estimate("AIS", "ELBO").interval(error="sequences")
        held.append(below < 3 < above)
    assert np.mean(held) == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / 1000))


def test_it_is_shown_and_kept(known):
    *_, found = known
    again = Bracket.from_json(found.to_json())
    assert str(again) == str(found)
    assert {name for name in PARTS if name in str(found)} == {*PARTS}
    assert "z: z_{t-1}" in str(found)
    panels = found.plot().axes
    assert [panel.get_title(loc="left") for panel in panels] == ["real data", "simulated data"]
    assert panels[1].get_legend_handles_labels()[1] == [name for name in PARTS if name != "unknown"]


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d.pop("gap"),
        lambda d: d.pop("keys"),
        lambda d: d["bounds"]["real"].pop("AIS"),
        lambda d: d["bounds"]["simulated"].pop("upper"),
        lambda d: d["bounds"]["real"].update(ELBO=[0.0]),
        lambda d: d["bounds"]["real"].update(ELBO=[None] * N),
        lambda d: d["bounds"]["real"].update(ELBO="x"),
        lambda d: d.update(frames=[[1.0]] * N),
        lambda d: d.update(keys=[["a"]] * N),
        lambda d: d.update(other=1),
        lambda d: d.update(notes="text"),
        lambda d: d.update(particles="many"),
        lambda d: d.update(equations=[]),
        lambda d: d.update(data={"called": [1, 2, 3]}),
        lambda d: d.update(added={"z": 3}),
    ],
)
def test_files_that_are_none_are_refused(known, change):
    document = json.loads(known[-1].to_json())
    change(document)
    with pytest.raises(ValueError, match="not a bracket"):
        Bracket.from_json(json.dumps(document))


@pytest.mark.parametrize("text", ["", "[]", "{}", "null", "3", '{"gap": 1, "keys": 4}'])
def test_texts_that_are_none_are_refused(text):
    with pytest.raises(ValueError, match="not a bracket"):
        Bracket.from_json(text)


def test_a_guide_that_goes_backward_has_no_fivo_and_a_law_that_is_no_normal_no_parts():
    model = twin(DKF[0], "q(z_t | z_{>t}, x_{1:T})", {"z": 1, "x": 1}, T).requires_grad_(False)
    found = bracket(model, torch.randn(2, T, 1), **{**FEW, "fitting": 0})
    assert "FIVO" not in found.bounds["real"]
    assert "backward" in found.notes[0]
    model = dvae.DynamicalVAE(*DKF, {"z": 2, "x": 1}, laws={"q": dvae.distributions.FAMILIES["correlated"]})
    found = bracket(model, torch.randn(2, T, 1), **FEW)
    assert "are normals" in found.notes[0]
    assert list(found.gap("simulated")) == ["unknown"]
    assert "family" not in str(found)


def test_chains_that_stay_in_one_mode_are_named():
    """Of two equal modes the guide knows one: the bound is log 2 too low, and the chains' own error does not see it."""
    laws, sizes = {"p(w)": dvae.distributions.Mixture(2)}, {"w": 1, "x": 1}
    model = dvae.DynamicalVAE("p(w) p(x_t | w)", "q(w | x_{1:T})", sizes, dvae.networks.Linear(1), laws).double()
    model.requires_grad_(False)
    prior, likelihood, guide = model.generator["w"].law, model.generator["x"], model.encoder["w"]
    for part in (*likelihood.parameters(), *guide.parameters()):
        part.zero_()  # so that x is of no w, and the posterior of w is its prior
    prior.loc.copy_(torch.tensor([[-9.0], [9.0]]))
    guide.law.out.bias[0] = 9.0
    x = model.sample(N, 1)["x"]
    evidence = torch.distributions.Normal(0.0, math.log(2) + 1e-3).log_prob(x[:, 0, 0])
    alone = dvae.annealed_bound(model, x, 20, 16)
    assert (alone.bound - evidence).mean() == pytest.approx(-math.log(2), abs=0.05)
    assert alone.error.max() < 0.2
    found = bracket(model, x, **{**FEW, "fitting": 0, "temperatures": 20, "chains": 4})
    assert any("AIS and family may be that much too low" in note for note in found.notes)


class Doubled(View):
    """The data twice as large."""

    def __call__(self, data, beside=None):
        return {**data, "x": 2 * data["x"]} if "x" in data and "log_det" not in data else dict(data)

    def inverse(self, seen):
        return {**{n: v for n, v in seen.items() if n != "log_det"}, "x": seen["x"] / 2}

    def log_det(self, data):
        return torch.full_like(data["x"], math.log(2.0))


def test_ragged_sequences_context_and_views():
    """Simulated sequences have the context and the lengths of the real ones; bounds on both are of the data as given.

    A view that doubles the data adds T D log 2 to every bound of the same sequences, and nothing to any difference.
    """
    equations = ("p(z_t | z_{t-1}, c) p(x_t | z_t)", "q(z_t | x_{1:T}, c)", {"z": 1, "x": 2, "c": 1})
    batch = {"x": torch.randn(3, T, 2), "c": torch.randn(3, 1), "lengths": torch.tensor([T, 1, 2])}
    found = {}
    for view in (None, Doubled()):
        torch.manual_seed(0)
        model = dvae.DynamicalVAE(*equations, view=view).double()
        seen = {**batch, "x": batch["x"] / (1 if view is None else 2)}
        found[view is None] = bracket(model, seen, **FEW)
    plain, doubled = found[True], found[False]
    assert sorted(plain.frames) == [1, 2, 3]
    for data in DATA:
        for name, values in plain.bounds[data].items():
            moved = doubled.bounds[data][name] - values
            np.testing.assert_allclose(moved, 2 * math.log(2.0) * plain.frames, atol=1e-6)


def test_sequences_are_drawn_and_scores_depend_on_the_seed():
    model = twin(*DKF, {"z": 1, "x": 1}, T).requires_grad_(False)
    x = torch.randn(6, T, 1).double()
    state = torch.get_rng_state()
    first, again, other = (bracket(model, x, count=2, seed=seed, **FEW) for seed in (0, 0, 1))
    assert torch.equal(state, torch.get_rng_state())
    assert first.to_json() == again.to_json() != other.to_json()
    assert len(first.keys) == 2


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"particles": 0}, "at least 1"),
        ({"fitting": -1}, "fitting at least 0"),
        ({"count": 0}, "at least 1"),
        ({"model": dvae.DynamicalVAE("p(x_t | x_{t-1})", "", {"x": 1})}, "nothing is latent"),
        ({"model": dvae.DynamicalVAE("p(k_t | k_{t-1}) p(x_t | k_t)", "", HMM)}, "but k, which is summed out"),
    ],
)
def test_what_has_no_bracket_is_refused(change, told):
    given = {"model": twin(*DKF, {"z": 1, "x": 1}, T), "data": torch.zeros(2, T, 1)}
    with pytest.raises(ValueError, match=told):
        bracket(**{**given, **change})


def test_the_command_line_writes_it(run: Path, tmp_path: Path):
    few = ["--particles", "2", "--temperatures", "2", "--chains", "1", "--fitting", "1", "--count", "2"]
    assert main(["bracket", str(run), *few, "--figure", str(tmp_path / "b.png")]) == 0
    found = Bracket.load(run / "bracket.json")
    assert len(found.keys) == 2
    assert found.gap("simulated").keys() == PARTS.keys()
    assert (tmp_path / "b.png").is_file()
    assert main(["bracket", str(run), "--chains", "0"]) == 2
