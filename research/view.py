"""Times and sizes of ns-normlift-view: its start, its page in Chromium, an answer, and a query over HTTP.

    python -m research.view               lifts the fox capture first
    python -m research.view --load-config outputs/room/normlift/demo/config.yml

Chromium renders in software (SwiftShader), on the same cores as the server, in a window of 1300 x 800 pixels. Each load
uses a new browser with an empty cache. A press is Enter in the search box, with the text encoder already loaded. A
frame counts when WebGL has finished it. The page renders a slow frame without outlines first, and adds them when it is
idle; both times are measured. Client programs use the protocol of sessions, or HTTP.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.request import urlopen

import torch
from websockets.sync.client import ClientConnection, connect

from normlift_ns.core.partition import spatial_order
from normlift_ns.data.splat import SplatParameters
from normlift_ns.data.spz import encode_spz
from normlift_ns.server.app import PAGE_FOLDER
from research.report import RESULTS, Report
from tests.browser.page import CALM
from tests.browser.person import chromium
from tests.captures import SHARED, trained_state

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

PATIENCE = 180
"""Longest wait in seconds."""
COLOURS = ("orange", "crimson", "teal", "purple", "dark green", "sky blue", "yellow", "brown", "grey")
BUNDLE = PAGE_FOLDER / "assets"
REPEATS, SIZE = 5, (1300, 800)
NAMES = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")
_PROGRAM = "from normlift_ns.cli.start import view; view()"
_FULL = "performance.getEntriesByName('picture').length > 0"
_PICTURES = """() => {
  const start = performance.getEntriesByName("press")[0]?.startTime ?? 0, outlined = performance.now() - start;
  const of = (...names) => performance.getEntriesByType("measure").find(({name}) => names.includes(name))?.duration;
  return {colors: of("colors"), first: of("coarse", "picture"), full: of("picture"), outlined};
}"""
"""Script that returns milliseconds since the page was opened, or since a press, as measured by the page."""
_RENDERER = """() => {
  const gl = page.scene.renderer.getContext(), info = gl.getExtension("WEBGL_debug_renderer_info");
  return gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
}"""


@dataclass(frozen=True)
class ViewServer:
    """Viewer of a run in a separate process."""

    process: subprocess.Popen[str]
    port: int
    start_seconds: float
    """Seconds until the server printed its address."""

    def worked(self) -> float:
        """Return the processor time of the server in seconds."""
        ticks = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")

    def resident(self) -> int:
        """Return the memory of the server in bytes."""
        pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE")

    def run(self) -> str:
        """Return the id of the run."""
        with urlopen(f"http://127.0.0.1:{self.port}/api/runs") as answer:
            return json.load(answer)["runs"][0]["id"]


@contextmanager
def served(config: Path) -> Iterator[ViewServer]:
    """Start a viewer of a run, and stop it at the end of the context."""
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
        yield ViewServer(process, port, time.perf_counter() - start)
    finally:
        process.terminate()
        process.wait(timeout=30)


class Client:
    """Page without a browser, which uses the protocol of sessions and counts bytes."""

    def __init__(self, line: ClientConnection) -> None:
        self._line, self._seq, self.bytes = line, 0, 0
        self.act("greet", {"token": "benchmark"})
        self.drawn = self.codes()

    def act(self, action: str, value: Any) -> None:
        self._seq += 1
        self._line.send(json.dumps({"action": action, "value": value, "seq": self._seq}))

    def codes(self) -> int:
        """Wait for the colors after the last action, and return their number."""
        while True:
            raw = self._line.recv(timeout=PATIENCE)
            self.bytes += len(raw)
            if isinstance(raw, bytes):
                (length,) = struct.unpack("<I", raw[:4])
                if json.loads(raw[4 : 4 + length])["seq"] == self._seq:
                    return len(raw) - 4 - length

    def rest(self, quiet: float = 0.5) -> None:
        """Read messages until none has arrived for `quiet` seconds."""
        while True:
            try:
                self.bytes += len(self._line.recv(timeout=quiet))
            except TimeoutError:
                return

    def ask(self, prompt: str) -> tuple[float, int]:
        """Return the seconds from the press to the answer, and the bytes of all messages until then."""
        self.rest()
        self.bytes, start = 0, time.perf_counter()
        self.act("ask", {"line": prompt})
        self.codes()
        return time.perf_counter() - start, self.bytes


def seconds_to_load(port: int) -> tuple[float, float]:
    """Return the seconds until a page in a new browser shows the scene, coarsely and at full resolution."""
    with chromium() as browser:
        page = opened(browser, port)
        until(page, _FULL)
        times = page.evaluate(_PICTURES)
    return times["first"] / 1e3, times["full"] / 1e3


def until(page: Page, expression: str) -> None:
    """Wait until an expression is true in the page, whose policy for scripts forbids Playwright's own function."""
    deadline = time.monotonic() + PATIENCE
    while not page.evaluate(expression):
        if time.monotonic() > deadline:
            raise TimeoutError(f"after {PATIENCE} s, the page does not fulfill: {expression}")
        time.sleep(0.2)  # to look takes time from the renderer


def opened(browser: Browser, port: int) -> Page:
    """Return the page in a new tab."""
    page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    page.set_default_timeout(1e3 * PATIENCE)  # software WebGL takes seconds per frame of a large scene
    page.goto(f"http://127.0.0.1:{port}", wait_until="domcontentloaded")
    return page


class PressTimes(NamedTuple):
    """Seconds from each press of Enter to several events."""

    colors: list[float]
    """Seconds until the colors are passed to WebGL."""
    first: list[float]
    """Seconds until the first changed image is rendered."""
    full: list[float]
    """Seconds until the image at full resolution is rendered."""
    outlined: list[float]
    """Seconds until the image also has its outline."""
    untouched: list[float]
    """Duration of a frame at full resolution without any change."""
    renderer: str


def pressed(port: int, prompts: Sequence[str]) -> PressTimes:
    """Return the times in Chromium of all prompts except the first."""
    found: list[dict[str, float]] = []
    with chromium() as browser:
        page = opened(browser, port)
        until(page, f"Boolean(window.page) && ({CALM})()")
        box = page.get_by_role("searchbox")
        for prompt in prompts:
            box.fill(prompt)
            page.evaluate("performance.clearMarks(), performance.clearMeasures()")
            box.press("Enter")
            until(page, f"{_FULL} && ({CALM})()")
            found.append(page.evaluate(_PICTURES))
            page.wait_for_timeout(1500)
        untouched = [page.evaluate("page.scene.render(true)") for _ in range(6)]
        name = page.evaluate(_RENDERER)
    columns = {kind: [one[kind] / 1e3 for one in found[1:]] for kind in ("colors", "first", "full", "outlined")}
    return PressTimes(**columns, untouched=[one / 1e3 for one in untouched[1:]], renderer=name)


def known_prompt(port: int, run: str, prompt: str, arrays: str) -> list[float]:
    """Return the seconds of some queries over one HTTP connection, after a first one."""
    line, seconds = HTTPConnection("127.0.0.1", port, timeout=PATIENCE), []
    body = json.dumps({"texts": [prompt], "arrays": arrays})
    for _ in range(51):
        start = time.perf_counter()
        line.request("POST", f"/api/runs/{run}/query", body)
        answer = line.getresponse()
        content = answer.read()
        seconds.append(time.perf_counter() - start)
        if answer.status != 200:
            raise RuntimeError(f"the server responded with status {answer.status}: {content[:200]!r}")
    line.close()
    return seconds[1:]


def million_bytes(share: float) -> float:
    """Return the bytes of the page's data per 1,000,000 Gaussians of SH degree 3.

    The Gaussians are those of the castle capture, of degree 1. Coefficients of degrees 2 and 3 are those of degree 1 of
    other Gaussians, multiplied by a factor.
    """
    splat, g = trained_state("castle"), torch.Generator().manual_seed(0)
    values = {name: splat[f"gauss_params.{name}"].detach().float() for name in NAMES}
    count = len(values["means"])
    others = torch.randint(0, count, (count, 4), generator=g)
    higher = share * values["features_rest"][others].flatten(1, 2)
    values["features_rest"] = torch.cat([values["features_rest"], higher], dim=1)
    order = spatial_order(values["means"])
    rows = SplatParameters(**{name: value[order] for name, value in values.items()})
    return 1e6 * len(encode_spz(rows, position_step=2**-13)) / count


def add_spread(report: Report, key: str, values: Sequence[float], unit: str) -> None:
    """Add the median as `key`, and the smallest and largest value."""
    report.add(key, statistics.median(values), f"{unit}, median of {len(values)}")
    report.add(f"{key}.least", min(values), unit)
    report.add(f"{key}.most", max(values), unit)


def add_view(report: Report, config: Path, prompts: Sequence[str] = COLOURS, *, picture: bool = True) -> None:
    """Add the metrics of a lifted run.

    Args:
        picture: True to measure Chromium too, which takes minutes for large scenes without a GPU.
    """
    start = time.perf_counter()
    with served(config) as server:
        report.add("start_s", server.start_seconds, "s until the page can be opened")
        port, run = server.port, server.run()
        with connect(f"ws://127.0.0.1:{port}/api/runs/{run}/session", max_size=None) as line:
            client = Client(line)
            shown = time.perf_counter() - start
            report.add("drawn_s", shown, "s from the start until its Gaussians are in a page that is open")
            report.add("drawn_cpu_s", server.worked(), "s of processor time of the server until then")
            client.ask(prompts[0])
            asked = [client.ask(prompt) for prompt in prompts[1:]]
        report.add("drawn", client.drawn, "Gaussians")
        add_spread(report, "press_to_bytes_s", [x[0] for x in asked], "s")
        report.add("bytes_per_answer", 1, "byte per drawn Gaussian")
        rest = max(x[1] for x in asked) - client.drawn
        report.add("other_bytes_per_answer", rest, "bytes of state and headers")
        for arrays in ("none", "safetensors"):
            add_spread(report, f"http_{arrays}_s", known_prompt(port, run, prompts[0], arrays), "s")
        with urlopen(f"http://127.0.0.1:{port}/api/runs/{run}/geometry") as answer:
            report.add("geometry_bytes_per_gaussian", len(answer.read()) / client.drawn, "bytes")
        report.add("bundle_bytes", sum(one.stat().st_size for one in BUNDLE.glob("*.gz")), "bytes, compressed")
        if picture and shutil.which("chromium"):
            loads = [seconds_to_load(port) for _ in range(REPEATS)]
            add_spread(report, "load_coarse_s", [one for one, _ in loads], "s")
            add_spread(report, "load_full_s", [one for _, one in loads], "s")
            times = pressed(port, prompts)
            for name, values in times._asdict().items():
                if name != "renderer":
                    key = "untouched_frame_s" if name == "untouched" else f"press_to_{name}_s"
                    add_spread(report, key, values, f"s, {times.renderer}")


def fox_run(folder: Path) -> Path:
    """Return the config.yml of the fox capture, lifted with colors from some of its views at half their size."""
    from normlift_ns.cli.lift import NormLift  # noqa: PLC0415
    from normlift_ns.options import LiftOptions, SourceOptions  # noqa: PLC0415

    source = SHARED / "captures" / "outputs" / "fox" / "splatfacto" / "run" / "config.yml"
    options, colour = LiftOptions(max_views=12, lift_downscale=2), SourceOptions(encoder="color")
    run = NormLift(source, source=colour, lift=options, output_dir=folder, timestamp="view").main()
    assert run is not None
    return run.config


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--load-config", type=Path, help="lifted run; by default the fox capture is lifted first")
    parser.add_argument("--prompts", nargs="+", default=COLOURS)
    parser.add_argument("--no-picture", action="store_true", help="do not measure Chromium")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    found = Report("view")
    with tempfile.TemporaryDirectory() as folder:
        run = arguments.load_config or fox_run(Path(folder))
        add_view(found, run, arguments.prompts, picture=not arguments.no_picture)
    for share in (0.5, 1.0):
        unit = f"bytes of 1,000,000 Gaussians, SH degree 3; degrees 2, 3 have {share:g} times the values of degree 1"
        found.add(f"million_{share:g}_bytes", million_bytes(share), unit)
    found.write(arguments.output)
