"""nerfstudio's own commands on a lifted run, as a user starts them, on the CPU."""

from __future__ import annotations

import json
import os
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
from plyfile import PlyData

from normlift_ns import open_run, open_scene
from normlift_ns.options import SourceOptions, SplatOptions
from normlift_ns.scenes.splat import Splat
from tests.scenes.made import ply_columns, write_ply

pytestmark = pytest.mark.slow

BIN = Path(sys.executable).parent
ENVIRONMENT = os.environ | {"CUDA_VISIBLE_DEVICES": ""}
SECONDS = 300
"""Until a command must have done its work; importing nerfstudio takes 20 of them."""


@pytest.fixture(scope="module")
def stranger(little: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of a lifted run of a PLY file, where no run of nerfstudio ever existed."""
    from normlift_ns.scripts.lift import NormLift  # noqa: PLC0415

    folder = tmp_path_factory.mktemp("stock")
    shutil.copytree(little.parents[4] / "room", folder / "room")
    ply = write_ply(folder / "splat.ply", ply_columns(Splat(**open_scene(little).parameters)))
    world = little.parent / "dataparser_transforms.json"
    cameras = SplatOptions(transforms=folder / "room", world_transform=world, rasterize_mode="classic")
    source = SourceOptions(encoder="colour", region_count=64)
    options = {"timestamp": "t", "queries": ("red",), "source": source, "output_dir": folder / "outputs"}
    config = NormLift(load_ply=ply, splat=cameras, **options).main().config
    ply.unlink()  # it is not needed any more
    return config


def test_ns_render_draws_reliability_and_relevancy(stranger, tmp_path):
    names = ("rgb", "reliability", "relevancy_0")
    flags = ("dataset", "--load-config", stranger, "--output-path", "out", "--image-format", "png", "--split", "test")
    words = [str(BIN / "ns-render"), *map(str, flags), "--rendered-output-names", *names]
    how = {"env": ENVIRONMENT, "capture_output": True, "text": True, "timeout": SECONDS}
    done = subprocess.run(words, cwd=tmp_path, check=False, **how)
    assert done.returncode == 0, done.stdout + done.stderr
    for name in names:
        pictures = sorted((tmp_path / "out" / "test" / name).iterdir())
        assert len(pictures) == 2
        assert all(np.ptp(np.asarray(Image.open(path).convert("RGB"))) > 50 for path in pictures), name
    rendered = np.asarray(Image.open(tmp_path / "out" / "test" / "rgb" / "0006.png").convert("RGB")).astype(float)
    photo = np.asarray(Image.open(stranger.parents[4] / "room" / "images" / "0006.png").convert("RGB"))
    assert np.abs(rendered - photo).mean() < 3


def test_ns_export_and_ns_eval(stranger, nerfstudio, ns_export, monkeypatch, tmp_path):
    """In this process."""
    from nerfstudio.scripts.eval import ComputePSNR  # noqa: PLC0415

    from normlift_ns.method_configs.normlift import normlift_method  # noqa: PLC0415

    monkeypatch.setitem(nerfstudio.all_methods, "normlift", normlift_method.config)
    ns_export.ExportGaussianSplat(load_config=stranger, output_dir=tmp_path).main()
    open_run(stranger).export(tmp_path / "ours.ply")
    theirs, ours = (PlyData.read(tmp_path / name)["vertex"] for name in ("splat.ply", "ours.ply"))
    for name in (p.name for p in theirs.properties):
        assert np.array_equal(theirs[name], ours[name]), name
    ComputePSNR(stranger, output_path=tmp_path / "eval.json").main()
    assert json.loads((tmp_path / "eval.json").read_text())["results"]["psnr"] > 25


def test_ns_viewer_answers(stranger, tmp_path):
    assert b"<html" in viewer_page(stranger, cwd=tmp_path, log=tmp_path / "log")


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
