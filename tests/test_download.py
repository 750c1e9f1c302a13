"""posekit download against a server of our own that speaks as the hub does."""

from __future__ import annotations

import hashlib
import io
import threading
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from posekit.datasets.download import download
from posekit.datasets.registry import DatasetInfo, dataset_info
from posekit.errors import InputError

INFO = DatasetInfo("toy", "Toy", (1,), archives=("toy_base.zip", "toy_models.zip"))
BASE = "/datasets/bop-benchmark/toy/resolve/main/"


def archive(**files: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as out:
        for name, data in files.items():
            out.writestr(name.replace("__", "/").replace("_dot_", "."), data)
    return buffer.getvalue()


class Hub(ThreadingHTTPServer):
    """files: by name. cut: close the connection after that many bytes of the next answer. stated: other hashes."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.stated: dict[str, str] = {}
        self.cut: int | None = None
        self.asked: list[tuple[str, str | None]] = []

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Hub

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def do_GET(self) -> None:
        self._answer(body=True)

    def _answer(self, body: bool) -> None:
        name = self.path.removeprefix(BASE)
        data = self.server.files.get(name)
        if data is None:
            self.send_response(404)
            self.send_header("X-Error-Code", "EntryNotFound")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        asked = self.headers.get("Range") if body else None
        if body:
            self.server.asked.append((name, asked))
        start = int(asked.removeprefix("bytes=").split("-")[0]) if asked else 0
        part = data[start:]
        self.send_response(206 if asked else 200)
        digest = self.server.stated.get(name, hashlib.sha256(data).hexdigest())
        self.send_header("X-Repo-Commit", "0" * 40)
        self.send_header("ETag", f'"{digest}"')
        self.send_header("X-Linked-Etag", f'"{digest}"')
        self.send_header("X-Linked-Size", str(len(data)))
        if asked:
            self.send_header("Content-Range", f"bytes {start}-{len(data) - 1}/{len(data)}")
        self.send_header("Content-Length", str(len(part)))
        self.end_headers()
        if body and self.server.cut is not None:
            self.wfile.write(part[: self.server.cut])
            self.server.cut = None
            self.close_connection = True
        elif body:
            self.wfile.write(part)

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def hub() -> Iterator[Hub]:
    server = Hub()
    server.files = {
        "toy_base.zip": archive(toy__dataset_info_dot_md=b"hello", toy__camera_dot_json=b"{}"),
        "toy_models.zip": archive(models__obj_000001_dot_ply=b"ply" * 100_000),
    }
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def test_archives_are_fetched_checked_and_unpacked_once(hub: Hub, tmp_path: Path) -> None:
    fetched = download(INFO, tmp_path, endpoint=hub.endpoint)
    assert fetched.archives == INFO.archives
    assert (tmp_path / "toy/dataset_info.md").read_text() == "hello"
    assert len((tmp_path / "toy/models/obj_000001.ply").read_bytes()) == 300_000
    assert not (tmp_path / ".archives").exists() or not list((tmp_path / ".archives").rglob("*.zip"))
    asked = len(hub.asked)
    assert download(INFO, tmp_path, endpoint=hub.endpoint).archives == ()
    assert len(hub.asked) == asked


def test_a_download_that_broke_off_goes_on(hub: Hub, tmp_path: Path) -> None:
    content = bytes(range(256)) * 100_000  # the hub's client keeps what it has in portions of 10 MB
    hub.files["toy_models.zip"] = archive(models__obj_000001_dot_ply=content)
    hub.cut = 21_000_000
    one = DatasetInfo("toy", "Toy", (1,), archives=("toy_models.zip",))
    fetched = download(one, tmp_path, endpoint=hub.endpoint)
    assert fetched.archives == ("toy_models.zip",)
    assert (tmp_path / "toy/models/obj_000001.ply").read_bytes() == content
    ranges = [r for _, r in hub.asked if r is not None]
    assert any(int(r.removeprefix("bytes=").split("-")[0]) > 0 for r in ranges)  # not from the start again


def test_a_damaged_archive_is_refused_and_not_kept(hub: Hub, tmp_path: Path) -> None:
    hub.stated["toy_base.zip"] = "a" * 64
    with pytest.raises(InputError, match=r"toy_base.zip is damaged: its SHA-256 is .* the hub states a{64}"):
        download(INFO, tmp_path, endpoint=hub.endpoint)
    assert not (tmp_path / "toy/dataset_info.md").exists()
    hub.stated.clear()
    assert download(INFO, tmp_path, endpoint=hub.endpoint).archives == INFO.archives


def test_what_is_no_archive_or_leads_out_of_the_folder(hub: Hub, tmp_path: Path) -> None:
    hub.files["toy_base.zip"] = b"not a zip"
    with pytest.raises(InputError, match=r"toy_base.zip is no ZIP archive"):
        download(INFO, tmp_path, endpoint=hub.endpoint)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as out:
        out.writestr("../escaped.txt", b"x")
    hub.files["toy_base.zip"] = buffer.getvalue()
    with pytest.raises(InputError, match="which leads out of it"):
        download(INFO, tmp_path / "b", endpoint=hub.endpoint)
    assert not list(tmp_path.rglob("escaped.txt"))


def test_a_hub_without_the_file_or_without_an_answer(hub: Hub, tmp_path: Path) -> None:
    del hub.files["toy_models.zip"]
    with pytest.raises(InputError, match=r"toy_models.zip of bop-benchmark/toy could not be fetched"):
        download(INFO, tmp_path, endpoint=hub.endpoint)
    assert (tmp_path / "toy/dataset_info.md").exists()  # what came before stays
    nobody = DatasetInfo("lost", "Lost", (1,))
    with pytest.raises(InputError, match="where Lost is to be had is not known"):
        download(nobody, tmp_path)
    assert dataset_info("lmo").archives == ("lmo_base.zip", "lmo_models.zip", "lmo_test_bop19.zip")
