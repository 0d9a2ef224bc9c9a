"""nerfstudio's own commands on a lifted run, as a user starts them, on the CPU."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.plain_room import plain_room
from normlift_ns import open_scene
from normlift_ns.demo import write_capture, write_splatfacto_run
from normlift_ns.options import SourceOptions, SplatOptions
from normlift_ns.scenes.splat import Splat
from normlift_ns.scripts.lift import NormLift
from tests.scenes.made import ply_columns, write_ply

pytestmark = pytest.mark.slow

BIN = Path(sys.executable).parent
ENVIRONMENT = os.environ | {"CUDA_VISIBLE_DEVICES": ""}
SECONDS = 300
"""Until a command must have done its work; importing nerfstudio takes 20 of them."""


@pytest.fixture(scope="module", params=["run", "ply"])
def lifted(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of a lifted run: of a splatfacto run, and of a PLY file, where no such run ever existed."""
    folder = tmp_path_factory.mktemp("stock")
    room = plain_room(4000)
    write_capture(room, folder / "room", views=4, held_out=2, width=80, height=60)
    trained = write_splatfacto_run(room, folder / "room", folder / "outputs")
    source = SourceOptions(encoder="colour", region_count=64)
    if request.param == "run":
        return NormLift(trained, timestamp="t", queries=("red",), source=source).main().config
    ply = write_ply(folder / "splat.ply", ply_columns(Splat(**open_scene(trained).parameters)))
    cameras = SplatOptions(
        transforms=folder / "room",
        world_transform=trained.parent / "dataparser_transforms.json",
        rasterize_mode="classic",
    )
    options = {"timestamp": "t", "queries": ("red",), "source": source, "output_dir": folder / "outputs"}
    config = NormLift(load_ply=ply, splat=cameras, **options).main().config
    ply.unlink()
    shutil.rmtree(trained.parent)  # neither of them is needed any more
    return config


def run(command: str, *flags: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    words = [str(BIN / command), *map(str, flags)]
    return subprocess.run(words, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=SECONDS, check=False)


def test_ns_render_draws_reliability_and_relevancy(lifted, tmp_path):
    names = ("rgb", "reliability", "relevancy_0")
    flags = ("dataset", "--load-config", lifted, "--output-path", "out", "--image-format", "png", "--split", "test")
    done = run("ns-render", *flags, "--rendered-output-names", *names, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    for name in names:
        pictures = sorted((tmp_path / "out" / "test" / name).iterdir())
        assert len(pictures) == 2
        assert all(np.ptp(np.asarray(Image.open(path).convert("RGB"))) > 50 for path in pictures), name
    rendered = np.asarray(Image.open(tmp_path / "out" / "test" / "rgb" / "0004.png").convert("RGB")).astype(float)
    photo = np.asarray(Image.open(lifted.parents[4] / "room" / "images" / "0004.png").convert("RGB"))
    assert np.abs(rendered - photo).mean() < 3


def test_ns_eval_measures_the_pictures(lifted, tmp_path):
    done = run("ns-eval", "--load-config", lifted, "--output-path", tmp_path / "eval.json", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    results = json.loads((tmp_path / "eval.json").read_text())
    assert results["method_name"] == "normlift"
    assert results["results"]["psnr"] > 35  # the photographs are pictures of these very Gaussians
    assert "lpips" in results["results"] or "LPIPS is left out" in done.stderr


def test_ns_export_writes_the_gaussians(lifted, tmp_path):
    done = run("ns-export", "gaussian-splat", "--load-config", lifted, "--output-dir", "out", cwd=tmp_path)
    missing = re.search(r"(lib[\w.+-]+): cannot open shared object file", done.stderr)
    if missing is not None:
        pytest.skip(f"open3d, which ns-export imports, needs the system library {missing[1]}")
    assert done.returncode == 0, done.stdout + done.stderr
    header = (tmp_path / "out" / "splat.ply").read_bytes()[:2000].split(b"end_header")[0].decode()
    count = re.search(r"element vertex (\d+)", header)
    assert count is not None
    assert 3500 < int(count[1]) <= 4000  # all but the faintest


def test_ns_viewer_answers(lifted, tmp_path):
    assert b"<html" in viewer_page(lifted, cwd=tmp_path, log=tmp_path / "log")


def viewer_page(config: Path, *, cwd: Path, log: Path) -> bytes:
    """The page that ns-viewer serves, if it still runs two seconds later."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    flags = ("--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", port)
    words = [str(BIN / "ns-viewer"), "--load-config", str(config), *map(str, flags)]
    with log.open("w") as output:
        viewer = subprocess.Popen(words, cwd=cwd, env=ENVIRONMENT, stdout=output, stderr=subprocess.STDOUT)
    try:
        page = first_page(f"http://127.0.0.1:{port}/", viewer)
        time.sleep(2)
        assert viewer.poll() is None, log.read_text()
        return page
    finally:
        viewer.send_signal(signal.SIGINT)
        try:
            viewer.wait(timeout=20)
        except subprocess.TimeoutExpired:
            viewer.kill()
            viewer.wait()


def first_page(address: str, viewer: subprocess.Popen[bytes]) -> bytes:
    """What a server answers at last; b"" if it stopped or the time is over."""
    end = time.monotonic() + SECONDS
    while viewer.poll() is None and time.monotonic() < end:
        try:
            with urllib.request.urlopen(address, timeout=5) as answer:
                return answer.read()
        except (urllib.error.URLError, OSError):
            time.sleep(0.5)
    return b""
