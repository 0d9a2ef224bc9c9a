"""Tests of research/: what its numbers mean. The package itself is tested elsewhere."""

import json
import sys
from pathlib import Path
from typing import Any

from tests.processes import run

ROOT = Path(__file__).resolve().parents[2]


def quick(benchmark: str, folder: Path, *flags: str) -> dict[str, dict[str, Any]]:
    """Metrics by key of a small run of a benchmark."""
    run(sys.executable, "-m", f"research.{benchmark}", "--quick", *flags, "--output", folder, cwd=ROOT)
    document = json.loads((folder / f"{benchmark}.json").read_text())
    assert set(document) == {"hardware", "versions", "command", "metrics"}
    assert all(set(metric) == {"key", "value", "unit", "error"} for metric in document["metrics"])
    return {metric["key"]: metric for metric in document["metrics"]}
