"""Batches: attributes for masks, lengths and groups, and reading each batch once."""

import pytest
import torch

from dvae import DynamicalVAE
from dvae.data import Batch
from dvae.program.batch import repeat, rows

X = torch.arange(24.0).view(4, 3, 2)


@pytest.fixture
def model():
    return DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 1, "x": 2})


@pytest.mark.parametrize("is_dict", [False, True])
def test_attributes_are_entries_that_are_no_variables(is_dict):
    observed = X > 3
    batch = Batch(
        x=X, mask={"x": observed} if is_dict else observed, lengths=torch.tensor([3, 2, 3, 1]), group=torch.arange(4)
    )
    assert torch.equal(batch.mask(), observed)
    assert batch.masks().keys() == {"x"}
    assert batch.partial
    assert torch.equal(batch.mask_to_nan().isnan(), ~observed)
    assert (batch.lengths.tolist(), batch.group.tolist()) == ([3, 2, 3, 1], [0, 1, 2, 3])
    plain = Batch(x=X)
    assert (plain.mask(), plain.lengths, plain.group, plain.log_det, plain.view_inputs) == (None, None, None, None, {})
    assert not plain.partial


def test_a_batch_is_restored_from_its_leaves():
    batch = Batch(x=X, motion={"x": X + 1, "view_inputs": {"turns": X + 2}})
    assert [*batch.leaves()] == ["x", "motion/x", "motion/view_inputs/turns"]
    restored = Batch.from_leaves(batch.leaves())
    assert restored["motion"].keys() == {"x", "view_inputs"}
    assert torch.equal(restored["motion"]["view_inputs"]["turns"], X + 2)


def test_rows_of_a_batch_are_a_batch_with_these_rows_of_every_tensor():
    batch = Batch(x=X, mask={"x": X > 3}, view_inputs={"turns": X})
    for part in (slice(1, 3), [1, 2], torch.tensor([1, 2])):
        selected = batch.rows(part)
        assert isinstance(selected, Batch)
        assert all(
            torch.equal(value, full[1:3]) for value, full in zip(*(b.leaves().values() for b in (selected, batch)))
        )
    assert torch.equal((batch | {"x": -X})["x"], -X)
    assert isinstance(batch | {"x": -X}, Batch)
    assert torch.equal(batch["x"], X)


def test_a_batch_is_read_only_once(model):
    batch = model.read(X)
    assert model.read(batch) is batch
    for part in (rows(batch, slice(2)), repeat(batch, 3)):
        assert model.read(part) is part
    with torch.no_grad():
        terms = model.guide(batch)
    assert terms["z"].shape == (4, 3, 1)


@pytest.mark.parametrize(
    "change",
    [
        lambda batch: batch.__setitem__("x", -X.double()),
        lambda batch: batch.update(x=-X.double()),
        lambda batch: batch.__ior__({"x": -X.double()}),
    ],
    ids=["item", "update", "or"],
)
def test_a_changed_batch_is_read_again(model, change):
    batch_read = model.read(X)
    change(batch_read)
    reread = model.read(batch_read)
    assert reread is not batch_read
    assert reread["x"].dtype == torch.float32
    assert torch.equal(reread["x"], -X)


def test_another_model_or_precision_reads_a_batch_again(model):
    batch = model.read(X)
    other = DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 1, "x": 2})
    assert other.read(batch) is not batch
    assert model.double().read(batch)["x"].dtype == torch.float64
    precise = model.float().read(X.double(), precise=True)
    assert precise.reader is None
