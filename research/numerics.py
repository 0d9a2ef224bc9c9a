"""Errors of every hard case against float64 or higher precision: the tables of docs/numerics.md.

    python -m research.numerics                  on the CPU: results/numerics.json
    python -m research.numerics --device cuda    on a GPU: results/numerics_gpu.json

After writing, the command fails if an error exceeds its bound. `python -m research.pages` shows both files next to each
other.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from research.hard_case import QUANTITIES, Setting
from research.hard_scenes import SCENES
from research.hard_sums import SUMS
from research.report import RESULTS, Report

CASES = (*SCENES, *SUMS)


def main(device: str, output: Path) -> None:
    report, failures = Report("numerics" if device == "cpu" else "numerics_gpu"), []
    for case in CASES:
        errors = case.measure(Setting(device))
        failures += case.failures(errors)
        for quantity, error in errors.items():
            report.add(f"{case.key}.{quantity}", error, QUANTITIES[quantity].unit)
    report.write(output)
    if failures:
        sys.exit("\n".join(failures))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    main(arguments.device, arguments.output)
