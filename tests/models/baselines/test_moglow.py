"""MoGlow: its contract, missing frames, initialisation, tables and published size."""

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


def test_whole_frames_may_be_missing_and_single_joints_may_not():
    model, mask = small().build({"x": 3}).eval(), torch.ones_like(X, dtype=torch.bool)
    mask[:, 3] = False
    batch = {"x": torch.where(mask, X, math.nan), "mask": mask}
    imputed = model.impute(batch, 3)["x"]
    assert torch.equal(imputed[:, mask], X[mask].expand(3, -1))
    assert imputed[:, :, 3].std(0).min() > 0
    assert torch.isfinite(dvae.SequenceELBO().terms(model, batch).bound).all()
    mask[0, 4, 1] = False
    with pytest.raises(ValueError, match="entries"):
        dvae.SequenceELBO().terms(model, {"x": X, "mask": mask})


@pytest.mark.parametrize(("mean", "dtype"), [(3.0, torch.float64), (1e9, torch.float32)])
def test_initialisation_maps_training_data_to_noise_of_variance_1(mean, dtype):
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


def test_the_flow_models_real_columns_and_other_columns_keep_their_family():
    panel = table(Column("a"), Column("n", family="count"), Column("b"))
    model = small().build(PanelSchema.from_data(panel, Cut()))
    assert model.generator["x"].events == [[0, 2]]
    x = torch.tensor(np.stack([one.values for one in panel])).float()
    assert torch.isfinite(dvae.SequenceELBO().terms(model, x).bound).all()
    assert not model.forecast(x, 2, samples=3)["x"][..., 1].frac().any()
    start_flow(model, Sequences({"x": x}))
    assert all(move.shift.any() for move in model.generator["x"].head.parts[0].flow.transforms[::4])
    real_only = small().build(PanelSchema.from_data(table(Column("a"), Column("b")), Cut()))
    assert isinstance(real_only.distributions["p(x)"], ConditionalFlow)
    with pytest.raises(ValueError, match="columns"):
        small().build(PanelSchema.from_data(table(Column("n", family="count")), Cut()))


def test_the_model_of_the_paper_has_the_expected_size():
    model = dvae.method("moglow", **PAPER).build({"x": 51})
    distribution = model.generator["x"].head
    assert len(distribution.flow.transforms) == 4 * 16
    lstm = 4 * 512 * (51 + 512 + 2) + 4 * 512 * (512 + 512 + 2)
    coupling = (25 + 512 + 1) * 512 + (512 + 1) * 2 * 26
    assert sum(p.numel() for p in model.parameters()) == lstm + 513 * 2 * 51 + 16 * (coupling + 51**2 + 2 * 51)
