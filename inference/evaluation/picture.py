"""Figures that a notebook displays even if pyplot is not imported."""

from io import BytesIO

from matplotlib.figure import Figure


class Picture(Figure):
    """Matplotlib figure that displays itself as PNG."""

    def _repr_png_(self) -> bytes:
        file = BytesIO()
        self.savefig(file, format="png")
        return file.getvalue()
