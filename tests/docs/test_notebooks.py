"""The notebooks are stored with their outputs, and running them gives the same outputs."""

import re
from pathlib import Path

import nbformat
import pytest
from rich import console

from benchmarks.studies import notebooks
from dvae.inference.evaluation import result

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


@pytest.fixture(scope="module")
def one_kernel():
    manager = notebooks.kernel()
    yield manager
    manager.shutdown_kernel(now=True)


@pytest.mark.parametrize("path", NOTEBOOKS[:4], ids=lambda path: path.stem)  # the others: `make studies`
# The transport of the kernel emits warnings that are unrelated to the notebooks.
@pytest.mark.filterwarnings("ignore")
@pytest.mark.timeout(1200)
@pytest.mark.slow
def test_running_a_notebook_gives_the_stored_outputs(path, one_kernel):
    notebooks.check(path, one_kernel)


def _is_picture(output):
    data = output.get("data", {})
    return "image/png" in data or "data:image/gif;base64," in data.get("text/html", "")


@each_notebook
def test_a_notebook_is_stored_completely_with_its_figures(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    assert any(_is_picture(output) for output in outputs)
    assert not [output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"]
    for cell in code:
        is_plot = any(
            word in cell.source for word in ("plt.show()", "animate(test", "animate(skeleton", "surfaces(body")
        )
        assert not is_plot or any(map(_is_picture, cell.outputs))
    assert str(ROOT) not in path.read_text(encoding="utf-8")


@each_notebook
def test_every_training_of_a_notebook_can_be_shortened(path):
    code = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    trained = [source for source in code if re.search(r"\.fit\(", source)]
    assert all(notebooks.SHARED.search(source) for source in trained)


def test_notebooks_are_small():
    sizes = [path.stat().st_size for path in NOTEBOOKS]
    assert max(sizes) < 1e6
    assert sum(sizes) < 4e6


def test_tables_of_outputs_are_compared_by_words_in_any_order_of_rows():
    stable = notebooks._stable
    table = "<pre>┃ name ┃ bound ┃\n│ first │ 1.5 ± 0.1 │\n│ second │ 1 % │</pre>"
    assert stable(table) == stable("<pre>┃ name ┃ bound ┃\n│ second │ 2 % │\n│ first │ 11.5 ± 0.1 │</pre>")
    assert stable(table) != stable(table.replace("second", "third"))
    assert stable("<pre>data 1ab457e0c8bf</pre>") == stable("<pre>data 04cdf7e0c8ff</pre>")  # a fingerprint of motion


@pytest.mark.parametrize("widgets", [None, "installed"])
def test_a_notebook_has_a_progress_bar_only_if_widgets_are_installed(monkeypatch, widgets):
    monkeypatch.setattr(console, "_is_jupyter", lambda: True)
    monkeypatch.setattr(result, "find_spec", {"ipywidgets": widgets}.get)
    assert result.progress_bar(True).disable == (widgets is None)
    assert result.progress_bar(False).disable
