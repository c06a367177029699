"""Motion capture: skeletons, files, windows and protocols, and a simulator of people."""

from .data import Clip, MotionSet
from .formats import load, save
from .protocols import PROTOCOLS, Protocol, Windows, windows
from .simulate import simulate
from .skeleton import HUMAN36M, HUMAN36M_KEPT, HUMANEVA, WALKER, Skeleton, rotate_about_up

__all__ = [
    "HUMAN36M",
    "HUMAN36M_KEPT",
    "HUMANEVA",
    "PROTOCOLS",
    "WALKER",
    "Clip",
    "MotionSet",
    "Protocol",
    "Skeleton",
    "Windows",
    "load",
    "rotate_about_up",
    "save",
    "simulate",
    "windows",
]
