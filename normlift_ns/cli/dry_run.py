"""ns-normlift --dry-run: time, memory and disk that a lift needs, estimated from a few images."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple, Protocol

from rich.table import Table

from normlift_ns.cli.common import info
from normlift_ns.core.device import choose_device, init_cuda
from normlift_ns.core.scene import Scene
from normlift_ns.data.alignment import alignment_warning, measure_alignment
from normlift_ns.data.open_splat import SplatScene
from normlift_ns.encoders.base import FeatureSource
from normlift_ns.encoders.build import make_source
from normlift_ns.io.run_dir import cache_folder, run_directory
from normlift_ns.lifted_run import open_scene
from normlift_ns.options import LiftOptions, SourceOptions
from normlift_ns.pipeline import resolve_gsplat_version
from normlift_ns.planning import Plan, make_plan, measure_capture, missing_weights, time_kernel_loading
from normlift_ns.rasterization.settings import RasterSettings


class PlannedCommand(Protocol):
    """Options of ns-normlift that a plan needs."""

    data: Path | None
    load_step: int | None
    output_dir: Path | None
    timestamp: str | None
    check: bool
    device: str
    num_devices: int
    queries: tuple[str, ...]
    source: SourceOptions
    lift: LiftOptions

    def open_trained(self) -> Path | Scene:
        """Return the config of the run, or the opened scene."""
        ...


class OpenedCapture(NamedTuple):
    """An opened capture and the seconds that each stage has taken so far."""

    scene: Scene
    run_dir: Path
    stage_seconds: dict[str, float]


def open_capture(command: PlannedCommand, start_time: float) -> OpenedCapture:
    """Open the capture that a command is about to lift.

    Args:
        command: Options of ns-normlift.
        start_time: Start of the command by `time.perf_counter`.
    Raises:
        FileNotFoundError, ValueError: Same as in `open_scene` and `open_splat`.
    """
    import_time = time.perf_counter()
    trained = command.open_trained()
    scene = (
        open_scene(trained, data=command.data, load_step=command.load_step) if isinstance(trained, Path) else trained
    )
    run_dir = run_directory(command.output_dir or scene.runs_dir, scene.name, command.timestamp)
    return OpenedCapture(scene, run_dir, {"start": import_time - start_time, "open": time.perf_counter() - import_time})


def compare_cameras(command: PlannedCommand, opened: OpenedCapture, device: str) -> str | None:
    """Return a warning if images and renders of three views differ; add the time to `opened.seconds`.

    Raises:
        ValueError: Same as in `alignment_warning`.
    """
    scene = opened.scene
    opened.stage_seconds["kernels"] = time_kernel_loading(scene, command.lift, device=device)
    start = time.perf_counter()
    match = measure_alignment(
        scene, RasterSettings.of_gsplat(resolve_gsplat_version(scene, command.lift)), device=device
    )
    opened.stage_seconds["check"] = time.perf_counter() - start
    return alignment_warning(match, trained_cameras=not isinstance(scene, SplatScene))


def plan_lift(command: PlannedCommand, opened: OpenedCapture, source: FeatureSource, device: str) -> Plan:
    """Return the plan of a command; errors are those of `measure_capture`."""
    cache = cache_folder(opened.run_dir)
    measurements = measure_capture(
        opened.scene, source, command.lift, cache, device=device, before=opened.stage_seconds
    )
    return make_plan(measurements, num_devices=command.num_devices)


def dry_run(command: PlannedCommand, start_time: float) -> Plan:
    """Return the plan of a command without lifting anything.

    Args:
        command: Options of ns-normlift.
        start_time: Start of the command by `time.perf_counter`.
    Raises:
        FileNotFoundError: Network weights are not on this machine, so the speed cannot be measured.
        FileNotFoundError, ValueError: Same as in `open_capture`, `compare_cameras` and `measure_capture`.
    """
    device = choose_device(command.device)
    init_cuda(device)
    options = command.source.looking_for(command.queries)
    source = make_source(options, device)
    missing = missing_weights(options, device)
    if len(missing) > 0:
        raise FileNotFoundError(
            f"A plan encodes a few images, but weights are not on this machine: {'; '.join(missing)}. "
            "Download them first, or give local files with --encoder-pretrained and --sam-model."
        )
    opened = open_capture(command, start_time)
    warning = compare_cameras(command, opened, device) if command.check else None
    if warning is not None:
        info(f"Warning: {warning}")
    return plan_lift(command, opened, source, device)


def plan_table(plan: Plan) -> Table:
    """Return a table of the stages of a plan, their seconds, and what is cached."""
    title = f"{plan.gaussians:,} Gaussians, {_views(plan.views)}, on {plan.device}"
    table = Table("stage", title=title)
    table.add_column("seconds", justify="right")
    table.add_column("cached")
    for stage in plan.stages:
        table.add_row(stage.name, f"{stage.seconds:.1f}", stage.remark)
    table.add_section()
    table.add_row("total", f"{plan.seconds:.1f}", f"estimated from {_views(plan.looked_at)}")
    return table


def _views(count: int) -> str:
    return f"{count} view{'s' * (count != 1)}"


def describe_needs(plan: Plan) -> str:
    """Return the memory and disk needs of a plan as a sentence."""
    gpu = "" if plan.device_bytes is None else f"{plan.device_bytes / 2**30:.2f} GiB on each GPU, "
    subject = "Each" if plan.num_devices > 1 else "The lift"
    processes = f"{plan.num_devices} processes share the work. " if plan.num_devices > 1 else ""
    space = f"{plan.host_bytes / 2**30:.2f} GiB of memory and {plan.disk_bytes / 2**30:.2f} GiB of disk"
    return f"{processes}{subject} needs about {gpu}{space}."
