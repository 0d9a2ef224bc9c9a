"""How long ns-normlift-view takes: from its start to its page, and from pressing Ask to the answer.

    python -m research.view --load-config outputs/room/normlift/demo/config.yml

`python -m research.latency` measures the same on the fox capture. The answer is timed by a client that speaks the
protocol of sessions, from the press to the last byte of the colors, least of 8 prompts after a first one (which loads
the text encoder). With Chromium installed, press_to_picture is timed in it until the picture changes; its unit names
what drew.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from websockets.sync.client import ClientConnection, connect

from research.report import RESULTS, Report
from tests.captures import SHARED

PATIENCE = 180
"""Seconds."""
COLOURS = ("orange", "crimson", "teal", "purple", "dark green", "sky blue", "yellow", "brown", "grey")
_PROGRAM = "from normlift_ns.cli.start import view; view()"
_FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@contextmanager
def served(config: Path) -> Iterator[tuple[int, float, Callable[[], tuple[float, float]]]]:
    """The port of a viewer of a run, the seconds until it said so, and what tells the seconds since its start and those
    that processors have worked for it.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    start = time.perf_counter()
    words = [sys.executable, "-c", _PROGRAM, "--load-config", str(config), "--port", str(port)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        said = next((line for line in process.stdout if f":{port}" in line), None)
        if said is None:
            raise RuntimeError(f"the viewer of {config} did not start")
        said_at = time.perf_counter() - start

        def spent() -> tuple[float, float]:
            ticks = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
            return time.perf_counter() - start, sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")

        yield port, said_at, spent
    finally:
        process.terminate()
        process.wait(timeout=30)


class Client:
    """A page without a browser: it knows the protocol of sessions, and counts bytes."""

    def __init__(self, line: ClientConnection) -> None:
        self._line, self._seq, self.bytes = line, 0, 0
        self.act("greet", {"token": "benchmark"})
        self.drawn = self.codes()

    def act(self, action: str, value: Any) -> None:
        self._seq += 1
        self._line.send(json.dumps({"action": action, "value": value, "seq": self._seq}))

    def codes(self) -> int:
        """Waits for the colors that answer the last action; how many there are."""
        while True:
            raw = self._line.recv(timeout=PATIENCE)
            self.bytes += len(raw)
            if isinstance(raw, bytes):
                (length,) = struct.unpack("<I", raw[:4])
                if json.loads(raw[4 : 4 + length])["seq"] == self._seq:
                    return len(raw) - 4 - length

    def rest(self, quiet: float = 0.5) -> None:
        """Reads what still comes, until nothing has for some seconds."""
        while True:
            try:
                self.bytes += len(self._line.recv(timeout=quiet))
            except TimeoutError:
                return

    def ask(self, prompt: str) -> tuple[float, int]:
        """Seconds from the press to the answer, and all bytes until then."""
        self.rest()
        self.bytes, start = 0, time.perf_counter()
        self.act("ask", {"line": prompt})
        self.codes()
        return time.perf_counter() - start, self.bytes


def pictured(port: int, prompts: Sequence[str]) -> tuple[float, str]:
    """Seconds from the press in Chromium until the picture changes, least of some, and the renderer's name."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415

    box: Any = {"x": 0, "y": 0, "width": 320, "height": 480}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=_FLAGS)
        page = browser.new_page(viewport={"width": 640, "height": 480})
        page.set_default_timeout(1e3 * PATIENCE)  # drawn in software a large scene takes seconds
        page.goto(f"http://127.0.0.1:{port}", wait_until="domcontentloaded")
        box_of_prompts = page.get_by_role("searchbox")
        box_of_prompts.wait_for()
        page.wait_for_timeout(5000)
        name = page.evaluate(
            "() => { const gl = document.createElement('canvas').getContext('webgl2');"
            "const e = gl.getExtension('WEBGL_debug_renderer_info');"
            "return gl.getParameter(e ? e.UNMASKED_RENDERER_WEBGL : gl.RENDERER); }"
        )
        seconds = []
        for prompt in prompts[:4]:
            box_of_prompts.fill(prompt)
            page.wait_for_timeout(3000)
            before, start = page.screenshot(clip=box), time.perf_counter()
            box_of_prompts.press("Enter")
            while page.screenshot(clip=box) == before and time.perf_counter() - start < PATIENCE:
                pass
            seconds.append(time.perf_counter() - start)
            page.wait_for_timeout(3000)
        browser.close()
    return min(seconds[1:]), name


def add_view(report: Report, config: Path, prompts: Sequence[str] = COLOURS, *, picture: bool = True) -> None:
    """Adds view.*: of a lifted run.

    Args:
        picture: time Chromium too, which takes minutes for large scenes without a GPU.
    """
    with served(config) as (port, seconds, spent):
        report.add("view.start_s", seconds, "s until the page can be opened")
        with urlopen(f"http://127.0.0.1:{port}/api/runs") as answer:
            run = json.load(answer)["runs"][0]["id"]
        with connect(f"ws://127.0.0.1:{port}/api/runs/{run}/session", max_size=None) as line:
            client = Client(line)
            shown, worked = spent()
            report.add("view.drawn_s", shown, "s from the start until its Gaussians are in a page that is open")
            report.add("view.drawn_cpu_s", worked, "s of processor time of the server until then")
            client.ask(prompts[0])
            asked = [client.ask(prompt) for prompt in prompts[1:]]
        report.add("view.drawn", client.drawn, "Gaussians")
        report.add("view.press_to_bytes_s", min(x[0] for x in asked), "s")
        report.add("view.bytes_per_answer", 1, "byte per drawn Gaussian")
        rest = max(x[1] for x in asked) - client.drawn
        report.add("view.other_bytes_per_answer", rest, "bytes of state and headers")
        if picture and shutil.which("chromium"):
            pressed, name = pictured(port, prompts)
            report.add("view.press_to_picture_s", pressed, f"s, {name}")


def fox_run(folder: Path) -> Path:
    """config.yml of the fox capture, lifted from some of its views at half their size, by colours."""
    from normlift_ns.cli.lift import NormLift  # noqa: PLC0415
    from normlift_ns.options import LiftOptions, SourceOptions  # noqa: PLC0415

    source = SHARED / "captures" / "outputs" / "fox" / "splatfacto" / "run" / "config.yml"
    options, colour = LiftOptions(max_views=12, lift_downscale=2), SourceOptions(encoder="color")
    run = NormLift(source, source=colour, lift=options, output_dir=folder, timestamp="view").main()
    assert run is not None
    return run.config


def add_fox_view(report: Report) -> None:
    """Adds view.*: of the fox capture, drawn whole."""
    with tempfile.TemporaryDirectory() as folder:
        add_view(report, fox_run(Path(folder)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--load-config", type=Path, help="lifted run; by default the fox capture is lifted first")
    parser.add_argument("--prompts", nargs="+", default=COLOURS)
    parser.add_argument("--no-picture", action="store_true", help="leave Chromium out")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    found = Report("view")
    if arguments.load_config is None:
        add_fox_view(found)
    else:
        add_view(found, arguments.load_config, arguments.prompts, picture=not arguments.no_picture)
    found.write(arguments.output)
