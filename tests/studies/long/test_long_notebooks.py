"""The longer notebooks reproduce their stored outputs; tests/docs checks the others."""

from pathlib import Path

import pytest

from benchmarks.studies import notebooks

NOTEBOOKS = sorted((Path(__file__).parents[3] / "notebooks").glob("*.ipynb"))


@pytest.fixture(scope="module")
def one_kernel():
    manager = notebooks.kernel()
    yield manager
    manager.shutdown_kernel(now=True)


@pytest.mark.parametrize("path", NOTEBOOKS[4:], ids=lambda path: path.stem)
@pytest.mark.filterwarnings("ignore")  # warnings of the kernel, unrelated to the notebooks
@pytest.mark.timeout(1200)
def test_a_run_reproduces_the_stored_outputs(path, one_kernel):
    notebooks.check(path, one_kernel)
