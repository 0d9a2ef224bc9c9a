"""Results of an evaluation, in the JSON format of ns-eval."""

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
    """Metrics of one protocol over one or several runs."""

    results: Mapping[str, float]
    """Metrics by name, as `results` of ns-eval. Shares are in 0..1."""
    rows: Sequence[Mapping[str, Any]]
    """Metrics per class (and scene or frame), as JSON types."""
    settings: Mapping[str, Any]
    """The protocol and its settings."""
    scenes: Sequence[Mapping[str, Any]] = ()
    """Metrics of each scene, if `results` are their means."""


def mean(values: Sequence[float]) -> float:
    """Return the mean of the values that are not NaN; NaN if there are none.

    >>> mean([1.0, float("nan"), 3.0])
    2.0
    """
    numbers = [value for value in values if not math.isnan(value)]
    return sum(numbers) / len(numbers) if len(numbers) > 0 else float("nan")


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
    """Write experiment_name, method_name, checkpoint and results as ns-eval does, then settings, scenes, rows and
    studies.

    NaN is written as null.

    Raises:
        FileExistsError: the file exists and `overwrite` is False.
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
    write_text(path, json.dumps(_to_json(document), indent=2, allow_nan=False) + "\n", overwrite=overwrite)


def _to_json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _to_json(x) for key, x in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_to_json(x) for x in value]
    return None if isinstance(value, float) and math.isnan(value) else value
