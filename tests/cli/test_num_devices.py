"""Several processes lift one scene: the same files, whoever is killed meanwhile."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import make_trained
from tests.viewer.scenes import until

pytestmark = pytest.mark.slow

LIFT = (sys.executable, "-m", "normlift_ns.cli.lift")
THREADS = {name: "1" for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")}
"""What rounding may depend on is the same for all."""


@pytest.fixture(scope="module")
def trained(made_once: Any) -> Path:
    """A room of three grains of Gaussians."""
    from tests.plain_room import plain_room  # noqa: PLC0415

    return make_trained(made_once, "several", plain_room(20_000), views=9, width=96, height=72)


@pytest.fixture(scope="module")
def alone(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("alone")
    done = lifted(*words(trained, output, 1))
    assert done.returncode == 0, done.stderr
    return output


def words(trained: Path, output: Path, count: int, *flags: str) -> list[str]:
    given = ("--load-config", str(trained), "--encoder", "color", "--device", "cpu", "--timestamp", "t")
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


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_process_that_is_killed_ends_all_and_three_write_the_files_of_one(trained, alone, tmp_path):
    command, output = words(trained, tmp_path / "killed", 2), tmp_path / "killed"
    process = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until(lambda: len(children(process.pid)) == 2)
    victims = children(process.pid)
    until(lambda: any(output.rglob("*.safetensors")) or process.poll() is not None)
    killed = process.poll() is None
    if killed:
        os.kill(victims[1], signal.SIGKILL)
    _, said = process.communicate(timeout=120)
    if killed:
        assert process.returncode == 1
        assert "Process 1 (of 0..1)" in said and "SIGKILL" in said and "Traceback" not in said
    again = lifted(*words(trained, output, 3, "--overwrite", "True"))
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("ns-normlift-query") == 1  # one process speaks
    first, found = field_of(alone), field_of(output)
    assert "field.safetensors" in first and found.keys() == first.keys()
    assert [name for name in first if found[name] != first[name]] == []
    assert list(tmp_path.glob("**/team-*")) == []
