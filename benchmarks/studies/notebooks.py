"""Runs notebooks and stores them with what they show; `make notebooks` does so for all.

What is stored depends on the run alone: no times, no versions, no progress. A figure of plotly is stored as a still, of
an animation its last frame, as these are large and hosts that show notebooks do not play or turn them.
"""

import base64
import html
import io
import os
import re
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import tyro
from jupyter_client.manager import KernelManager
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from nbclient import NotebookClient
from PIL import Image

ROOT = Path(__file__).parents[2]
PLOTLY = "application/vnd.plotly.v1+json"
# sequences have fewer steps than training
SHARED = re.compile(
    r"(\b(?:steps|particles|samples|fitting|warm_up)=|\b(?:Stage|draw)\(|\"warm_up\": )(\d{3,}|(?<=samples=)\d\d)"
)
CLIPS, FEWEST = re.compile(r"(\bclips=)(\d{2,})"), 0.35  # a share of them, so that every split has some
SEEDS = re.compile(r"(\bseeds=)(\d+)")
LIGHT = np.array([-0.5, -0.6, 0.63])  # towards it, from the left, above and in front
TEXTS = ("text/plain", "text/html", "text/latex")


CLEAR = "%reset -f\nimport matplotlib.pyplot, pyro\nmatplotlib.pyplot.close('all')\npyro.clear_param_store()"
"""What a kernel is told before another notebook."""
SHORT = """
from functools import partial
from dvae.models.motion import energies
from dvae.motion.judges.pose_prior import fit_pose_prior
energies.fit_pose_prior = partial(fit_pose_prior, steps={steps})
%reset -f"""
"""And where it trains less: methods that fit a pose prior first do not tell its steps."""


def kernel() -> KernelManager:
    """A kernel that has not begun, for one notebook after the other."""
    found = KernelManager(kernel_name="python3")
    own = {"PYTHONPATH": str(ROOT), "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    env = {**os.environ, **own, "PYTHONWARNINGS": "ignore:IProgress not found"}  # tqdm misses ipywidgets
    found.start_kernel(env=env, cwd=str(ROOT))
    return found


def execute(path: Path, share: float = 1.0, on: KernelManager | None = None) -> nbformat.NotebookNode:
    """A notebook run from top to bottom, without what varies.

    Args:
        path: the notebook.
        share: of the steps of training, of particles, samples and seeds, and of simulated clips a third at least; fewer
            change no more than numbers and pictures.
        on: a kernel, which is cleared before; one of its own without.
    """
    notebook = nbformat.read(path, as_version=4)
    sources = [cell.source for cell in notebook.cells]
    for cell in notebook.cells:
        for pattern, part in ((SHARED, share), (SEEDS, share), (CLIPS, max(share, FEWEST))):
            cell.source = pattern.sub(
                lambda found, part=part: f"{found[1]}{max(int(part * int(found[2])), 2)}", cell.source
            )
    short = SHORT.format(steps=max(int(1000 * share), 2)) if share < 1 else ""
    notebook.cells.insert(0, nbformat.v4.new_code_cell(CLEAR + short))
    manager = on or kernel()
    client = NotebookClient(notebook, km=manager, timeout=1200, record_timing=False)
    try:
        client.execute()
    finally:
        client.kc.stop_channels()
        if on is None:
            manager.shutdown_kernel(now=True)
    del notebook.cells[0]
    code = (cell for cell in notebook.cells if cell.cell_type == "code")
    for count, cell in enumerate(code, 1):
        cell.execution_count = count
        for output in cell.outputs:
            if "execution_count" in output:
                output.execution_count = count
    notebook.metadata.language_info = {"name": "python"}
    for cell, source in zip(notebook.cells, sources, strict=True):
        cell.source = source
        if "outputs" in cell:
            cell.outputs = _kept(cell.outputs)
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "text/plain" in data:
                data["text/plain"] = re.sub(r" at 0x[0-9a-f]+", "", data["text/plain"])
            if PLOTLY in data:
                still, what = _still(data[PLOTLY]), "play" if data[PLOTLY].get("frames") else "turn"
                output["data"] = {"image/png": still, "text/plain": f"a still; run the cell to {what} it"}
            if "image/png" in output.get("data", {}):
                output["data"]["image/png"] = _small(output["data"]["image/png"])
    return notebook


def check(path: Path, on: KernelManager) -> None:
    """Run a notebook on a small share of its work and compare what each cell shows with what is stored.

    Raises:
        AssertionError: a cell shows something else.
    """
    stored, run = nbformat.read(path, as_version=4), execute(path, share=0.02, on=on)
    code = ([cell for cell in each.cells if cell.cell_type == "code"] for each in (stored, run))
    for before, now in zip(*code, strict=True):
        assert shown(before) == shown(now), f"{now.source}\n\nshows other things than are stored; run `make notebooks`"


def _small(picture: str) -> str:
    """A PNG in base64 with 256 colours, a third as large."""
    file = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(picture))) as image:
        image.convert("RGB").quantize(256).save(file, format="png", optimize=True)
    return base64.encodebytes(file.getvalue()).decode()


def _kept(outputs: list[nbformat.NotebookNode]) -> list[nbformat.NotebookNode]:
    """Outputs without progress and the script that plays animations; what was printed is one, however it came."""
    whole: list[nbformat.NotebookNode] = []
    for output in outputs:
        data = output.get("data", {})
        script = "PlotlyConfig" in data.get("text/html", "") and PLOTLY not in data
        if script or "application/vnd.jupyter.widget-view+json" in data:
            continue
        if whole and output.output_type == "stream" and output.name == whole[-1].get("name"):
            whole[-1].text += output.text
        else:
            whole.append(output)
    return whole


def _still(figure: Any) -> str:
    """Draw a figure from the front, of an animation the last frame, as a PNG in base64."""
    scene = figure["layout"]["scene"]
    width, height = (np.ptp(scene[axis]["range"]) for axis in ("xaxis", "zaxis"))
    still = Figure(figsize=(9, min(9 * height / width, 6)), dpi=72, layout="constrained")
    ax = still.subplots()
    for trace in figure["frames"][-1]["data"] if figure.get("frames") else figure["data"]:
        places = [_numbers(trace[axis]) for axis in "xyz"]
        if trace["type"] == "mesh3d":
            ax.add_collection(_shaded(trace, np.stack(places, -1)))
        elif trace.get("name") != "floor":
            ax.plot(places[0], places[2], color=trace["line"]["color"], linewidth=1.8)
    for label in scene["annotations"]:
        ax.text(label["x"], label["z"], html.unescape(label["text"]), ha="center", parse_math=False)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.axis("off")
    file = io.BytesIO()
    still.savefig(file, format="png")
    return base64.encodebytes(file.getvalue()).decode()


def _shaded(mesh: Any, places: np.ndarray) -> PolyCollection:
    """The triangles of a mesh (V, 3) that face the viewer, the nearest last, by how the light falls on them."""
    faces = np.stack([_numbers(mesh[corner]) for corner in "ijk"], -1).astype(int)
    first, second, third = places[faces].swapaxes(0, 1)
    normals = np.cross(second - first, third - first)
    smooth = np.zeros_like(places)
    np.add.at(smooth, faces, normals[:, None])
    smooth /= np.linalg.norm(smooth, axis=-1, keepdims=True)
    seen = np.flatnonzero(normals[:, 1] < 0)  # y goes away from the viewer
    seen = seen[np.argsort(-places[faces[seen], 1].mean(-1))]
    bright = 0.6 + 0.4 * (smooth[faces[seen]].mean(1) @ LIGHT).clip(0)
    colours = bright.round(2)[:, None] * to_rgb(mesh["color"])
    return PolyCollection(places[faces[seen]][..., [0, 2]], facecolors=colours, edgecolors=colours, linewidths=0.4)


def _numbers(values: Any) -> np.ndarray:
    """An array as plotly writes it, in base64 or as a list."""
    if "bdata" in values:
        return np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"])
    return np.array(values, float)


def shown(cell: nbformat.NotebookNode) -> list[tuple[str, dict[str, str]]]:
    """What a cell shows, as any run of it must: kinds of output, and their texts without what arithmetic decides.

    Figures are there or not. Texts have their words and whole numbers, but for shares; of a table, which may order its
    rows by their numbers, the words alone, among which no fingerprint is.
    """
    found = []
    for output in cell.get("outputs", []):
        data = dict(output.get("data", {}))
        if "text" in output:
            data["text/plain"] = output["text"]
        if len(data) > 1:
            data["text/plain"] = ""  # pages show what is richer
        texts = {kind: _stable(text) if kind in TEXTS else "" for kind, text in data.items()}
        found.append((output.get("name") or output["output_type"], texts))
    return found


def _stable(text: str) -> str:
    if "<pre" in text or "━" in text:
        return " ".join(sorted(re.findall(r"\b[^\W\d_]{2,}\b", re.sub("<[^>]*>", "", text))))
    return " ".join(re.sub(r"[-+]?(\d*\.\d+|\d+(?=e[-+]\d|%))(e[-+]?\d+)?", "#", text).split())


def main(files: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    """Run notebooks and store them.

    Args:
        files: the notebooks.
    """
    for file in files:
        nbformat.write(execute(file), file)
        print(f"stored {file}, {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
