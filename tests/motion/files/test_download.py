"""Downloads from a local server: files are cached, and files with a wrong checksum are deleted."""

import hashlib
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from typing import ClassVar

import pytest

from dvae.cli import main
from dvae.motion.files import download

pytest.importorskip("pooch", reason="pooch is not installed")

FILES = {"02/02.asf": b"a skeleton", "02/02_01.amc": b"a motion"}


class Quiet(SimpleHTTPRequestHandler):
    asked: ClassVar = []

    def log_message(self, *_):
        self.asked.append(self.path)


@pytest.fixture
def url(tmp_path, monkeypatch):
    for name, content in FILES.items():
        (tmp_path / "there" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "there" / name).write_bytes(content)
    checksums = {name: hashlib.sha256(content).hexdigest() for name, content in FILES.items()}
    monkeypatch.setitem(download.COLLECTIONS, "cmu", ("http://127.0.0.1:1/", checksums))
    Quiet.asked.clear()
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path / "there")))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


def test_files_are_downloaded_once_to_the_path_of_their_address(url, tmp_path, capsys):
    assert main(["data", "get", "cmu", "--out", str(tmp_path / "here"), "--url", url]) == 0
    assert "2 files of cmu" in capsys.readouterr().err
    for name, content in FILES.items():
        assert (tmp_path / "here" / name).read_bytes() == content
    n_requests = len(Quiet.asked)
    download.get("cmu", tmp_path / "here", url)
    assert len(Quiet.asked) == n_requests == 2


def test_a_file_with_a_wrong_checksum_is_deleted(url, tmp_path):
    (tmp_path / "there" / "02" / "02_01.amc").write_bytes(b"something else")
    with pytest.raises(ValueError, match=r"02_01\.amc: the downloaded file differs from the expected one"):
        download.get("cmu", tmp_path / "here", url)
    assert not (tmp_path / "here" / "02" / "02_01.amc").exists()


def test_a_missing_file_is_an_error_with_its_address(url, tmp_path):
    (tmp_path / "there" / "02" / "02_01.amc").unlink()
    with pytest.raises(OSError, match=r"02_01\.amc cannot be downloaded"):
        download.get("cmu", tmp_path / "here", url)
    with pytest.raises(OSError, match=r"127\.0\.0\.1:1/02/02\.asf cannot be downloaded"):
        download.get("cmu", tmp_path / "nothing")
    with pytest.raises(ValueError, match="no collection 'cm'; known: cmu"):
        download.get("cm", tmp_path)


def test_checksums_of_the_real_files_are_right(shared):
    for name, digest in download.COLLECTIONS["cmu"][1].items():
        file = shared(f"cmu_raw/asfamc/{name.partition('/')[2]}")
        assert hashlib.sha256(file.read_bytes()).hexdigest() == digest
