"""Batches: attributes for what is not a variable, and reading each batch once."""

import pytest
import torch

from dvae import DynamicalVAE
from dvae.data import Batch
from dvae.program.batch import repeat, rows

X = torch.arange(24.0).view(4, 3, 2)


@pytest.fixture
def model():
    return DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 1, "x": 2})


@pytest.mark.parametrize("named", [False, True])
def test_attributes_are_entries_that_are_no_variables(named):
    seen = X > 3
    batch = Batch(x=X, mask={"x": seen} if named else seen, lengths=torch.tensor([3, 2, 3, 1]), group=torch.arange(4))
    assert torch.equal(batch.mask(), seen)
    assert batch.masks().keys() == {"x"}
    assert batch.partial
    assert torch.equal(batch.mask_to_nan().isnan(), ~seen)
    assert (batch.lengths.tolist(), batch.group.tolist()) == ([3, 2, 3, 1], [0, 1, 2, 3])
    plain = Batch(x=X)
    assert (plain.mask(), plain.lengths, plain.group, plain.log_det, plain.view_inputs) == (None, None, None, None, {})
    assert not plain.partial


def test_parts_of_a_batch_are_batches_with_the_same_rows_of_every_tensor():
    batch = Batch(x=X, mask={"x": X > 3}, view_inputs={"turns": X})
    for part in (slice(1, 3), [1, 2], torch.tensor([1, 2])):
        found = batch.rows(part)
        assert isinstance(found, Batch)
        assert all(
            torch.equal(value, whole[1:3]) for value, whole in zip(*(b.leaves().values() for b in (found, batch)))
        )
    assert torch.equal((batch | {"x": -X})["x"], -X)
    assert isinstance(batch | {"x": -X}, Batch)
    assert torch.equal(batch["x"], X)


def test_what_was_read_is_not_read_again(model):
    read = model.read(X)
    assert model.read(read) is read
    for part in (rows(read, slice(2)), repeat(read, 3)):
        assert model.read(part) is part
    with torch.no_grad():
        terms = model.guide(read)
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
def test_a_batch_that_was_changed_is_read_again(model, change):
    read = model.read(X)
    change(read)
    found = model.read(read)
    assert found is not read
    assert found["x"].dtype == torch.float32
    assert torch.equal(found["x"], -X)


def test_a_batch_is_read_anew_by_another_model_and_in_another_precision(model):
    read = model.read(X)
    other = DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)", {"z": 1, "x": 2})
    assert other.read(read) is not read
    assert model.double().read(read)["x"].dtype == torch.float64
    precise = model.float().read(X.double(), precise=True)
    assert precise.reader is None
