"""ns-normlift-check: check a capture and estimate the cost of a lift before running it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import tyro
from rich.table import Table
from rich.text import Text

import normlift_ns
from normlift_ns.cli.common import CONSOLE, info, plain_text, run_command
from normlift_ns.cli.lift import NormLift, print_plan
from normlift_ns.cli.preflight import check_new_files
from normlift_ns.errors import EXIT_INTERNAL_ERROR, describe_error
from normlift_ns.io.atomic import write_text_file
from normlift_ns.options import SourceOptions, renamed

if TYPE_CHECKING:
    from normlift_ns.encoders.base import FeatureSource
    from normlift_ns.planning import Diagnostic, OpenedCapture, Plan


_Result = TypeVar("_Result")


@renamed(json="output_json")
@dataclass
class NormLiftCheck(NormLift):
    """Check a capture and this machine before a lift. The command accepts the options of ns-normlift. It encodes a few
    images to estimate the time of every stage, the memory and the disk space, but does not lift the scene. The exit
    code is 1 if a check finds an error."""

    output_json: Path | None = None
    """JSON file for the findings and the plan, in addition to the printed table."""
    overwrite: bool = False
    """Replace an existing JSON file of --output-json, and allow an existing run directory of --timestamp."""
    dry_run: tyro.conf.Suppress[bool] = True

    def main(self) -> None:
        """Check the capture and print the findings.

        Raises:
            SystemExit: A check found an error. The exit code is 1.
        """
        start_time = time.perf_counter()
        check_new_files(self.output_json, overwrite=self.overwrite, flags="--output-json")
        rows, plan = self._rows(start_time)
        _show(rows, plan)
        if self.output_json is not None:
            findings = {"version": normlift_ns.__version__, "findings": [asdict(row) for row in rows]}
            text = json.dumps({**findings, "plan": None if plan is None else plan.to_json()}, indent=1) + "\n"
            write_text_file(self.output_json, text, overwrite=self.overwrite)
        if any(row.state == "error" for row in rows):
            raise SystemExit(1)

    def _rows(self, start_time: float) -> tuple[list[Diagnostic], Plan | None]:
        """Run the checks until an error prevents further ones; return the findings and, without errors, the plan."""
        rows: list[Diagnostic] = []
        if _try(rows, "options", lambda: (self.check_early(),)) is None:
            return rows, None
        from normlift_ns import planning  # noqa: PLC0415
        from normlift_ns.core.device import choose_device, init_cuda  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.encoders.build import make_source  # noqa: PLC0415
        from normlift_ns.planning import Diagnostic  # noqa: PLC0415

        rows.append(planning.diagnose_versions())
        device = _try(rows, "device", lambda: choose_device(self.device))
        if device is None:
            return rows, None
        init_cuda(device)
        rows.append(planning.diagnose_device(device))
        options, request = self.source.looking_for(self.queries), self.request()
        source = _try(rows, "2D features", lambda: make_source(options, device))
        missing = [] if source is None else planning.missing_weights(options, device)
        rows += [] if source is None else [planning.diagnose_weights(missing, options, device)]
        opened = _try(rows, "capture", lambda: planning.open_capture(request, start_time))
        if opened is None:
            return rows, None
        scene = opened.scene
        views = f"{len(scene.train)} training view{'s' * (len(scene.train) != 1)}"
        count = f"{len(scene.gaussians):,} Gaussians, {views}, {len(scene.held_out)} held out"
        rows.append(Diagnostic("capture", "ok", count))
        rows += [Diagnostic("images", "warning", remark) for remark in scene.remarks]
        rows.append(planning.diagnose_views(scene))
        lifted = [opened.run_dir, *([self.load_config.parent] if self.load_config is not None else [])]
        rows += _try(rows, "lifted run", lambda: planning.diagnose_recognition(lifted)) or []
        if self.check_alignment:
            compare = partial(planning.compare_cameras, opened, self.lift, device)
            compared = _try(rows, "cameras", lambda: planning.diagnose_cameras(compare()))
            rows += [] if compared is None else [compared]
        if source is None or any(row.state == "error" for row in rows):
            return rows, None
        if len(missing) > 0:
            source = make_source(SourceOptions(encoder="color"), device)
            stand_in = "without the missing weights, the plan describes a lift with --encoder color"
            advice = "add the time of the networks, or fetch the weights and check again"
            rows.append(Diagnostic("plan", "warning", stand_in, advice))
        return rows, self._plan_opened(rows, opened, source, device)

    def _plan_opened(
        self, rows: list[Diagnostic], opened: OpenedCapture, source: FeatureSource, device: str
    ) -> Plan | None:
        """Plan the lift, and add findings about its memory and its disk space; return None if the plan fails."""
        from normlift_ns import planning  # noqa: PLC0415

        plan = _try(rows, "plan", lambda: planning.plan_opened(opened, source, self.lift, device, self.num_devices))
        if plan is not None:
            rows += [*planning.diagnose_memory(plan, device), planning.diagnose_disk(plan, opened.run_dir)]
        return plan


def _try(rows: list[Diagnostic], name: str, function: Callable[[], _Result]) -> _Result | None:
    """Call a function; if it raises a user error, add an error row and return None.

    Args:
        rows: Findings so far.
        name: Name of the row.
        function: Function that runs one check.
    Raises:
        Exception: Internal errors of the function.
    """
    from normlift_ns.planning import Diagnostic  # noqa: PLC0415

    try:
        return function()
    except (ValueError, OSError, MemoryError) as error:
        message, code = describe_error(error)
        if code == EXIT_INTERNAL_ERROR:
            raise
        rows.append(Diagnostic(name, "error", message))
        return None


def _show(rows: list[Diagnostic], plan: Plan | None) -> None:
    table = Table("", "", "result", "what to do")
    colors = {"ok": "green", "warning": "yellow", "error": "red"}
    for row in rows:
        what, found, advice = map(plain_text, (row.what, row.found, row.advice))
        table.add_row(what, Text(row.state, style=colors[row.state]), found, advice)
    CONSOLE.print(table)
    if plan is None:
        info("For an estimate of the lift, correct each error above and rerun the command.")
    else:
        print_plan(plan)


def entrypoint() -> None:
    """Run ns-normlift-check, and return to the caller if it succeeds."""
    run_command(NormLiftCheck)


if __name__ == "__main__":
    entrypoint()
