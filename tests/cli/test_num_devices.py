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

LIFT = (sys.executable, "-m", "normlift_ns.cli.lift")
THREADS = {name: "1" for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")}
"""What rounding may depend on is the same for all."""


def field_of(output: Path) -> dict[str, bytes]:
    """The files of the field, by name; of the manifest what does not tell times and names."""
    (folder,) = output.glob("*/normlift/t/normlift")
    files = {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix == ".safetensors"}
    facts = json.loads((folder / "manifest.json").read_text())
    facts = {name: value for name, value in facts.items() if name not in ("cost", "digest")}
    return files | {"manifest": json.dumps(facts, sort_keys=True).replace(str(output), "").encode()}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_process_that_is_killed_ends_all_and_three_write_the_files_of_one(made_once: Any, tmp_path: Path) -> None:
    from tests.plain_room import plain_room  # noqa: PLC0415

    trained = make_trained(made_once, "several", plain_room(20_000), views=9, width=96, height=72)  # three grains
    environment = {name: value for name, value in os.environ.items() if name not in ("RANK", "WORLD_SIZE")} | THREADS
    given = ("--load-config", str(trained), "--encoder", "color", "--device", "cpu", "--timestamp", "t")

    def started(output: Path, count: int, *flags: str) -> subprocess.Popen[str]:
        words = [*LIFT, *given, "--output-dir", str(output), "--num-devices", str(count), *flags]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen(words, env=environment, **pipes)

    def children() -> list[int]:
        return [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]

    alone, output = tmp_path / "alone", tmp_path / "killed"
    process = started(output, 2)
    until(lambda: len(children()) == 2)
    _, victim = children()
    until(lambda: any(output.rglob("*.safetensors")) or process.poll() is not None)
    killed = process.poll() is None
    if killed:
        os.kill(victim, signal.SIGKILL)
    _, said = process.communicate(timeout=120)
    if killed:
        assert process.returncode == 1
        assert "Process 1 (counted from 0)" in said and "SIGKILL" in said and "Traceback" not in said
    for again in (started(output, 3, "--overwrite", "True"), started(alone, 1)):
        out, said = again.communicate(timeout=400)
        assert again.returncode == 0, said
        assert out.count("ns-normlift-query") == 1  # one process speaks
    first, found = field_of(alone), field_of(output)
    assert "field.safetensors" in first and found.keys() == first.keys()
    assert [name for name in first if found[name] != first[name]] == []
    assert list(tmp_path.glob("**/team-*")) == []
