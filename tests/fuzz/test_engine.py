import os
import signal
from pathlib import Path

import pytest
from hypothesis import strategies as st

from .engine import Isolated, fuzz


def faulty(example, directory):
    {
        "allocates": lambda: bytearray(2**32),
        "dies": lambda: os.kill(os.getpid(), signal.SIGSEGV),
        "is a bug": lambda: {}["nothing"],
        "refuses": lambda: int("nothing"),
        "runs": lambda: os.system("true"),
        "says nothing": lambda: exec("raise ValueError"),
        "writes here": lambda: (directory / "file").write_text(""),
        "writes there": lambda: (directory.parent / "file").write_text(""),
        "writes through a link": lambda: (directory / "link").write_text(""),
    }[example]()


def test_each_kind_of_failure_is_reported_and_the_next_example_runs(tmp_path):
    directory = tmp_path / "inside"
    directory.mkdir()
    (directory / "link").symlink_to(tmp_path / "target")
    messages = {
        "allocates": "MemoryError",
        "dies": "died with exit code -11",
        "is a bug": "KeyError",
        "runs": "runs something",
        "says nothing": "without a word",
        "writes there": "writes outside",
        "writes through a link": "writes outside",
    }
    with Isolated(faulty, directory) as isolated:
        for example, message in messages.items():
            if example == "allocates" and not Path("/proc/self/statm").exists():
                continue
            with pytest.raises(AssertionError, match=message):
                isolated(example)
        isolated("refuses")
        isolated("writes here")
    assert not (tmp_path / "file").exists()
    assert not (tmp_path / "target").exists()


def test_a_failing_example_is_found_and_printed():
    def check(number):
        assert number < 1000

    with pytest.raises(AssertionError) as failure:
        fuzz(check, st.integers(0, 10**6), seconds=5)
    assert "example=1000" in "".join(failure.value.__notes__)


def test_examples_are_the_same_in_every_run():
    def draw():
        examples = []
        fuzz(examples.append, st.integers(), seconds=2)
        return examples[:20]

    first, second = draw(), draw()
    shared = min(len(first), len(second))  # the number of examples depends on the machine
    assert second[:shared] == first[:shared]
    assert len(set(first[:shared])) > 3
