"""Figures have one style, which is legible at the width of a page and leaves matplotlib's settings as they are."""

import io

import matplotlib
import pytest
from matplotlib.text import Text

from dvae.inference.evaluation.picture import COLOURS, WIDTH
from dvae.inference.evaluation.result import new_figure, styled


@styled
def drawn(width):
    figure = new_figure(width, 3)
    panels = figure.subplots(1, 2)
    for panel in panels:
        panel.plot([0, 1], label="line")
        panel.set(title="title", xlabel="time (s)", ylabel="speed (m/s)")
        panel.legend()
    figure.suptitle("figure")
    return figure


@pytest.mark.parametrize("width", [4, 20])
def test_letters_are_legible_at_the_width_of_a_page(width):
    figure = drawn(width)
    figure.savefig(io.BytesIO())
    shown = WIDTH / max(WIDTH, figure.get_figwidth())
    assert min(text.get_fontsize() * shown for text in figure.findobj(Text)) >= 8


def test_titles_are_not_clipped():
    figure = drawn(20)
    figure.savefig(io.BytesIO())
    for text in (figure._suptitle, *(panel.title for panel in figure.axes)):
        box = text.get_window_extent().transformed(figure.transFigure.inverted())
        assert 0 <= box.y0 < box.y1 <= 1


def test_settings_of_matplotlib_stay_as_they_are():
    before = dict(matplotlib.rcParams)
    line = drawn(4).axes[0].lines[0]
    assert line.get_color() == COLOURS[0]
    assert dict(matplotlib.rcParams) == before
