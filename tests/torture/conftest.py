"""The server of commands, and the table of what was tried, which docs/reliability.md shows."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
INSTANTS = int(os.environ.get("NORMLIFT_TORTURE", "2"))
"""At which processes are killed, per command; make torture sets 40. With few, all else that is tried is short too."""
SHORT = INSTANTS < 10
ROW = "row of docs/reliability.md"
"""Under which a test keeps its rows; they reach the table from any process that runs tests."""
Record = Callable[[str, object, str], None]


class Server:
    """Runs jobs of tests/torture/server.py."""

    def __init__(self, folder: Path) -> None:
        self.log = folder / "server.log"
        one = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")}
        environment = os.environ | one | {"NUMBA_THREADING_LAYER": "workqueue", "CUDA_VISIBLE_DEVICES": ""}
        environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        with self.log.open("w") as log:
            words = [sys.executable, "-m", "tests.torture.server"]
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": log}
            self.process = subprocess.Popen(words, cwd=folder, env=environment, text=True, **pipes)
        assert self.process.stdout is not None
        if self.process.stdout.readline() != "ready\n":
            pytest.fail(self.log.read_text())

    def run(self, *jobs: dict[str, Any]) -> list[tuple[int, int]]:
        """Exit codes, minus signals, and numbers of accesses of jobs that run at the same time."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        filled = [{"log": str(self.log), **job, "words": list(map(str, job["words"]))} for job in jobs]
        self.process.stdin.write(json.dumps(filled) + "\n")
        self.process.stdin.flush()
        return [(code, count) for code, count in json.loads(self.process.stdout.readline())]

    def command(self, *words: object) -> int:
        """Runs one undisturbed command, which must succeed; returns the number of its accesses below outputs/."""
        ((code, count),) = self.run({"words": words, "folder": "outputs"})
        assert code == 0, self.log.read_text()[-3000:]
        return count


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    found = Server(tmp_path_factory.mktemp("server"))
    yield found
    found.process.stdin.close()  # type: ignore[union-attr]
    found.process.wait(60)


@pytest.fixture
def record(request: pytest.FixtureRequest) -> Record:
    return lambda what, tried, outcome: request.node.user_properties.append((ROW, (what, str(tried), outcome)))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    ended = [x for outcome in ("passed", "failed") for x in terminalreporter.getreports(outcome) if x.when == "call"]
    rows = [row for report in ended for name, row in report.user_properties if name == ROW]
    if len(rows) > 0:
        terminalreporter.section("docs/reliability.md")
        for row in [("what", "tried", "outcome"), ("---", "---:", "---"), *rows]:
            terminalreporter.write_line(f"| {' | '.join(row)} |")
