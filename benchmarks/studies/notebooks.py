"""Run notebooks and store them with their outputs; `make notebooks` runs all.

Stored outputs depend only on the run: they contain no times, versions or progress bars.
"""

import base64
import io
import os
import re
from pathlib import Path

import nbformat
import tyro
from jupyter_client.manager import KernelManager
from nbclient import NotebookClient
from PIL import Image

ROOT = Path(__file__).parents[2]
# numbers of three digits: training steps, but not the steps of sequences
SHARED = re.compile(
    r"(\b(?:steps|particles|samples|fitting|warm_up)=|\b(?:Stage|draw)\(|\"warm_up\": )(\d{3,}|(?<=samples=)\d\d)"
)
CLIPS, FEWEST = re.compile(r"(\bclips=)(\d{2,})"), 0.35  # at least this share of clips, so that no split is empty
SEEDS = re.compile(r"(\bseeds=)(\d+)")
TEXTS = ("text/plain", "text/html", "text/latex")


CLEAR = "%reset -f\nimport matplotlib.pyplot, pyro\nmatplotlib.pyplot.close('all')\npyro.clear_param_store()"
"""Code that clears a kernel before the next notebook."""
SHORT = """
from functools import partial
from dvae.models.motion import energies
from dvae.motion.metric_models.pose_prior import fit_pose_prior
energies.fit_pose_prior = partial(fit_pose_prior, steps={steps})
%reset -f"""
"""Code that shortens the fit of pose priors, whose steps no notebook sets."""


def kernel() -> KernelManager:
    """Start a kernel that runs notebooks one after the other."""
    manager = KernelManager(kernel_name="python3")
    variables = {"PYTHONPATH": str(ROOT), "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    env = {**os.environ, **variables, "PYTHONWARNINGS": "ignore:IProgress not found"}  # tqdm misses ipywidgets
    manager.start_kernel(env=env, cwd=str(ROOT))
    return manager


def execute(path: Path, share: float = 1.0, on: KernelManager | None = None) -> nbformat.NotebookNode:
    """Run a notebook from top to bottom, and remove outputs that vary between runs.

    Args:
        path: the notebook.
        share: fraction of training steps, particles, samples and seeds, and of at least a third of the simulated clips;
            it changes only numbers and pictures.
        on: kernel to clear and use; None starts a new one.
    """
    notebook = nbformat.read(path, as_version=4)
    sources = [cell.source for cell in notebook.cells]
    for cell in notebook.cells:
        for pattern, part in ((SHARED, share), (SEEDS, share), (CLIPS, max(share, FEWEST))):
            cell.source = pattern.sub(
                lambda match, part=part: f"{match[1]}{max(int(part * int(match[2])), 2)}", cell.source
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
            if "image/png" in output.get("data", {}):
                output["data"]["image/png"] = _small(output["data"]["image/png"])
    return notebook


def check(path: Path, on: KernelManager) -> None:
    """Run a notebook on a small share of its work and compare the outputs of each cell with the stored ones.

    Raises:
        AssertionError: the outputs of a cell differ.
    """
    stored, run = nbformat.read(path, as_version=4), execute(path, share=0.02, on=on)
    code = ([cell for cell in each.cells if cell.cell_type == "code"] for each in (stored, run))
    for before, now in zip(*code, strict=True):
        assert reproducible_outputs(before) == reproducible_outputs(now), (
            f"{now.source}\n\noutputs differ from the stored ones; run `make notebooks`"
        )


def _small(picture: str) -> str:
    """Return a PNG in base64 with 256 colours, which is about a third as large."""
    file = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(picture))) as image:
        image.convert("RGB").quantize(256).save(file, format="png", optimize=True)
    return base64.encodebytes(file.getvalue()).decode()


def _kept(outputs: list[nbformat.NotebookNode]) -> list[nbformat.NotebookNode]:
    """Return outputs without progress bars, with consecutive text of a stream joined."""
    joined: list[nbformat.NotebookNode] = []
    for output in outputs:
        data = output.get("data", {})
        if "application/vnd.jupyter.widget-view+json" in data:
            continue
        if joined and output.output_type == "stream" and output.name == joined[-1].get("name"):
            joined[-1].text += output.text
        else:
            joined.append(output)
    return joined


def reproducible_outputs(cell: nbformat.NotebookNode) -> list[tuple[str, dict[str, str]]]:
    """Return the reproducible part of a cell's outputs: their kinds, and texts without rounding-dependent numbers.

    Figures count as present or absent. Texts keep words and whole numbers, except percentages. Tables may be
    sorted by their numbers and keep only words, without fingerprints.
    """
    outputs = []
    for output in cell.get("outputs", []):
        data = dict(output.get("data", {}))
        if "text" in output:
            data["text/plain"] = output["text"]
        if len(data) > 1:
            data["text/plain"] = ""  # pages show the richer format
        texts = {kind: _stable(text) if kind in TEXTS else "" for kind, text in data.items()}
        outputs.append((output.get("name") or output["output_type"], texts))
    return outputs


def _stable(text: str) -> str:
    text = re.sub('src="data:[^"]*"', "", text)  # a picture
    if "<pre" in text or "━" in text:
        # numbers change the notes of a table and the mark of lower bounds; ETS is missing without statsmodels
        plain = re.sub(r"<[^>]*>|, at least|\bETS\b", "", text)
        rows = [line for line in plain.splitlines() if re.search("[│┃]", line)]
        return " ".join(sorted(re.findall(r"\b[^\W\d_]{2,}\b", " ".join(rows))))
    text = re.sub(r"\d+(?= \w+ windows)|(?<=at training step )\d+.*", "#", text)  # they depend on the share of the work
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
