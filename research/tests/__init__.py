"""Tests of research/: what its numbers mean. The package itself is tested elsewhere."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


def quick(benchmark: str, folder: Path, *flags: str) -> dict[str, dict[str, Any]]:
    """Metrics by key of a small run of a benchmark."""
    command = [sys.executable, "-m", f"research.{benchmark}", "--quick", *flags, "--output", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    document = json.loads((folder / f"{benchmark}.json").read_text())
    assert set(document) == {"hardware", "versions", "command", "metrics"}
    assert all(set(metric) == {"key", "value", "unit", "error"} for metric in document["metrics"])
    return {metric["key"]: metric for metric in document["metrics"]}
