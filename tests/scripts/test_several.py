"""Several processes lift one scene: the same files, whoever is killed meanwhile."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from benchmarks.plain_room import plain_room
from normlift_ns.demo import write_capture, write_splatfacto_run
from tests.captures import SHARED

pytestmark = pytest.mark.slow

LIFT = (sys.executable, "-m", "normlift_ns.scripts.lift")
THREADS = {name: "1" for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")}
"""What rounding may depend on is the same for all."""
TABLETOP = SHARED / "captures" / "outputs" / "tabletop" / "splatfacto" / "run" / "config.yml"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room of three grains of Gaussians."""
    folder = tmp_path_factory.mktemp("several")
    room = plain_room(20_000)
    write_capture(room, folder / "room", views=9, held_out=1, width=96, height=72)
    return write_splatfacto_run(room, folder / "room", folder / "outputs")


def words(trained: Path, output: Path, count: int, *flags: str) -> list[str]:
    given = ("--load-config", str(trained), "--encoder", "colour", "--device", "cpu", "--timestamp", "t")
    return [*LIFT, *given, "--output-dir", str(output), "--num-devices", str(count), *flags]


def environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name not in ("RANK", "WORLD_SIZE")} | THREADS


def lifted(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=400, check=False)


def field_of(output: Path) -> dict[str, bytes]:
    """The files of the field, by name; of the manifest what does not tell times and names."""
    (folder,) = output.glob("*/normlift/t/normlift")
    files = {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix == ".safetensors"}
    facts = json.loads((folder / "manifest.json").read_text())
    facts = {name: value for name, value in facts.items() if name not in ("cost", "digest")}
    return files | {"manifest": json.dumps(facts, sort_keys=True).replace(str(output), "").encode()}


def check_same(outputs: Sequence[Path]) -> None:
    first, *others = (field_of(output) for output in outputs)
    assert "field.safetensors" in first
    for found in others:
        assert found.keys() == first.keys()
        assert [name for name in first if found[name] != first[name]] == []


@pytest.mark.parametrize("flags", [(), ("--vote", "paper", "--consensus", "False", "--storage", "float16")])
def test_one_two_and_three_processes_write_the_same_files(flags, trained, tmp_path):
    for count in (1, 2, 3):
        done = lifted(*words(trained, tmp_path / str(count), count, *flags))
        assert done.returncode == 0, done.stderr
        assert done.stdout.count("ns-normlift-query") == 1  # one process speaks
    check_same([tmp_path / str(count) for count in (1, 2, 3)])
    assert list(tmp_path.glob("**/team-*")) == []


@pytest.mark.skipif(
    not TABLETOP.exists(), reason="the trained captures (folder shared beside the repository) are absent"
)
def test_the_tabletop_is_the_same(tmp_path):
    for count in (1, 3):
        done = lifted(*words(TABLETOP, tmp_path / str(count), count, "--max-views", "6", "--lift-downscale", "4"))
        assert done.returncode == 0, done.stderr
    check_same([tmp_path / str(count) for count in (1, 3)])


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("seed", [1, 2])
def test_a_process_killed_at_a_random_instant_ends_all_and_a_rerun_is_the_same(seed, trained, tmp_path):
    chosen, killed = random.Random(seed), False
    lifted(*words(trained, tmp_path / "whole", 1))
    command = words(trained, tmp_path / "killed", 2)
    process = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while len(children(process.pid)) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    victims = children(process.pid)
    time.sleep(chosen.uniform(2, 9))
    if process.poll() is None:
        rank = chosen.randrange(2)
        os.kill(victims[rank], signal.SIGKILL)
        killed = True
    start = time.monotonic()
    _, said = process.communicate(timeout=60)
    assert time.monotonic() - start < 60
    if killed:
        assert process.returncode == 1
        assert f"Process {rank} of 0..1 was ended by SIGKILL" in said
        assert "are kept" in said and "Traceback" not in said
    again = lifted(*words(trained, tmp_path / "killed", 2, "--overwrite", "True"))
    assert again.returncode == 0, again.stderr
    check_same([tmp_path / "whole", tmp_path / "killed"])


def test_processes_that_nobody_has_started_for_us_name_the_one_that_is_gone(trained, tmp_path):
    """As on several machines: variables alone."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    team = environment() | {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "3"}
    command = words(trained, tmp_path / "three", 1)
    logs = [tmp_path / f"{r}.log" for r in range(3)]
    processes = []
    for rank, log in enumerate(logs):
        with log.open("w") as file:
            how = {"env": team | {"RANK": str(rank)}, "stdout": file, "stderr": file}
            processes.append(subprocess.Popen(command, **how))
    deadline = time.monotonic() + 120
    while "Opening" not in logs[0].read_text() and time.monotonic() < deadline:  # they have come together then
        time.sleep(0.05)
    time.sleep(2)
    processes[1].kill()
    start = time.monotonic()
    for process in processes:
        process.wait(timeout=110)
    assert time.monotonic() - start < 60
    said = [log.read_text() for log in logs]
    if processes[0].returncode != 0:  # else it had ended before
        assert [process.returncode for process in processes] == [1, -9, 1]
        assert any("Process 1 (" in text and "is gone" in text for text in (said[0], said[2])), said
        assert not any("Traceback" in text or "bug of normlift_ns" in text for text in said), said


def test_one_process_tells_of_a_mistake(trained, tmp_path):
    done = lifted(*words(trained, tmp_path / "x", 2, "--regions", "files", "--regions-dir", str(tmp_path)))
    assert done.returncode == 1
    assert done.stderr.count("has no label map") == 1 and "frame #" not in done.stderr, done.stderr
    assert list((tmp_path / "x").glob("*/normlift/t")) == []


def test_more_gpus_than_there_are(trained, tmp_path):
    command = words(trained, tmp_path / "x", 2)
    command[command.index("cpu")] = "cuda"
    done = lifted(*command)
    assert done.returncode == 1
    assert "GPU" in done.stderr and "Traceback" not in done.stderr
