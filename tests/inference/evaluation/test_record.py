"""Results as datasets and documents: a round trip keeps everything, altered documents are errors."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from dvae.inference.evaluation.record import MODELS, Dims, flatten
from dvae.inference.evaluation.result import Result, Table

NUMBERS = st.floats(width=64)


@dataclass(frozen=True, eq=False)
class Row:
    scores: Annotated[dict[str, np.ndarray], Dims("seed", "column", name="{}")]
    count: int
    unit: str | None = None


@dataclass(frozen=True, eq=False)
class Part:
    mean: Annotated[np.ndarray, Dims("sequence")]
    moves: Annotated[np.ndarray, Dims("sequence", "step", kind=int)]


@dataclass(frozen=True, eq=False, repr=False)
class Found(Result):
    rows: Annotated[dict[str, Row], MODELS]
    part: Part
    other: Part | None
    keys: list[tuple[str, int]]
    names: tuple[str, ...]
    level: float
    data: Mapping[str, Any] = field(default_factory=dict)

    def table(self):
        return Table()


@st.composite
def found(draw):
    def part():
        n, t = draw(st.integers(0, 3)), draw(st.integers(0, 3))
        moves = draw(arrays(np.int64, (n, t), elements=st.integers(-(2**53), 2**53)))
        return Part(draw(arrays(np.float64, n, elements=NUMBERS)), moves)

    names = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "Zs")), min_size=1, max_size=5)
    score = arrays(np.float64, array_shapes(min_dims=2, max_dims=2, max_side=3), elements=NUMBERS)
    row = st.builds(Row, st.dictionaries(names, score, max_size=2), st.integers(0, 9), st.none() | names)
    return Found(
        draw(st.dictionaries(names, row, max_size=3)),
        part(),
        part() if draw(st.booleans()) else None,
        draw(st.lists(st.tuples(names, st.integers(-9, 9)), max_size=2)),
        tuple(draw(st.lists(names, max_size=2))),
        draw(NUMBERS),
        {"a": [1, None, {"b": True}]},
    )


def same(ours, theirs):
    if isinstance(ours, np.ndarray):
        np.testing.assert_array_equal(ours, theirs, strict=True)
    elif isinstance(ours, dict):
        assert list(ours) == list(theirs)
        for key in ours:
            same(ours[key], theirs[key])
    elif hasattr(ours, "__dataclass_fields__"):
        same(vars(ours), vars(theirs))
    else:
        assert ours == theirs or (ours != ours and theirs != theirs)
        assert type(ours) is type(theirs)


@settings(max_examples=100, deadline=None)
@given(found())
def test_a_result_is_read_back_from_json(result):
    same(result, Found.from_json(result.to_json()))


def example():
    rows = {"a": Row({"CRPS": np.ones((2, 3))}, 1), "b": Row({"CRPS": np.zeros((1, 2)), "own": np.ones((1, 1))}, 2)}
    return Found(rows, Part(np.arange(2.0), np.eye(2, 4, dtype=int)), None, [("k", 1)], ("n",), math.inf)


def test_models_are_stacked_with_padding():
    dataset = example().dataset
    assert dataset["CRPS"].dims == ("model", "seed", "column")
    assert dataset["CRPS"].sel(model="b").values.tolist()[0][:2] == [0, 0]
    assert np.isnan(dataset["CRPS"].sel(model="b")).sum() == 4
    assert np.isnan(dataset["own"].sel(model="a")).all()
    assert dataset["part mean"].dims == ("sequence",)
    assert dataset.attrs["rows"]["a"]["count"] == 1
    assert example().extents == {"seed": {1, 2}, "column": {1, 2, 3}, "sequence": {2}, "step": {4}}


def test_a_dataset_is_written_for_other_tools(tmp_path):
    example().to_netcdf(tmp_path / "found.nc")
    with scipy.io.netcdf_file(tmp_path / "found.nc", mmap=False) as file:
        assert file.variables["CRPS"].dimensions == ("model", "seed", "column")
        assert json.loads(file.keys)


def test_an_array_with_wrong_dimensions_is_an_error():
    with pytest.raises(TypeError, match=r"mean must have .* got the shape \(1, 1\)"):
        flatten(Part(np.ones((1, 1)), np.ones((1, 1))))


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d.pop("variables"),
        lambda d: d["attributes"].pop("level"),
        lambda d: d["attributes"].update(more=1),
        lambda d: d["attributes"].update(names="n"),
        lambda d: d["attributes"].update(keys=[["k"]]),
        lambda d: d["attributes"].update(rows=[]),
        lambda d: d["attributes"]["rows"]["a"].update(scores={"CRPS": [2, 99]}),
        lambda d: d["attributes"]["rows"]["a"].update(scores={"other": [2, 3]}),
        lambda d: d["attributes"]["rows"].update(c={"scores": {}, "count": 1}),
        lambda d: d["models"].clear(),
        lambda d: d["variables"]["CRPS"].update(dims=["seed", "column"]),
        lambda d: d["variables"]["CRPS"].update(data=[[1.0], [1.0, 2.0]]),
        lambda d: d["variables"]["part moves"].update(data=[[0.5] * 4] * 2),
        lambda d: d["variables"]["part mean"].update(data=10**400),
    ],
)
def test_altered_documents_are_errors(change):
    document = json.loads(example().to_json())
    change(document)
    with pytest.raises(ValueError, match=r"not written by Found\.to_json"):
        Found.from_json(json.dumps(document))


@pytest.mark.parametrize("text", ["", "[]", "{}", "[" * 100_000])
def test_other_texts_are_errors(text):
    with pytest.raises(ValueError, match=r"not written by Found\.to_json"):
        Found.from_json(text)
