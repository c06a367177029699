"""House style of figures, and figures that a notebook displays even if pyplot is not imported."""

from io import BytesIO
from typing import Any

from cycler import cycler
from matplotlib import rc_context
from matplotlib.artist import allow_rasterization
from matplotlib.backend_bases import RendererBase
from matplotlib.figure import Figure
from typing_extensions import override

WIDTH = 7.0
"""Width of a page in inches; a wider figure would be shown smaller, with smaller letters."""

COLOURS = ["#3f90da", "#ffa90e", "#bd1f01", "#94a4a2", "#832db6", "#a96b59", "#e76300", "#b9ac70", "#717581", "#92dadd"]
"""Ten colours that colour-blind readers can distinguish (Petroff, arXiv:2107.02270)."""

STYLE: Any = {
    "axes.labelsize": 9,
    "axes.prop_cycle": cycler(color=COLOURS),
    "axes.titlesize": 9,
    "figure.labelsize": 9,
    "figure.titlesize": 9,
    "font.size": 9,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "lines.markersize": 5,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}
"""Settings of matplotlib: sizes in points, at the width of a page."""


class Picture(Figure):
    """Matplotlib figure in the house style that displays itself as PNG."""

    @allow_rasterization
    @override
    def draw(self, renderer: RendererBase) -> None:
        with rc_context(STYLE):  # matplotlib looks up "C0", and makes ticks, only now
            super().draw(renderer)

    def _repr_png_(self) -> bytes:
        file = BytesIO()
        self.savefig(file, format="png")
        return file.getvalue()
