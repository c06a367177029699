"""Damage to bytes and to arrays: strategies that draw it and functions that apply it."""

import numpy as np
from hypothesis import strategies as st

places = st.floats(0, 1, exclude_max=True)
DTYPES = st.sampled_from(["f4", "f8", "f2", "i8", "u1", "U3", "S3", "?", "c8", "M8[D]"])
VALUES = st.sampled_from([0.0, 0.5, -1.0, 3.0, 99.0, 1e3, 1e-320, 1e300, np.nan, np.inf])


def edits(words=(), most=3):
    """Draw edits (place, number of removed bytes, inserted bytes); None removes as many bytes as are inserted.

    A place is a share of the length, or a negative number that counts from the end, where a zip has its directory.
    """
    put = st.binary(max_size=8) | st.sampled_from(words) if words else st.binary(max_size=8)
    counts = st.none() | st.integers(0, 40) | st.just(2**40)
    return st.lists(st.tuples(places | st.integers(-120, -1), counts, put), max_size=most)


def edited(content, changes):
    for place, count, put in changes:
        at = int(place * len(content)) if place >= 0 else max(0, len(content) + place)
        content = content[:at] + put + content[at + (len(put) if count is None else count) :]
    return content


def array_changes(names, lengths):
    """Draw changes of named arrays: replace or drop an array, fill it with a value, or change its type."""
    shapes = st.lists(lengths, max_size=5).filter(lambda shape: np.prod([max(n, 1) for n in shape]) < 10**6)
    numbers = st.integers(0, 9)
    one = st.one_of(
        st.tuples(st.just("put"), st.sampled_from(names), shapes, DTYPES),
        st.tuples(st.just("fill"), numbers, places, VALUES),
        st.tuples(st.just("cast"), numbers, places, DTYPES),
        st.tuples(st.just("drop"), numbers, places, VALUES),
    )
    return st.lists(one, max_size=3)


def changed(arrays, changes):
    arrays = dict(arrays)
    for kind, which, where, what in changes:
        names = sorted(arrays)
        if kind == "put":
            arrays[which] = np.zeros(where, what)
        elif not names:
            continue
        elif kind == "drop":
            del arrays[names[which % len(names)]]
        else:
            name = names[which % len(names)]
            array = arrays[name] = np.array(arrays[name])
            if kind == "fill" and array.size and array.dtype.kind == "f":
                with np.errstate(over="ignore"):
                    array.reshape(-1)[int(where * array.size) :] = what
            elif kind == "cast" and (array.dtype.kind in "fiub" or what[0] in "US"):
                with np.errstate(all="ignore"):
                    arrays[name] = array.astype(what)
    return arrays
