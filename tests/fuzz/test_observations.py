"""Files of what somebody has seen of segments: read, or refused in a sentence, whatever is in them."""

import numpy as np
from hypothesis import strategies as st

from dvae.models.motion.motion_latent import MotionLatent
from dvae.motion import bodies, simulate
from dvae.motion.segments.completion import FRAMES, POINTS, SPOTS, SURFACES, TIMES
from dvae.motion.segments.embodied import SHAPE, SegmentSchema
from dvae.motion.segments.frames import TimedFrames
from dvae.motion.segments.recovery import LARGEST, MOST, read_seen

from .damage import array_changes, changed, edited, edits
from .engine import Isolated, fuzz, limited

SHARE = 4
KINDS = [(SURFACES, TIMES), (POINTS, TIMES), (SPOTS, TIMES), (POINTS, SPOTS, FRAMES), (SPOTS, SHAPE, FRAMES)]
lengths = st.sampled_from([0, 1, 2, 3, 16, 8, 100, MOST + 1])
changes = array_changes([TIMES, FRAMES, SURFACES, POINTS, SPOTS, SHAPE, "x"], lengths)
observations = st.tuples(st.sampled_from(KINDS), changes, edits(most=2))

SKELETON = bodies.fitted(simulate(clips=1, frames=30, seed=1), bodies.human()).skeleton
MODEL = MotionLatent(latent=2, widths=(4,)).build(SegmentSchema.under(TimedFrames(SKELETON), bodies.human())).eval()
"""Made where a process begins, before its time and memory are watched."""


def seen(names, many=2, moments=3):
    """As a file has it."""
    vertices = len(MODEL.body.template)
    spots = {SURFACES: (vertices, 3), POINTS: (5, 3), SPOTS: (16, 3)}
    found = {name: np.zeros((many, moments, *spots[name])) for name in names if name in spots}
    found |= {name: np.tile(np.arange(moments) / 30, (many, 1)) for name in names if name in (TIMES, FRAMES)}
    return found | ({SHAPE: np.zeros((many, 8))} if SHAPE in names else {})


def read_changed(example, directory):
    names, changes, of_file = example
    path = directory / "seen.npz"
    np.savez_compressed(path, **changed(seen(names), changes))
    path.write_bytes(edited(path.read_bytes(), of_file))
    try:
        found = read_seen(path, MODEL)
    except ValueError as error:
        sentence = str(error)
        if not sentence.startswith(str(path)) or len(sentence) - len(str(path)) > 500 or not sentence.isprintable():
            raise AssertionError(sentence) from error
    else:
        if sum(value.nbytes for value in found.values()) > 8 * LARGEST:
            raise AssertionError("more than may be read")
        places = [value for name, value in found.items() if name in (SURFACES, POINTS, SPOTS)] or [*found.values()]
        if not any(value.isfinite().any() for value in places):
            raise AssertionError("nothing was seen")
    if [p.name for p in directory.iterdir()] != ["seen.npz"]:
        raise AssertionError("reading left something behind")


def test_what_is_not_changed_is_read(tmp_path):
    for names in KINDS:
        np.savez(tmp_path / "seen.npz", **seen(names))
        assert read_seen(tmp_path / "seen.npz", MODEL).keys() == {*names}


@limited(SHARE)
def test_changed_observations_are_read_or_refused(tmp_path):
    fuzz(Isolated(read_changed, tmp_path), observations, SHARE)
