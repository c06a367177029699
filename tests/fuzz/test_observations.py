"""Untrusted files of observed segments are read, or are an error of one sentence."""

import warnings

import numpy as np
from hypothesis import strategies as st

from dvae.models.motion.motion_latent import MotionLatent
from dvae.motion import bodies, simulate
from dvae.motion.segments.completion import FRAMES, POINTS, SPOTS, SURFACES, TIMES
from dvae.motion.segments.embodied import SHAPE, SegmentSchema
from dvae.motion.segments.frames import TimedFrames
from dvae.motion.segments.recovery import LARGEST, MOST, read_seen

from .engine import Isolated, fuzz, limited
from .test_archives import byte_mutations, mutate_bytes, places

SHARE = 5

values = st.sampled_from([0.0, 0.5, -1.0, 3.0, 99.0, 1e3, 1e300, np.nan, np.inf])
lengths = st.sampled_from([0, 1, 2, 3, 16, 8, 100, MOST + 1])
shapes = st.lists(lengths, max_size=5).filter(lambda shape: np.prod([max(n, 1) for n in shape]) < 10**6)
dtypes = st.sampled_from(["f4", "f8", "f2", "i8", "u1", "U3", "S3", "?", "c8", "M8[D]"])
changes = st.one_of(
    st.tuples(st.just("put"), st.sampled_from([TIMES, FRAMES, SURFACES, POINTS, SPOTS, SHAPE, "x"]), shapes, dtypes),
    st.tuples(st.just("fill"), st.integers(0, 9), places, values),
    st.tuples(st.just("drop"), st.integers(0, 9), places, values),
    st.tuples(st.just("cast"), st.integers(0, 9), places, dtypes),
)
observations = st.tuples(
    st.sampled_from(
        [(SURFACES, TIMES), (POINTS, TIMES), (SPOTS, TIMES), (POINTS, SPOTS, FRAMES), (SPOTS, SHAPE, FRAMES)]
    ),
    st.lists(changes, max_size=3),
    st.lists(byte_mutations, max_size=2),
)


SKELETON = bodies.fit_to_body(simulate(clips=1, frames=30, seed=1), bodies.human()).skeleton
MODEL = MotionLatent(latent=2, widths=(4,)).build(SegmentSchema.from_data(TimedFrames(SKELETON), bodies.human())).eval()
"""The model is built at import, before time and memory are limited."""


def observed(names, many=2, moments=3):
    """Return the arrays of a valid file."""
    vertices = len(MODEL.body.template)
    spots = {SURFACES: (vertices, 3), POINTS: (5, 3), SPOTS: (16, 3)}
    arrays = {name: np.zeros((many, moments, *spots[name])) for name in names if name in spots}
    arrays |= {name: np.tile(np.arange(moments) / 30, (many, 1)) for name in names if name in (TIMES, FRAMES)}
    return arrays | ({SHAPE: np.zeros((many, 8))} if SHAPE in names else {})


def changed(arrays, changes):
    for kind, first, second, third in changes:
        names = sorted(arrays)
        if kind == "put":
            arrays[first] = np.zeros(second, third)
        elif not names:
            continue
        elif kind == "drop":
            del arrays[names[first % len(names)]]
        elif kind == "cast":
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # discarding the imaginary part warns
                arrays[names[first % len(names)]] = arrays[names[first % len(names)]].astype(third)
        elif (array := arrays[names[first % len(names)]]).size and array.dtype.kind == "f":
            with np.errstate(over="ignore"):
                array.reshape(-1)[int(second * array.size) :] = third
    return arrays


def read_changed(example, directory):
    names, changes, file_mutations = example
    path = directory / "seen.npz"
    np.savez_compressed(path, **changed(observed(names), changes))
    path.write_bytes(mutate_bytes(path.read_bytes(), file_mutations))
    try:
        observations_read = read_seen(path, MODEL)
    except ValueError as error:
        sentence = str(error)
        if not sentence.startswith(str(path)) or len(sentence) - len(str(path)) > 500 or not sentence.isprintable():
            raise AssertionError(sentence) from error
    else:
        if sum(value.nbytes for value in observations_read.values()) > 8 * LARGEST:
            raise AssertionError("more than may be read")
        places = [value for name, value in observations_read.items() if name in (SURFACES, POINTS, SPOTS)] or [
            *observations_read.values()
        ]
        if not any(value.isfinite().any() for value in places):
            raise AssertionError("no observations")
    if [p.name for p in directory.iterdir()] != ["seen.npz"]:
        raise AssertionError("reading left something behind")


def test_unchanged_files_are_read(tmp_path):
    for names in ((SURFACES, TIMES), (POINTS, SPOTS, FRAMES), (SPOTS, SHAPE, FRAMES)):
        np.savez(tmp_path / "seen.npz", **observed(names))
        assert read_seen(tmp_path / "seen.npz", MODEL).keys() == {*names}


@limited(SHARE)
def test_changed_observations_are_read_or_an_error(tmp_path):
    with Isolated(read_changed, tmp_path) as isolated:
        fuzz(isolated, observations, SHARE)
