"""Pictures of bodies: they are the bodies themselves, side by side, upright and towards the viewer."""

import numpy as np
import pytest
import torch

from dvae.motion.bodies import human
from dvae.motion.drawing.plot import save_html, surfaces

PERSON = human()


def meshes(figure):
    """Vertices (V, 3) and faces (F, 3) of each."""
    drawn = [trace for trace in figure.data if trace.type == "mesh3d"]
    return [(np.stack([m.x, m.y, m.z], -1), np.stack([m.i, m.j, m.k], -1)) for m in drawn]


@pytest.mark.parametrize("up", ["y", "z"])
def test_what_is_drawn_is_congruent_to_the_bodies_and_stands_apart(up):
    people = PERSON.at_rest(torch.eye(8)[:5])[0]
    if up == "z":
        people = people[..., [0, 2, 1]] * torch.tensor([1.0, -1, 1])
    drawn = meshes(surfaces(PERSON.faces, people, names=list("abcde"), up=up))
    assert len(drawn) == 5
    for (vertices, faces), body in zip(drawn, people, strict=True):
        assert (faces == PERSON.faces.numpy()).all()
        turned = torch.from_numpy(vertices - vertices[0])
        torch.testing.assert_close(turned.norm(dim=-1), (body - body[0]).norm(dim=-1), atol=1e-5, rtol=0)
    boxes = [(vertices.min(0), vertices.max(0)) for vertices, _ in drawn]
    for i, (low, high) in enumerate(boxes):
        for other_low, other_high in boxes[:i]:
            assert ((low > other_high) | (high < other_low)).any()


def test_the_viewer_sees_a_person_upright_and_from_the_front():
    """z is up and y goes away from the viewer: toes are nearer than heels, and the left side is on the right."""
    ((vertices, _),) = meshes(surfaces(PERSON.faces, PERSON.template))
    given = PERSON.template.numpy()
    np.testing.assert_allclose(vertices[:, 2] - vertices[:, 2].min(), given[:, 1] - given[:, 1].min(), atol=1e-6)
    assert np.corrcoef(vertices[:, 1], given[:, 2])[0, 1] < -0.999
    assert np.corrcoef(vertices[:, 0], given[:, 0])[0, 1] > 0.999


def test_a_name_is_text_and_a_page_needs_no_network(tmp_path):
    figure = surfaces(PERSON.faces, PERSON.template, names=["<b>$x$"], title="a $y$")
    assert [label.text for label in figure.layout.scene.annotations] == ["&lt;b&gt;&#36;x&#36;"]
    save_html(figure, tmp_path / "body.html")
    assert '<script src="http' not in (tmp_path / "body.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("faces", "vertices", "names", "message"),
    [
        (PERSON.faces, PERSON.template[:, :2], (), r"vertices \(P, V, 3\)"),
        (PERSON.faces[:, :2], PERSON.template, (), r"faces \(F, 3\)"),
        (PERSON.faces, PERSON.template.repeat(2, 1, 1), ("a",), "1 names for 2 bodies"),
        (PERSON.faces, PERSON.template * torch.inf, (), "cannot be drawn"),
        (PERSON.faces, PERSON.template[:9], (), "a face has corner"),
    ],
)
def test_what_cannot_be_drawn_is_refused(faces, vertices, names, message):
    with pytest.raises(ValueError, match=message):
        surfaces(faces, vertices, names=names)
