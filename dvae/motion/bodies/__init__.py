"""Bodies with a surface: linear blend skinning, a low-polygon person, `smplx` files, and fitting of motion.

>>> person = dvae.motion.bodies.human()
>>> unturned = torch.eye(3).expand(2, 5, person.joints, 3, 3)
>>> vertices, joints = person(torch.zeros(2, person.parameters_of_shape), unturned, torch.zeros(2, 5, 3))
>>> people = dvae.motion.bodies.fit_to_body(dvae.motion.simulate(clips=2, frames=5), person)
>>> dvae.motion.bodies.shapes_of(people, person).shape
torch.Size([2, 8])
"""

from .fitting import betas, fit_to_body, retarget, shapes_of
from .lofted import MARKERS, SHAPE, human
from .measures import enclosed_volume, vertex_error
from .skinning import Body, BodySource
from .smplx import read_body, reopen_body

__all__ = [
    "MARKERS",
    "SHAPE",
    "Body",
    "BodySource",
    "betas",
    "enclosed_volume",
    "fit_to_body",
    "human",
    "read_body",
    "reopen_body",
    "retarget",
    "shapes_of",
    "vertex_error",
]
