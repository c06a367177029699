"""Results as xarray datasets and as JSON.

A result is a dataclass. The annotations of its fields name the dimensions of its arrays:

    n_steps: Annotated[np.ndarray, Dims("sequence")]
    bounds: Annotated[dict[str, np.ndarray], Dims("seed", "sequence", name="{}")]      a variable for each key
    rows: Annotated[dict[str, Row], MODELS]                                            the dimension "model"

Arrays become variables. Arrays of several models are stacked; the smaller ones are padded with NaN. Everything else
becomes an attribute of the dataset. Nothing is lost: `unflatten` returns the same dataclass.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from ...options import problem

MODELS = "model"
"""Mark of a mapping whose keys are names of models."""

_Path = tuple[str, ...]


@dataclass(frozen=True, init=False)
class Dims:
    """Annotation that names the dimensions of a field, which is an array or a mapping to arrays.

    Args:
        names: names of the dimensions. Arrays may differ in the size of a common dimension.
        name: name of the variable, where "{0}" is the last key and "{1}" the one before. By default it consists of all
            fields and keys.
        kind: type of the numbers.
    """

    names: tuple[str, ...]
    name: str
    kind: type

    def __init__(self, *names: str, name: str = "", kind: type = float) -> None:
        for attribute, value in (("names", names), ("name", name), ("kind", kind)):
            object.__setattr__(self, attribute, value)


@dataclass(frozen=True, eq=False)
class Variable:
    """Array of the result, or the stacked arrays of all models.

    Args:
        dims: names of the dimensions.
        data: values of the array.
        path: fields and keys that lead to the array, without the name of the model.
    """

    dims: tuple[str, ...]
    data: np.ndarray
    path: _Path


@dataclass(frozen=True)
class Flat:
    """Result as variables and attributes.

    Args:
        variables: variables by name.
        models: names of the models, in the order of the dimension "model".
        attributes: everything else, as JSON types, with the shape of each array in its place.
        sizes: sizes of the arrays, by dimension.
    """

    variables: dict[str, Variable]
    models: list[str]
    attributes: dict[str, Any]
    sizes: Mapping[str, set[int]] = field(default_factory=dict)


def plain(value: Any) -> Any:
    """Return the value as JSON types: tuples and arrays become lists, NaN becomes None, and infinity a text."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value


def flatten(result: Any) -> Flat:
    """Return the variables and attributes of a dataclass.

    Raises:
        TypeError: when an array has other dimensions than its field declares.
    """
    arrays_by_path: dict[_Path, dict[str | None, np.ndarray]] = {}
    marks: dict[_Path, Dims] = {}
    models: dict[str, None] = {}

    def convert(value: Any, hint: Any, path: _Path, model: str | None) -> Any:
        mark, hint = _marked(hint)
        if value is None:
            return None
        if isinstance(value, Mapping):
            within = Annotated[np.ndarray, mark] if isinstance(mark, Dims) else (*get_args(hint), Any, Any)[1]
            if mark == MODELS:
                models.update(dict.fromkeys(value))
                return {key: convert(item, within, path, key) for key, item in value.items()}
            return {str(key): convert(item, within, (*path, str(key)), model) for key, item in value.items()}
        if isinstance(mark, Dims):
            array: np.ndarray = np.asarray(value, mark.kind)
            if array.ndim != len(mark.names):
                raise TypeError(f"{'.'.join(path)} must have the dimensions {mark.names}, got the shape {array.shape}")
            arrays_by_path.setdefault(path, {})[model] = array
            marks[path] = mark
            return list(array.shape)
        if is_dataclass(value) and not isinstance(value, type):
            hints = _hints(type(value))
            return {name: convert(getattr(value, name), hint, (*path, name), model) for name, hint in hints.items()}
        return plain(value)

    attributes = convert(result, type(result), (), None)
    sizes: dict[str, set[int]] = {}
    for path, arrays in arrays_by_path.items():
        for array in arrays.values():
            for name, size in zip(marks[path].names, array.shape, strict=True):
                sizes.setdefault(name, set()).add(size)
    variables: dict[str, Variable] = {}
    for path, arrays in arrays_by_path.items():
        mark = marks[path]
        name = mark.name.format(*reversed(path)) if mark.name else " ".join(path)
        name = " ".join(path) if name in variables else name
        shape = tuple(max(sizes[each]) for each in mark.names)
        padded = {model: _padded(array, shape) for model, array in arrays.items()}
        if None in padded:
            variables[name] = Variable(mark.names, padded[None], path)
        else:
            absent = np.full(shape, math.nan)
            data = np.stack([padded.get(model, absent) for model in models])
            variables[name] = Variable((MODELS, *mark.names), data, path)
    return Flat(variables, list(models), attributes, sizes)


def unflatten(kind: Any, record: Flat) -> Any:
    """Return the dataclass of type `kind` from its variables and attributes.

    Raises:
        TypeError, ValueError: when a field is missing, or has another type or shape.
    """
    variables = {each.path: each for each in record.variables.values()}

    def convert(value: Any, hint: Any, path: _Path, model: str | None) -> Any:
        mark, hint = _marked(hint, value)
        label = ".".join(path) or "the result"
        if value is None and hint is NoneType:
            return None
        if isinstance(mark, Dims) and not isinstance(value, Mapping):
            return _array(value, mark, variables.get(path), record.models.index(model) if model else None, label)
        arguments = get_args(hint)
        if isinstance(mark, Dims) or get_origin(hint) in (dict, Mapping):
            if not isinstance(value, Mapping):
                raise TypeError(f"{label} must be an object, got {type(value).__name__}")
            within = Annotated[np.ndarray, mark] if isinstance(mark, Dims) else arguments[1]
            of_models = mark == MODELS
            return {
                key: convert(item, within, path if of_models else (*path, key), key if of_models else model)
                for key, item in value.items()
            }
        if is_dataclass(hint):
            hints = _hints(hint)  # type: ignore[arg-type]
            # older files of a result have fewer fields
            optional = set() if path else {each.name for each in fields(hint) if each.default is not MISSING}
            if not isinstance(value, Mapping) or not hints.keys() - optional <= value.keys() <= hints.keys():
                raise TypeError(f"{label} must have the fields {', '.join(hints)}")
            present = ((name, within) for name, within in hints.items() if name in value)
            return hint(**{name: convert(value[name], within, (*path, name), model) for name, within in present})  # type: ignore[operator]
        if get_origin(hint) in (list, tuple):
            if not isinstance(value, list):
                raise TypeError(f"{label} must be a list, got {type(value).__name__}")
            each = arguments if arguments[1:] and arguments[1] is not Ellipsis else arguments[:1] * len(value)
            if len(each) != len(value):
                raise ValueError(f"{label} must have {len(each)} entries, got {len(value)}")
            entries = [convert(item, within, path, model) for item, within in zip(value, each, strict=True)]
            return tuple(entries) if get_origin(hint) is tuple else entries
        if hint is float and (value is None or value in ("inf", "-inf")):
            return float(value or "nan")
        if (error := problem(label, value, hint)) is not None:
            raise error
        return value

    return convert(record.attributes, kind, (), None)


def _array(shape: Any, mark: Dims, variable: Variable | None, model_index: int | None, label: str) -> np.ndarray:
    if variable is None or variable.dims != ((MODELS, *mark.names) if model_index is not None else mark.names):
        raise ValueError(f"{label} has no values with dimensions {mark.names}")
    if not isinstance(shape, list) or len(shape) != len(mark.names) or not all(type(size) is int for size in shape):
        raise ValueError(f"{label} must have a shape of {len(mark.names)} whole numbers")
    if 0 in shape and min(shape) == 0:  # nested lists in JSON lose the other sizes
        return np.zeros(shape, mark.kind)
    data = variable.data if model_index is None else variable.data[model_index]
    if data.ndim != len(shape) or not all(0 < size <= most for size, most in zip(shape, data.shape, strict=True)):
        raise ValueError(f"{label} must have the shape {shape}, but its variable has {data.shape}")
    data = data[tuple(map(slice, shape))]
    array: np.ndarray = data.astype(mark.kind)
    if mark.kind is not float and (array != data).any():
        raise ValueError(f"{label} must have whole numbers")
    return array


def _padded(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if array.shape == shape:
        return array
    padded = np.full(shape, math.nan)
    padded[tuple(map(slice, array.shape))] = array
    return padded


def _marked(hint: Any, value: Any = True) -> tuple[Any, Any]:
    """Return the mark of a type (`Dims` or `MODELS`), and the type without it (NoneType if the value is None)."""
    mark = None
    while True:
        if get_origin(hint) in (Union, UnionType) and NoneType in get_args(hint):
            if value is None:
                return None, NoneType
            hint = next(each for each in get_args(hint) if each is not NoneType)
        elif get_origin(hint) is Annotated and isinstance(hint.__metadata__[0], Dims | str):
            mark, hint = hint.__metadata__[0], hint.__origin__
        else:
            return mark, hint


@cache
def _hints(kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {each.name: hints[each.name] for each in fields(kind) if each.init}
