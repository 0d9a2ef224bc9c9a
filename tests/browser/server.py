"""A viewer in a process of its own."""

import os
import re
import shutil
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.viewer.scenes import free_port

OWN = "from normlift_ns.cli.start import view; view()"
STOCK = "import sys; from nerfstudio.scripts.viewer.run_viewer import entrypoint; sys.exit(entrypoint())"
PATIENCE = 600.0
"""Seconds after which a state that is waited for does not come any more, on a machine with much else to do."""


class Server:
    """A viewer of one run, always at the same port; its output goes to the end of `log`."""

    def __init__(self, program: str, config: Path, log: Path, *, cwd: Path | None = None) -> None:
        port = str(free_port())
        place = ["--port", port]
        if "nerfstudio" in program:
            place = ["--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", port]
            place += ["--viewer.max-num-display-images", "0"]  # no training cameras in front of the scene
        self._words = [sys.executable, "-W", "ignore", "-c", program, "--load-config", str(config), *place]
        self._log, self._cwd, self._flags = log, cwd, ()
        self.process: subprocess.Popen[bytes] | None = None
        self.address = f"http://127.0.0.1:{port}"
        self.config = config

    def start(self, *flags: str, **environment: str) -> None:
        """Starts it, unless it runs with these flags; returns when it answers."""
        if self.alive() and flags == self._flags:
            return
        self.stop()
        self._flags = flags
        environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), **environment}
        with self._log.open("a") as file:
            words = [*self._words, *flags]
            self.process = subprocess.Popen(words, stdout=file, stderr=file, cwd=self._cwd, env=environment)
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                return urllib.request.urlopen(self.address, timeout=5).close()
            except OSError:
                assert self.alive() and time.monotonic() < deadline, f"it does not answer: {self.said()[-3000:]}"
                time.sleep(0.1)

    def stop(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(timeout=30)
            except subprocess.TimeoutExpired:
                self.kill()

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    def alive(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def said(self) -> str:
        return self._log.read_text(errors="replace") if self._log.exists() else ""

    @contextmanager
    def running(self, *flags: str) -> Iterator[str]:
        """Its address; afterwards it is stopped, and has printed no traceback."""
        try:
            self.start(*flags)
            yield self.address
        finally:
            self.stop()
        assert faults(self.said()) == []


def copied(config: Path, folder: Path) -> Path:
    """config.yml of a copy of a run, with all runs beside it."""
    shutil.copytree(config.parents[3], folder / "outputs")
    return folder / "outputs" / config.relative_to(config.parents[3])


def faults(log: str) -> Sequence[str]:
    return re.findall(r"Traceback \(most recent call last\):\n(?:[ \t].*\n|\n)*.*", log)
