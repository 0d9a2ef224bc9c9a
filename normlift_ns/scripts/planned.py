"""ns-normlift --dry-run: what a lift will take, from a short look at its capture."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple, Protocol

from rich.table import Table

from normlift_ns.core.gpu import choose_device, wake
from normlift_ns.core.scene import Scene
from normlift_ns.encoders.build import make_source
from normlift_ns.encoders.source import FeatureSource
from normlift_ns.front_door import open_scene
from normlift_ns.lifting import drawn_by
from normlift_ns.options import LiftOptions, SourceOptions
from normlift_ns.planning.findings import missing_weights
from normlift_ns.planning.measure import load_kernels, measure
from normlift_ns.planning.plan import Plan, make_plan
from normlift_ns.raster.settings import RasterSettings
from normlift_ns.runs.files import cache_folder, run_directory
from normlift_ns.scenes.match import judge, match_photographs
from normlift_ns.scenes.opening import SplatScene
from normlift_ns.scripts.shared import STAGES, say


class Command(Protocol):
    """ns-normlift, as far as a plan asks it."""

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

    def trained(self) -> Path | Scene:
        """The run, or the capture opened."""
        ...


class Opened(NamedTuple):
    """A capture that is ready to be looked at, and the seconds that it took to get so far."""

    scene: Scene
    run_dir: Path
    seconds: dict[str, float]


def open_capture(command: Command, begun: float) -> Opened:
    """Opens what a command is about to lift.

    Args:
        begun: when the command began, by `time.perf_counter`.
    Raises:
        FileNotFoundError, ValueError: as `open_scene` and `open_splat`.
    """
    imported = time.perf_counter()
    trained = command.trained()
    scene = (
        open_scene(trained, data=command.data, load_step=command.load_step) if isinstance(trained, Path) else trained
    )
    run_dir = run_directory(command.output_dir or scene.runs_dir, scene.name, command.timestamp)
    return Opened(scene, run_dir, {"start": imported - begun, "open": time.perf_counter() - imported})


def compared(command: Command, opened: Opened, device: str) -> str | None:
    """A warning where photographs and renders of three views differ; adds the seconds to those of the capture.

    Raises:
        ValueError: as `judge`.
    """
    scene = opened.scene
    opened.seconds["kernels"] = load_kernels(scene, command.lift, device=device)
    start = time.perf_counter()
    match = match_photographs(scene, RasterSettings.of_gsplat(drawn_by(scene, command.lift)), device=device)
    opened.seconds["check"] = time.perf_counter() - start
    return judge(match, own_cameras=not isinstance(scene, SplatScene))


def planned(command: Command, opened: Opened, source: FeatureSource, device: str) -> Plan:
    """The plan of a command; raises as `measure`."""
    cache = cache_folder(opened.run_dir)
    facts = measure(opened.scene, source, command.lift, cache, device=device, before=opened.seconds)
    return make_plan(facts, num_devices=command.num_devices)


def dry_run(command: Command, begun: float) -> Plan:
    """Plans what a command would do, and does nothing of it.

    Raises:
        FileNotFoundError: weights of a network are not on this machine, so that its speed cannot be told.
        FileNotFoundError, ValueError: as `open_capture`, `compared` and `measure`.
    """
    device = choose_device(command.device)
    wake(device)
    asked = command.source.looking_for(command.queries)
    source = make_source(asked, device)
    missing = missing_weights(asked, device)
    if len(missing) > 0:
        raise FileNotFoundError(
            f"A plan looks at a few photographs for real, but weights are not on this machine: {'; '.join(missing)}. "
            "Download them first, or give local files with --encoder-pretrained and --sam-model."
        )
    opened = open_capture(command, begun)
    warning = compared(command, opened, device) if command.check else None
    if warning is not None:
        say(f"Warning: {warning}")
    return planned(command, opened, source, device)


def plan_table(plan: Plan) -> Table:
    """The stages of a plan, their seconds and what of them is cached, and what it needs besides."""
    title = f"{plan.gaussians:,} Gaussians, {_views(plan.views)}, on {plan.device}"
    table = Table("stage", title=title)
    table.add_column("seconds", justify="right")
    table.add_column("cached")
    for stage in plan.stages:
        table.add_row(STAGES.get(stage.name, stage.name), f"{stage.seconds:.1f}", stage.remark)
    table.add_section()
    table.add_row("total", f"{plan.seconds:.1f}", f"from a look at {_views(plan.looked_at)}")
    return table


def _views(count: int) -> str:
    return f"{count} view{'s' * (count != 1)}"


def needs(plan: Plan) -> str:
    """Memory and disk of a plan, in one sentence."""
    gpu = "" if plan.device_bytes is None else f"{plan.device_bytes / 2**30:.2f} GiB on each GPU, "
    each = "Each" if plan.num_devices > 1 else "It"
    share = f"{plan.num_devices} processes share the work. " if plan.num_devices > 1 else ""
    room = f"{plan.host_bytes / 2**30:.2f} GiB of memory and {plan.disk_bytes / 2**30:.2f} GiB of disk"
    return f"{share}{each} needs about {gpu}{room}."
