"""Published results of the NormLift paper, for comparison with an evaluation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from normlift_ns.evaluation.options import Evaluation

Numbers = Mapping[tuple[str, str], float]
"""Numbers by row (a scene or a variant) and metric."""


@dataclass(frozen=True)
class PublishedTable:
    """Numbers of one table of the paper."""

    title: str
    row: str
    """Meaning of the rows: scene or variant."""
    columns: Mapping[str, Numbers]
    """Numbers of each method. The last method is NormLift."""
    factor: float = 1.0
    """Factor that converts numbers of an evaluation to the unit of the table, such as 100 for percent."""


def _numbers(metrics: Sequence[str], rows: Mapping[str, Sequence[float]]) -> Numbers:
    """Return the numbers of a table from its rows, which have one value per metric."""
    return {(row, metric): value for row, values in rows.items() for metric, value in zip(metrics, values)}


_CLASSES = ("miou_19", "macc_19", "miou_15", "macc_15", "miou_10", "macc_10")
_PIXELS = ("miou", "macc", "loc_acc")
_SECONDS = ("lift_s", "post_lift_s")
_NORMLIFT = (35.77, 54.02, 39.62, 59.26, 48.93, 68.83)
_SIGNALS = {
    "zero.share": 0.1594, "zero.opacity": 0.042, "zero.faint": 0.8632, "zero.views": 0.112, "seen.opacity": 0.731,
    "seen.faint": 0.1201, "seen.views": 11.86, "opacity.spearman": 0.002, "opacity.kendall": 0.0002,
    "opacity.jaccard": 0.162,
}  # fmt: skip

TABLES: Mapping[str, PublishedTable] = {
    "scannet": PublishedTable(
        "Table 1 of the paper, ScanNet, in percent",
        "scene",
        {
            "SFS": _numbers(_CLASSES, {"mean": (33.33, 51.35, 36.43, 55.38, 44.74, 63.53)}),
            "THGS": _numbers(_CLASSES, {"mean": (34.39, 50.74, 39.61, 57.07, 46.38, 64.74)}),
            "LUDVIG": _numbers(_CLASSES, {"mean": (33.90, 51.40, 37.40, 57.20, 46.40, 66.20)}),
            "NormLift": _numbers(_CLASSES, {"mean": _NORMLIFT}),
        },
        factor=100,
    ),
    "ablation": PublishedTable(
        "Table 2 of the paper, ablation on ScanNet, in percent",
        "variant",
        {
            "NormLift": _numbers(
                _CLASSES,
                {
                    "none": (32.94, 50.45, 36.30, 55.57, 45.34, 64.18),
                    "plain_knn": (34.06, 51.83, 38.07, 57.79, 46.94, 66.12),
                    "linear": (34.78, 52.36, 39.27, 58.73, 48.50, 67.21),
                    "norm_only": (32.87, 50.41, 36.26, 55.24, 45.08, 64.10),
                    "support_only": (33.67, 51.64, 37.95, 57.20, 47.02, 65.79),
                    "paper": _NORMLIFT,
                },
            )
        },
        factor=100,
    ),
    "timing": PublishedTable(
        "Tables 3 and 6 of the paper, seconds on LERF-OVS",
        "scene",
        {
            "SFS": _numbers(
                _SECONDS,
                {
                    "figurines": (449.24, 379.53),
                    "ramen": (131.02, 117.95),
                    "teatime": (189.45, 532.33),
                    "waldo_kitchen": (200.25, 406.09),
                    "mean": (242.49, 358.98),
                },
            ),
            "NormLift": _numbers(
                _SECONDS,
                {
                    "figurines": (449.24, 34.80),
                    "ramen": (131.02, 10.83),
                    "teatime": (189.45, 101.20),
                    "waldo_kitchen": (200.25, 67.00),
                    "mean": (242.49, 53.46),
                },
            ),
        },
    ),
    "signals": PublishedTable(
        "Table 4 and appendix E of the paper, reliability on ScanNet",
        "scene",
        {"NormLift": _numbers(tuple(_SIGNALS), {"all scenes": tuple(_SIGNALS.values())})},
    ),
    "lerf": PublishedTable(
        "Table 5 of the paper, LERF-OVS, in 0..1",
        "scene",
        {
            "SFS": _numbers(
                _PIXELS,
                {
                    "figurines": (0.569, 0.635, 0.886),
                    "ramen": (0.273, 0.458, 0.474),
                    "teatime": (0.636, 0.775, 0.923),
                    "waldo_kitchen": (0.531, 0.695, 0.777),
                    "mean": (0.502, 0.641, 0.765),
                },
            ),
            "Occam's LGS": _numbers(
                _PIXELS,
                {
                    "figurines": (0.593, 0.669, 0.843),
                    "ramen": (0.369, 0.632, 0.731),
                    "teatime": (0.639, 0.790, 0.857),
                    "waldo_kitchen": (0.487, 0.703, 0.753),
                    "mean": (0.522, 0.699, 0.796),
                },
            ),
            "NormLift": _numbers(
                _PIXELS,
                {
                    "figurines": (0.588, 0.678, 0.899),
                    "ramen": (0.287, 0.500, 0.544),
                    "teatime": (0.650, 0.796, 0.906),
                    "waldo_kitchen": (0.521, 0.720, 0.877),
                    "mean": (0.511, 0.674, 0.807),
                },
            ),
        },
    ),
}
"""Tables of the paper by the protocol or study that measures their numbers."""


def compare_with_paper(
    evaluation: Evaluation, studies: Mapping[str, Sequence[Mapping[str, Any]]]
) -> dict[str, list[dict[str, Any]]]:
    """Return the paper's tables for an evaluation and its studies, with their results in the column `yours`.

    Args:
        evaluation: Result of --protocol scannet or lerf. As in the paper, the studies ablation and signals are compared
            only for scannet, and timing only for lerf.
        studies: Rows of each study, by its name.
    Returns:
        Rows of each table, by table title. `yours` is NaN if the evaluation lacks the number. `difference` is `yours`
        minus the paper's number for NormLift.

    >>> rows = compare_with_paper(Evaluation({"miou_19": 0.3}, [], {"protocol": "scannet"}), {})
    >>> [round(row["difference"], 2) for row in rows["Table 1 of the paper, ScanNet, in percent"][:1]]
    [-5.77]
    """
    protocol = evaluation.settings["protocol"]
    measured = {protocol: _of_evaluation(evaluation)}
    if protocol == "scannet":
        measured["ablation"] = _of_rows("variant", studies.get("ablation", ()))
        measured["signals"] = _of_signals(studies.get("signals", ()))
    else:
        measured["timing"] = _of_timing(studies.get("timing", ()))
    return {
        TABLES[name].title: with_own_column(TABLES[name], numbers)
        for name, numbers in measured.items()
        if len(numbers) > 0
    }


def with_own_column(table: PublishedTable, own: Numbers) -> list[dict[str, Any]]:
    """Return the rows of a table with the columns `yours` and `difference`; both are NaN if `own` lacks the number."""
    rows = []
    for row, metric in table.columns["NormLift"]:
        yours = table.factor * own.get((row, metric), math.nan)
        published = {method: numbers[row, metric] for method, numbers in table.columns.items()}
        difference = {"yours": yours, "difference": yours - published["NormLift"]}
        rows.append({table.row: row, "metric": metric, **published, **difference})
    return rows


def _of_evaluation(evaluation: Evaluation) -> Numbers:
    means = {("mean", metric): value for metric, value in evaluation.results.items()}
    return {**_of_rows("scene", evaluation.scenes), **means}


def _of_rows(key: str, rows: Sequence[Mapping[str, Any]]) -> Numbers:
    return {(row[key], metric): value for row in rows for metric, value in row.items() if metric != key}


def _of_signals(rows: Sequence[Mapping[str, Any]]) -> Numbers:
    """Return the signals of the last row, which is for all scenes together or for a single scene."""
    return {("all scenes", metric): value for row in rows[-1:] for metric, value in row.items() if metric != "scene"}


def _of_timing(rows: Sequence[Mapping[str, Any]]) -> Numbers:
    """Return the seconds of each scene in two groups of stages.

    `lift_s` is the sum for evidence, consensus and lift. `post_lift_s` is the sum for neighbors and vote.
    """
    parts = {"lift_s": ("evidence_s", "consensus_s", "lift_s"), "post_lift_s": ("neighbors_s", "vote_s")}
    return {
        (row["scene"], metric): sum(row.get(name, 0.0) for name in names)
        for row in rows
        for metric, names in parts.items()
    }
