"""ns-normlift-check: check a capture and estimate the cost of a lift before running it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import tyro
from rich.table import Table
from rich.text import Text

import normlift_ns
from normlift_ns.core.files import refuse_existing, write_text
from normlift_ns.crash import OURS, explain
from normlift_ns.scripts.early import writable_file
from normlift_ns.scripts.lift import NormLift
from normlift_ns.scripts.shared import CONSOLE, plain, run_command, run_process, say

if TYPE_CHECKING:
    from normlift_ns.planning.findings import Finding
    from normlift_ns.planning.plan import Plan

_Result = TypeVar("_Result")


@dataclass
class NormLiftCheck(NormLift):
    """Check a capture and this machine before a lift, with the options of ns-normlift, without lifting. Encodes a few
    images to estimate the seconds of every stage, memory and disk. The exit code is 1 if there is an error."""

    json: Path | None = None
    """JSON file for the findings and the plan, in addition to the printed table."""
    dry_run: tyro.conf.Suppress[bool] = True

    def main(self) -> None:
        """Check the capture and print the findings.

        Raises:
            SystemExit: There is an error; the exit code is 1.
        """
        start_time = time.perf_counter()
        if self.json is not None:
            writable_file(self.json, "--json")
            refuse_existing(self.json, overwrite=self.overwrite, instead="--json")
        rows, plan = self._rows(start_time)
        _show(rows, plan)
        if self.json is not None:
            write_text(self.json, _to_json(rows, plan), overwrite=self.overwrite)
        if any(row.state == "error" for row in rows):
            raise SystemExit(1)

    def _rows(self, start_time: float) -> tuple[list[Finding], Plan | None]:
        """Return all findings up to the first error that prevents further checks, and the plan if nothing failed."""
        rows: list[Finding] = []
        if _try(rows, "options", lambda: (self.check_early(),)) is None:
            return rows, None
        from normlift_ns.core.gpu import choose_device, wake  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.encoders.build import make_source  # noqa: PLC0415
        from normlift_ns.planning import findings  # noqa: PLC0415
        from normlift_ns.planning.findings import Finding  # noqa: PLC0415
        from normlift_ns.scripts.planned import compared, open_capture, planned  # noqa: PLC0415

        rows.append(findings.of_versions())
        device = _try(rows, "device", lambda: choose_device(self.device))
        if device is None:
            return rows, None
        wake(device)
        rows.append(findings.of_device(device))
        options = self.source.looking_for(self.queries)
        source = _try(rows, "2D features", lambda: make_source(options, device))
        missing = [] if source is None else findings.missing_weights(options, device)
        rows += [] if source is None else [findings.of_weights(missing)]
        opened = _try(rows, "capture", lambda: open_capture(self, start_time))
        if opened is None:
            return rows, None
        scene = opened.scene
        count = f"{len(scene.gaussians):,} Gaussians, {len(scene.train)} training views, {len(scene.held_out)} held out"
        rows.append(Finding("capture", "ok", count))
        rows += [Finding("photographs", "warning", remark) for remark in scene.remarks]
        rows.append(findings.of_views(scene))
        if self.check:
            warning = _try(rows, "cameras", lambda: (compared(self, opened, device),))
            if warning == (None,):
                rows.append(Finding("cameras", "ok", "three images match renders from their cameras"))
            elif warning is not None:
                rows.append(Finding("cameras", "warning", str(warning[0])))
        if source is None or len(missing) > 0 or any(row.state == "error" for row in rows):
            return rows, None
        plan = _try(rows, "plan", lambda: planned(self, opened, source, device))
        if plan is not None:
            rows += [*findings.of_memory(plan, device), findings.of_disk(plan, opened.run_dir)]
        return rows, plan


def _try(rows: list[Finding], name: str, function: Callable[[], _Result]) -> _Result | None:
    """Call a function; if it raises a user error, add an error row and return None.

    Args:
        rows: Findings so far.
        name: Name of the row.
        function: The check.
    Raises:
        Exception: Internal errors of the function.
    """
    from normlift_ns.planning.findings import Finding  # noqa: PLC0415

    try:
        return function()
    except Exception as error:
        if not isinstance(error, (ValueError, OSError, MemoryError)):
            raise
        message, code = explain(error)
        if code == OURS:
            raise
        rows.append(Finding(name, "error", message))
        return None


def _show(rows: list[Finding], plan: Plan | None) -> None:
    table = Table("", "", "result", "what to do")
    colors = {"ok": "green", "warning": "yellow", "error": "red"}
    for row in rows:
        table.add_row(plain(row.what), Text(row.state, style=colors[row.state]), plain(row.found), plain(row.advice))
    CONSOLE.print(table)
    if plan is None:
        say("Correct the errors above to see how long the lift will take.")
        return
    from normlift_ns.scripts.planned import needs, plan_table  # noqa: PLC0415

    CONSOLE.print(plan_table(plan))
    say(needs(plan))


def _to_json(rows: list[Finding], plan: Plan | None) -> str:
    content: dict[str, Any] = {
        "version": normlift_ns.__version__,
        "findings": [asdict(row) for row in rows],
        "plan": None if plan is None else plan.to_json(),
    }
    return json.dumps(content, indent=1) + "\n"


def entrypoint() -> None:
    """Run ns-normlift-check in a process that continues afterwards."""
    run_command(NormLiftCheck)


def main() -> None:
    """Run ns-normlift-check as a process."""
    run_process(NormLiftCheck)
