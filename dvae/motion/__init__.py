"""Motion capture: skeletons, files, windows and protocols, and a simulator of people.

>>> people = dvae.motion.simulate(clips=4, frames=90)
>>> windows = dvae.motion.windows(people, dvae.motion.PROTOCOLS["simulated"], "train")
>>> windows.all()["x"].shape[1:]
torch.Size([75, 48])
"""

from . import bodies
from .data.clips import Clip, MotionSet
from .data.dataset import MotionData
from .data.exchange import ExchangedWindows
from .data.occlusion import occlude
from .data.protocols import PROTOCOLS, Poses, Protocol, Windows, windows
from .data.simulator import simulate
from .files import read_motion, read_paths, save, write_motion
from .forecasts import Forecasts, Imputed, is_forecasts
from .geometry.angles import AngleLimits, estimate_angle_limits
from .geometry.skeleton import HUMAN36M, HUMAN36M_KEPT, HUMANEVA, WALKER, Skeleton, rotate_about_up
from .geometry.views import Bones, Heading, Rotations
from .scoring.criticism import draw_traversal, statistics
from .scoring.metrics import several_futures
from .scoring.published import frames_of, published_windows
from .scoring.scores import displacements, scores
from .scoring.truths import PseudoTruths, WithPseudoTruths
from .segments.dataset import SegmentData
from .segments.embodied import Segments
from .segments.frames import TimedFrames
from .segments.gait import Cycles, gait_cycles, reference_cycles
from .segments.generation import generate
from .segments.interpolation import Interpolation, falls, interpolate, latent_map, transfer
from .segments.reconstruction import reconstruct_segments

__all__ = [
    "HUMAN36M",
    "HUMAN36M_KEPT",
    "HUMANEVA",
    "PROTOCOLS",
    "WALKER",
    "AngleLimits",
    "Bones",
    "Clip",
    "Cycles",
    "ExchangedWindows",
    "Forecasts",
    "Heading",
    "Imputed",
    "Interpolation",
    "MotionData",
    "MotionSet",
    "Poses",
    "Protocol",
    "PseudoTruths",
    "Rotations",
    "SegmentData",
    "Segments",
    "Skeleton",
    "TimedFrames",
    "Windows",
    "WithPseudoTruths",
    "bodies",
    "displacements",
    "draw_traversal",
    "estimate_angle_limits",
    "falls",
    "frames_of",
    "gait_cycles",
    "generate",
    "interpolate",
    "is_forecasts",
    "latent_map",
    "occlude",
    "published_windows",
    "read_motion",
    "read_paths",
    "reconstruct_segments",
    "reference_cycles",
    "rotate_about_up",
    "save",
    "scores",
    "several_futures",
    "simulate",
    "statistics",
    "transfer",
    "windows",
    "write_motion",
]
