"""MoGlow: a likelihood that is exact, learns how coordinates hang together, and reads of the past what it is shown."""

import math

import numpy as np
import pytest
import torch

import dvae
from dvae.data.sequences import Sequences
from dvae.distributions import ConditionalFlow
from dvae.models.baselines.moglow import PAPER, start_flow
from dvae.tables import Column, Columns, Panel, Series
from dvae.tables.encoding import PanelSchema
from dvae.tables.protocol import Cut
from dvae.testing import FactorizationContract

SMALL = {"width": 4, "hidden": (4,), "flow_steps": 2}
X = torch.randn(6, 7, 3)


def small(**options):
    return dvae.method("moglow", **SMALL, **options)


class TestMoGlow(FactorizationContract):
    missing = {}  # noqa: RUF012

    def build(self, size):
        return small(frame_dropout=0.5).build({"x": size})


def test_where_a_frame_is_missing_the_model_reads_its_own_and_a_joint_alone_cannot_be():
    model, mask = small().build({"x": 3}).eval(), torch.ones_like(X, dtype=torch.bool)
    mask[:, 3] = False
    batch = {"x": torch.where(mask, X, math.nan), "mask": mask}
    filled = model.impute(batch, 3)["x"]
    assert torch.equal(filled[:, mask], X[mask].expand(3, -1))
    assert filled[:, :, 3].std(0).min() > 0
    assert torch.isfinite(dvae.SequenceELBO().terms(model, batch).bound).all()
    mask[0, 4, 1] = False
    with pytest.raises(ValueError, match="entries"):
        dvae.SequenceELBO().terms(model, {"x": X, "mask": mask})


@pytest.mark.parametrize(("mean", "dtype"), [(3.0, torch.float64), (1e9, torch.float32)])
def test_it_starts_where_training_data_are_noise_of_variance_1(mean, dtype):
    x = mean + 0.1 * torch.randn(50, 20, 3).cumsum(1).double()
    torch.manual_seed(0)
    model = small().build({"x": 3}).to(dtype)
    start_flow(model, Sequences({"x": x}))
    torch.testing.assert_close(model.units["x"].scale.double(), x.var((0, 1)).mean().sqrt(), rtol=0.1, atol=0)
    run = model.rollout(x)
    distribution, centred = run.evaluate("x", x), model.generator["x"].centred(x)
    noise, _ = getattr(distribution, "base", distribution).flow.to_noise(centred)
    torch.testing.assert_close(noise.mean((0, 1)).double(), torch.zeros(3).double(), rtol=0, atol=0.2)
    torch.testing.assert_close(noise.var((0, 1)).double(), torch.ones(3).double(), rtol=0, atol=0.3)


def table(*columns):
    rng = np.random.default_rng(0)
    values = {"real": rng.normal(5, 2, (6, 9)), "count": rng.poisson(3, (6, 9)).astype(float)}
    parts = [np.stack([values[column.family][n] for column in columns], -1) for n in range(6)]
    return Panel([Series(f"s{n}", part) for n, part in enumerate(parts)], Columns(columns))


def test_of_a_table_the_flow_makes_the_real_columns_and_others_have_their_law():
    panel = table(Column("a"), Column("n", family="count"), Column("b"))
    model = small().build(PanelSchema.from_data(panel, Cut()))
    assert model.generator["x"].events == [[0, 2]]
    x = torch.tensor(np.stack([one.values for one in panel])).float()
    assert torch.isfinite(dvae.SequenceELBO().terms(model, x).bound).all()
    assert not model.forecast(x, 2, samples=3)["x"][..., 1].frac().any()
    start_flow(model, Sequences({"x": x}))
    assert all(move.shift.any() for move in model.generator["x"].head.parts[0].flow.transforms[::4])
    whole = small().build(PanelSchema.from_data(table(Column("a"), Column("b")), Cut()))
    assert isinstance(whole.distributions["p(x)"], ConditionalFlow)
    with pytest.raises(ValueError, match="columns"):
        small().build(PanelSchema.from_data(table(Column("n", family="count")), Cut()))


def test_at_the_sizes_of_the_paper_it_is_built():
    model = dvae.method("moglow", **PAPER).build({"x": 51})
    distribution = model.generator["x"].head
    assert len(distribution.flow.transforms) == 4 * 16
    lstm = 4 * 512 * (51 + 512 + 2) + 4 * 512 * (512 + 512 + 2)
    coupling = (25 + 512 + 1) * 512 + (512 + 1) * 2 * 26
    assert sum(p.numel() for p in model.parameters()) == lstm + 513 * 2 * 51 + 16 * (coupling + 51**2 + 2 * 51)
