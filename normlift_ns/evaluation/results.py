"""What an evaluation finds, in the JSON shape of ns-eval."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from normlift_ns.core.files import write_text


@dataclass(frozen=True)
class Evaluation:
    """Figures of one protocol over one or several runs."""

    results: Mapping[str, float]
    """By name, as `results` of ns-eval. Shares are in 0..1."""
    rows: Sequence[Mapping[str, Any]]
    """Per class (and scene or frame), JSON types only."""
    settings: Mapping[str, Any]
    """The protocol and the reading of it."""
    scenes: Sequence[Mapping[str, Any]] = ()
    """Results of every scene, where `results` are their means."""


def mean(values: Sequence[float]) -> float:
    """Mean of the values that are numbers; NaN if there is none.

    >>> mean([1.0, float("nan"), 3.0])
    2.0
    """
    found = [value for value in values if not math.isnan(value)]
    return sum(found) / len(found) if len(found) > 0 else float("nan")


def write_evaluation(
    path: Path,
    evaluation: Evaluation,
    *,
    experiment_name: str,
    method_name: str,
    checkpoint: str,
    studies: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Writes experiment_name, method_name, checkpoint and results as ns-eval does, then settings, scenes, rows and
    studies; NaN as null.

    Raises:
        FileExistsError: the file is there and `overwrite` is False.
    """
    document = {
        "experiment_name": experiment_name,
        "method_name": method_name,
        "checkpoint": checkpoint,
        "results": evaluation.results,
        "settings": evaluation.settings,
        **({"scenes": evaluation.scenes} if evaluation.scenes else {}),
        "rows": evaluation.rows,
        **({"studies": studies} if studies else {}),
    }
    write_text(path, json.dumps(_plain(document), indent=2, allow_nan=False) + "\n", overwrite=overwrite)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(x) for key, x in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(x) for x in value]
    return None if isinstance(value, float) and math.isnan(value) else value
