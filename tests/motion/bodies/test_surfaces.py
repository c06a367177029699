"""Pictures of bodies: side by side, upright and facing the viewer."""

import io

import numpy as np
import pytest
import torch
from PIL import Image

from dvae.motion.bodies import human
from dvae.motion.drawing.plot import surfaces

PERSON = human()


@pytest.mark.parametrize("up", ["y", "z"])
def test_bodies_are_drawn_side_by_side_upright_and_facing_the_viewer(up):
    """A drawn symmetric body has the body's height, and only triangles that face the viewer are drawn."""
    people = PERSON.at_rest(torch.eye(8)[:5])[0]
    heights = (people[..., 1].amax(1) - people[..., 1].amin(1)).numpy()
    if up == "z":
        people = people[..., [0, 2, 1]] * torch.tensor([1.0, -1, 1])
    (ax,) = surfaces(PERSON.faces, people, names=list("abcde"), up=up, title="a $y$").axes
    boxes = [np.concatenate([path.vertices for path in body.get_paths()]) for body in ax.collections]
    assert len(boxes) == 5
    np.testing.assert_allclose([np.ptp(box[:, 1]) for box in boxes], heights, rtol=2e-2)
    for i, box in enumerate(boxes):
        for other in boxes[:i]:
            assert ((box.min(0) > other.max(0)) | (box.max(0) < other.min(0))).any()
    assert [text.get_text() for text in ax.texts] == list("abcde")
    assert not any(text.get_parse_math() for text in ax.texts)
    with pytest.raises(ValueError, match="4 names for 5 bodies"):
        surfaces(PERSON.faces, people, names=list("abcd"))
    with pytest.raises(ValueError, match="a face refers to vertex"):
        surfaces(PERSON.faces, people[:, :9])
    with pytest.raises(ValueError, match='up is \'x\'; expected "y" or "z"'):
        surfaces(PERSON.faces, people, up="x")


def test_visible_triangles_are_drawn_from_back_to_front():
    square = np.array([[-1.0, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]])  # faces +z, towards the viewer
    roof = [[-0.5, 0.5, 1], [0.5, 0.5, 1], [0.5, 1, 0.2], [-0.5, 1, 0.2]]  # in front, turned to the light
    faces = np.array([[0, 1, 2], [0, 2, 3]])

    def middle(faces, vertices):
        """Return the colour slightly below the middle."""
        file = io.BytesIO()
        surfaces(faces, vertices).savefig(file, format="png")
        with Image.open(file) as image:
            return image.convert("RGB").getpixel((image.width // 2, round(0.65 * image.height)))

    behind, before = middle(faces, square), middle(faces, roof)
    both = np.concatenate([square, roof])
    assert (255, 255, 255) != behind != before != (255, 255, 255)
    assert middle(faces[:, ::-1], square) == (255, 255, 255)
    for order in ([faces, faces + 4], [faces + 4, faces]):
        assert middle(np.concatenate(order), both) == before
