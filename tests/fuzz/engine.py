"""Fuzzing with a time limit: hypothesis draws examples, at least one, until a test's share of the time is over.

All tests of this directory together take DVAE_FUZZ_SECONDS (15 by default), in proportion to their shares.
DVAE_FUZZ_SEED (0) determines the examples and their order; time determines their number.

    def test_sums_are_symmetric():
        fuzz(lambda pair: check(*pair), st.tuples(st.integers(), st.integers()), seconds=5)

A check that may be killed, hang or take all memory runs in a separate process:

    @limited(5)
    def test_files_are_read_or_refused(tmp_path):
        with Isolated(read, tmp_path) as isolated:  # read(example, tmp_path), a function of a module
            fuzz(isolated, files(), seconds=5)
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import pytest
from hypothesis import HealthCheck, given, seed, settings
from hypothesis.strategies import SearchStrategy

Example = TypeVar("Example")

SECONDS = float(os.environ.get("DVAE_FUZZ_SECONDS", "15"))
"""Seconds for all tests together."""

SEED = int(os.environ.get("DVAE_FUZZ_SEED", "0"))

EXPECTED = (ValueError, OSError, RuntimeError, FloatingPointError)
"""Exceptions that the command line reports as errors; it reports any other as a bug."""

HANG, LARGEST = 60.0, 2**30
"""Time limit of a call in seconds, and its memory limit in bytes."""

_BATCH = 50
_SHRINKING = 20.0


def scaled(seconds: float) -> float:
    """Return a share of a minute, scaled to the time of this run."""
    return seconds * SECONDS / 60


def limited(seconds: float) -> Callable[[Any], Any]:
    """Return a decorator that marks a test as slow and sets its timeout."""
    return lambda test: pytest.mark.slow(pytest.mark.timeout(300 + scaled(seconds))(test))


def fuzz(check: Callable[[Example], None], examples: SearchStrategy[Example], seconds: float) -> None:
    """Try examples until the time is over.

    Args:
        check: function that raises if an example violates a property.
        examples: strategy of the examples. Their `repr` is printed, and must distinguish them.
        seconds: share of the default minute.
    """
    end = time.monotonic() + scaled(seconds)
    failed: set[str] = set()
    shrunk_by = float("inf")
    count = 0

    def attempt(example: Example) -> None:
        nonlocal shrunk_by, count
        now = time.monotonic()
        if (now > end and count and not failed) or (now > shrunk_by and repr(example) not in failed):
            return
        count += 1
        try:
            check(example)
        except Exception:
            failed.add(repr(example))
            shrunk_by = min(shrunk_by, now + _SHRINKING)
            raise

    batch = 0
    while not count or time.monotonic() < end:
        search = settings(
            max_examples=_BATCH,
            derandomize=False,
            database=None,
            deadline=None,
            print_blob=True,
            report_multiple_bugs=False,
            suppress_health_check=list(HealthCheck),
        )(given(examples)(attempt))
        seed(SEED * 1_000_003 + batch)(search)()
        batch += 1
    print(f"{count} examples in {scaled(seconds):.0f} s, DVAE_FUZZ_SEED={SEED}")


class Isolated:
    """A check in a separate process, which may fail, die or hang without ending the test.

    In addition to the check, a call must not hang, take more than `LARGEST` bytes, end by a signal, raise an
    exception other than `EXPECTED`, or open a file for writing outside its directory.

    Args:
        check: `check(example, directory)`, importable by its name, as it is sent through a pipe.
        directory: the only directory that the check may write to.
    """

    def __init__(self, check: Callable[[Any, Path], None], directory: Path):
        self._check, self._directory = check, directory.resolve()
        self._process: Any = None
        self._pipe: Any = None

    def __enter__(self) -> Isolated:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def __call__(self, example: Any) -> None:
        if self._process is None:
            self._start()
        self._pipe.send(example)
        try:
            if not self._pipe.poll(HANG):
                self._stop()
                raise AssertionError(f"hangs: no answer in {HANG:g} s")
            failure = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join(10)
            code = self._process.exitcode
            self._stop()
            raise AssertionError(f"the process died with exit code {code}, a signal where it is negative") from None
        if failure is not None:
            raise AssertionError(failure)

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, child_pipe = context.Pipe()
        self._process = context.Process(target=_serve, args=(child_pipe, self._check, self._directory), daemon=True)
        self._process.start()
        child_pipe.close()
        if not self._pipe.poll(120) or self._pipe.recv() != "ready":
            self._stop()
            raise AssertionError("the process that checks did not start")

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process.close()
            self._pipe.close()
            self._process = None


def _serve(pipe: Any, check: Callable[[Any, Path], None], directory: Path) -> None:
    sys.dont_write_bytecode = True
    pipe.send("ready")
    is_watched = False
    while True:
        try:
            example = pipe.recv()
        except EOFError:
            return
        if not is_watched:  # only from here on, because the start of a process opens files
            _bound_memory()
            _watch(directory)
            is_watched = True
        failure = None
        try:
            check(example, directory)
        except EXPECTED as error:
            failure = None if str(error) else f"{type(error).__name__} without a word\n{traceback.format_exc()}"
        except BaseException:
            failure = traceback.format_exc()
        pipe.send(failure)


def _bound_memory() -> None:
    """Limit further memory to `LARGEST` bytes; a larger request is a MemoryError."""
    if not sys.platform.startswith("linux"):  # other systems do not enforce this limit
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + LARGEST
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _watch(directory: Path) -> None:
    """Raise an error for each write outside a directory and for each start of a process."""
    changes = {"os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod"}
    runs = {"os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "socket.connect", "ctypes.dlopen"}
    writing = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND

    def is_outside(path: Any) -> bool:
        if not isinstance(path, str | bytes | os.PathLike):
            return False
        real = os.path.realpath(os.fsdecode(path))
        return real != os.devnull and os.path.commonpath([real, directory]) != str(directory)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in runs:
            raise AssertionError(f"runs something: {event} {arguments}")
        if event == "open" and arguments[2] & writing and is_outside(arguments[0]):
            raise AssertionError(f"writes outside its directory: {arguments[0]}")
        if event in changes and any(map(is_outside, arguments)):
            raise AssertionError(f"changes something outside its directory: {event} {arguments}")

    sys.addaudithook(hook)
