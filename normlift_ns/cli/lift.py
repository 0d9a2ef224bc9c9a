"""ns-normlift: lift 2D features onto a trained splat."""

from __future__ import annotations

import ctypes
import gc
import os
import shlex
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, fields
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any, cast

from rich.console import Group
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

from normlift_ns.cli import common, preflight
from normlift_ns.distributed.launch import LAUNCHED_VARIABLE, distributed_context, launch_processes, rank_and_world_size
from normlift_ns.errors import InputError
from normlift_ns.io.memory import refuse_small_memory
from normlift_ns.io.run_dir import cache_folder, refuse_existing_run, run_directory
from normlift_ns.options import CheckedOptions, LiftOptions, SourceOptions, SplatOptions, check_device, renamed

if TYPE_CHECKING:
    from normlift_ns.core.scene import Scene
    from normlift_ns.distributed.communicator import TorchCommunicator
    from normlift_ns.lifted_run import LiftedRun
    from normlift_ns.pipeline import LiftRequest
    from normlift_ns.planning import Plan
    from normlift_ns.progress import ProgressCallback


_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4
"""Options of mallopt in glibc."""


@contextmanager
def join_processes(device: str) -> Iterator[TorchCommunicator | None]:
    """Join the process group of a distributed lift, in which only the first process prints.

    Args:
        device: Value of --device.
    Yields:
        The communicator, or None if there is only one process.
    """
    started_by_us = LAUNCHED_VARIABLE in os.environ  # the parent process reports failures
    try:
        with distributed_context(device, common.print_error) as team:
            if team is not None and team.rank > 0:
                common.CONSOLE.quiet = True
                warnings.simplefilter("ignore")
            yield team
    except (KeyboardInterrupt, common.TerminatedError):
        if started_by_us:
            sys.exit(1)
        raise


@renamed(check="check_alignment")
@dataclass
class NormLift(CheckedOptions):
    """Lift 2D features onto the Gaussians of a trained splat, without training. The splat is a splatfacto run, a
    splat file such as PLY or SPZ, or a checkpoint of gsplat's trainer."""

    load_config: Path | None = None
    """Path to the config.yml file of the trained run."""
    load_ply: Path | None = None
    """Splat file to use instead of --load-config: PLY, compressed PLY, SPZ, .splat, GLB or glTF. Needs --colmap or
    --transforms."""
    load_gsplat: Path | None = None
    """Checkpoint ckpt_<step>_rank0.pt of gsplat's simple_trainer, to use instead of --load-config. Needs --colmap
    or --transforms. If the trainer normalized the world, --transforms also needs --world-transform FILE. If it did not,
    add --gsplat-normalize False, unless its cfg.yml records that."""
    splat: SplatOptions = field(default_factory=SplatOptions)
    add_images: Path | None = None
    """COLMAP project folder or transforms.json with images taken after training, which the lift then uses too. It must
    also contain two or more images of the original dataset under their original names, to align the new images. The
    cameras of these original images must have the same relative poses as in training."""
    check_alignment: bool = True
    """Compare up to three training images with renders of the scene before the lift. False: skip the comparison."""
    dry_run: bool = False
    """Estimate the time of every stage, the memory, the disk space and the number of cached views, without lifting. The
    command measures its speed on a few images."""
    data: Path | None = None
    """Current path of the dataset, if it was moved after training."""
    load_step: int | None = None
    """Training step of the checkpoint to load. None: the last checkpoint."""
    output_dir: Path | None = None
    """Output folder. None: the output folder of the trained run, or outputs for a splat without a run."""
    timestamp: str | None = None
    """Name of the new run directory. None: the current time."""
    overwrite: bool = False
    """Replace an existing run directory that has the same --timestamp, and files in --export-langsplat whose content
    differs."""
    device: str = "auto"
    """Device to lift on: auto, cpu, cuda, or one GPU such as cuda:1."""
    num_devices: int = 1
    """Number of processes on this machine, each with its own GPU or an equal share of the CPU cores. For several
    machines, use torchrun."""
    queries: tuple[str, ...] = ()
    """Prompts to store in the run. ns-render and ns-viewer show their relevancy."""
    export_langsplat: Path | None = None
    """Folder for a copy of the lifted regions and features, in the format of LangSplat's preprocessing."""
    source: SourceOptions = field(default_factory=SourceOptions)
    lift: LiftOptions = field(default_factory=LiftOptions)

    def main(self) -> LiftedRun | None:
        """Lift, and return the new run; None for a dry run, or if another process lifts or writes the run."""
        self.check_early()
        refuse_small_memory(loaded="torch" in sys.modules)
        if self.dry_run:
            self._plan()
            return None
        if self.num_devices > 1 and rank_and_world_size(os.environ) is None:
            cores = os.cpu_count() or 1
            if self.num_devices > cores:
                common.info(
                    f"{self.num_devices} processes share {cores} CPU core{'s' * (cores != 1)}. On the CPU, more "
                    "processes than cores do not make the lift faster."
                )
            words = common.rename_flags(sys.argv[1:], common.renamed_flags(NormLift))  # prints once
            program = [sys.executable, "-m", "normlift_ns.cli.lift"]
            # Only the first process writes the log file.
            other = [*program, *common.split_output_flags(words)[0]]
            code = launch_processes([[*program, *words], *[other] * (self.num_devices - 1)], common.print_error)
            if code > 0:
                sys.exit(code)
            return None
        with frequent_switches():
            load_drivers(self.device)
            with join_processes(self.device) as team:
                return self._lift(team)

    def request(self, **more: Any) -> LiftRequest:
        """Return the lift request for these options.

        Args:
            more: Other fields of the request.
        """
        from normlift_ns.pipeline import LiftRequest  # noqa: PLC0415 (--help should not wait for torch)

        own = {item.name: getattr(self, item.name) for item in fields(LiftRequest) if hasattr(self, item.name)}
        return LiftRequest(**own, **more)

    def _plan(self) -> None:
        """Print an estimate of the time, memory and disk space of the lift."""
        start_time = time.perf_counter()
        common.info_progress(f"Opening {self.load_config or self.load_ply or self.load_gsplat}")
        from normlift_ns.planning import dry_run  # noqa: PLC0415 (as above)

        print_plan(dry_run(self.request(say=common.info), self.num_devices, start_time))

    def _lift(self, team: TorchCommunicator | None) -> LiftedRun | None:
        start_time = common.command_start()
        keep_freed_memory()
        common.info_progress(f"Opening {self.load_config or self.load_ply or self.load_gsplat}")
        with paused_collection():
            from normlift_ns.encoders.langsplat import FeatureExport  # noqa: PLC0415
            from normlift_ns.pipeline import run_lift  # noqa: PLC0415 (as above)

        import_time = time.perf_counter()
        message_times: list[float] = []

        def on_message(text: str) -> None:
            message_times.append(time.perf_counter())
            common.info_progress(text)

        with progress_bars() as report:
            export = None if self.export_langsplat is None else FeatureExport(self.export_langsplat, self.overwrite)
            request = self.request(export=export, report=report, say=on_message)
            if team is None:
                run = run_lift(request)
            else:
                from normlift_ns.distributed.lift import run_lift_distributed  # noqa: PLC0415

                run = run_lift_distributed(team, request)
        if run is None:
            return None
        before = {"start": import_time - start_time, "open": (message_times or [import_time])[0] - import_time}
        if not common.output_settings[-1].quiet:
            common.CONSOLE.print(lift_summary(run, before, time.perf_counter() - start_time))
        common.info(next_command(run.config, self.queries))
        return run

    def check_early(self) -> None:
        """Raise errors that can be detected before anything is loaded."""
        check_device(self.device)
        if self.num_devices > 1 and ":" in self.device:
            raise InputError(
                f"--device {self.device} is one GPU, but --num-devices is {self.num_devices}; give --device cuda"
            )
        self._check_splat()
        if self.load_config is None:
            preflight.check_splat_paths(self.load_ply, self.load_gsplat, self.splat)
        else:
            preflight.check_run_config(self.load_config, self.data, self.load_step)
        if self.add_images is not None and not self.add_images.is_dir():
            preflight.check_readable_file(self.add_images, "--add-images")
        preflight.check_unused_options(self.lift)
        preflight.check_source_options(self.source, self.queries)
        for flag, folder in (("--output-dir", self.output_dir), ("--export-langsplat", self.export_langsplat)):
            preflight.check_writable_folder(folder, flag)
        name, outputs = self.new_run_location()
        run_dir = run_directory(outputs or Path(), name or "run", self.timestamp)
        if name is not None and outputs is not None:
            if self.timestamp is not None:
                refuse_existing_run(run_dir, self.overwrite, self.load_config)
            preflight.check_writable_folder(cache_folder(run_dir), "--output-dir")

    def _check_splat(self) -> None:
        """Raise InputError unless exactly one trained splat is given, and all options apply to it."""
        paths = [path for path in (self.load_config, self.load_ply, self.load_gsplat) if path is not None]
        if len(paths) != 1:
            raise InputError(
                f"Give one trained splat, got {len(paths)}: --load-config with the config.yml of a splatfacto run, "
                "--load-ply with a splat file such as PLY, or --load-gsplat with a checkpoint of gsplat's trainer."
            )
        default = SplatOptions()
        if self.load_config is None:
            options, names, needed = self, ("data", "load_step"), "--load-config"
        else:
            options, names, needed = self.splat, tuple(vars(default)), "--load-ply or --load-gsplat"
        for name in names:
            if getattr(options, name) != getattr(default, name, None):
                cure = "Leave it out; --images sets the folder of the images." if name == "data" else "Leave it out."
                raise InputError(f"--{name.replace('_', '-')} works only with {needed}. {cure}")

    def new_run_location(self) -> tuple[str | None, Path | None]:
        """Return the capture name and output folder for `run_directory`, each None if it is not known yet.

        Raises:
            InputError, OSError: The config is invalid or cannot be read.
        """
        if self.load_config is not None:
            from normlift_ns.data.nerfstudio.config import read_config_paths  # noqa: PLC0415 (as --help)

            paths = read_config_paths(self.load_config)
            return paths.experiment, self.output_dir or paths.output_dir
        cameras = (self.splat.colmap or self.splat.transforms or Path()).absolute()
        name = (cameras.parent if cameras.suffix == ".json" else cameras).name
        return name or "splat", self.output_dir or Path("outputs")

    def open_scene(self) -> Scene:
        """Open the trained scene, and add the images of --add-images."""
        from normlift_ns.data.extra_images import add_extra_images  # noqa: PLC0415
        from normlift_ns.data.open_scene import open_scene  # noqa: PLC0415 (as above)
        from normlift_ns.data.open_splat import open_splat  # noqa: PLC0415

        splat = self.load_ply or self.load_gsplat
        if splat is not None:
            scene: Any = open_splat(splat, self.splat, device=self.device, say=common.info_progress)
        else:
            scene = open_scene(cast(Path, self.load_config), data=self.data, load_step=self.load_step)
        if self.add_images is None:
            return scene
        count = len(scene.train)
        scene = add_extra_images(scene, self.add_images)  # pyrefly: ignore[bad-specialization]
        common.info_progress(f"New images from {self.add_images}, added to the lift: {len(scene.train) - count}.")
        return scene


@contextmanager
def progress_bars() -> Iterator[ProgressCallback]:
    """Yield a callback that shows a progress bar for each stage, or prints a line to a pipe or log file.

    With --quiet, the callback prints nothing.
    """
    names = {"features": "2D features", "lift": "lift, reliability", "store": "choosing storage"}
    columns = (
        TextColumn("{task.description:>17}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    live = common.CONSOLE.is_terminal and common.output_settings[-1] == common.OutputSettings()
    progress, tasks = Progress(*columns, console=common.CONSOLE), dict[str, TaskID]()

    def report(stage: str, done: int, total: int) -> None:
        if stage not in tasks:
            tasks[stage] = progress.add_task(names.get(stage, stage), total=total)
            if not live:
                common.info_progress(f"{names.get(stage, stage)} …")
        progress.update(tasks[stage], completed=done, total=total)

    with progress if live else nullcontext():
        yield report


def print_plan(plan: Plan) -> None:
    """Print a table of the stages with their seconds and cached views, and lines about memory and disk space."""
    table = Table("stage", title=f"{plan.gaussians:,} Gaussians, {_views(plan.views)}, on {plan.device}")
    table.add_column("seconds", justify="right")
    table.add_column("cached")
    for stage in plan.stages:
        table.add_row(stage.name, f"{stage.seconds:.1f}", stage.remark)
    table.add_section()
    table.add_row("total", f"{plan.seconds:.1f}", f"estimated from {_views(plan.looked_at)}")
    common.CONSOLE.print(table)
    gpu = "" if plan.device_bytes is None else f" and {plan.device_bytes / 2**30:.2f} GiB of GPU memory"
    subject = f"{plan.num_devices} processes share the work. Each" if plan.num_devices > 1 else "The lift"
    common.info(f"{subject} needs about {plan.host_bytes / 2**30:.2f} GiB of memory{gpu}.")
    common.info(f"The lift writes about {plan.disk_bytes / 2**30:.2f} GiB to the disk.")


def keep_freed_memory() -> None:
    """Let glibc reuse freed memory instead of immediately returning it to the system.

    Without this, a lift on the CPU spends a third of its time in page faults of large temporary arrays.
    """
    with suppress(OSError, AttributeError):  # other systems
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_MAX, 0)
        mallopt(_M_TRIM_THRESHOLD, -1)


@contextmanager
def frequent_switches() -> Iterator[None]:
    """Switch between threads ten times as often, so that threads that read files do not wait for imports."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(interval / 10)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)


@contextmanager
def paused_collection() -> Iterator[None]:
    """Import modules without collecting garbage, and leave their objects out of all later collections.

    Imports of torch create 200,000 objects, which stay. Visiting them in several collections would take about half a
    second.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if enabled:
            gc.enable()


def load_drivers(device: str) -> None:
    """Start to initialize CUDA and to load Triton in background threads, while torch is imported.

    Otherwise, torch would do both later, and hold Python's global interpreter lock. Errors are ignored here. They occur
    again at the first use of the GPU.

    Args:
        device: Device to lift on: cpu, cuda, cuda:N or auto.
    """
    if device == "cpu":
        return
    with suppress(OSError):  # this machine has no CUDA
        cuda = ctypes.CDLL("libcuda.so.1")
        Thread(target=_load_triton, name="load-triton", daemon=True).start()
        if rank_and_world_size(os.environ) is None:  # processes of a distributed lift choose their GPU later
            number = int(device.partition(":")[2] or 0)
            Thread(target=_start_cuda, args=(cuda, number), name="start-cuda", daemon=True).start()


def _load_triton() -> None:
    """Import Triton, and compute the hash of its files, which all kernels need."""
    with suppress(Exception):
        import_module("triton.runtime.cache").triton_key()


def _start_cuda(cuda: ctypes.CDLL, number: int) -> None:
    """Create the context that torch uses on a GPU."""
    gpu, context = ctypes.c_int(), ctypes.c_void_p()
    with suppress(AttributeError):
        if cuda.cuInit(0) == 0 and cuda.cuDeviceGet(ctypes.byref(gpu), number) == 0:
            cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), gpu)


def _views(count: int) -> str:
    return f"{count} view{'s' * (count != 1)}"


def lift_summary(run: LiftedRun, before: dict[str, float], total: float) -> Group:
    """Return the table to print after a lift: statistics, seconds, memory, storage and path.

    Args:
        run: Lifted run.
        before: Seconds of the stages before the lift, by name. The first includes the start of the process.
        total: Seconds of the whole command.
    """
    from normlift_ns.query.text_encoder import encoder_name  # noqa: PLC0415 (--help does not need it)

    manifest: dict[str, Any] = dict(run.field.manifest)
    statistics = manifest["statistics"]
    storage = manifest["form"]
    table = Table.grid(Column(), Column(overflow="fold"), padding=(0, 2))
    unseen = f"{statistics['zero_evidence_share']:.1%} are visible in no image, or only outside of regions"
    table.add_row("Gaussians", f"{statistics['gaussians']:,}; {unseen}")
    if statistics["excluded"] > 0:
        table.add_row("not rendered", f"{statistics['excluded']:,} with non-finite or out-of-range parameters")
    if statistics["left_out"] > 0:
        count = statistics["left_out"]
        table.add_row("left out", f"{count} image{'s' * (count != 1)} without features")
    features = manifest["features"]
    kind = features["kind"] if "kind" in features else features["regions"]["kind"]
    table.add_row("2D features", kind if (encoder := encoder_name(run.field)) is None else f"{encoder}, {kind}")
    if "consensus" in statistics:
        consensus = statistics["consensus"]
        levels = (describe_consensus(agreement, consensus["least"], kind) for agreement in consensus["agreement"])
        table.add_row("consensus", "; ".join(levels))
    if "recognition" in statistics:
        from normlift_ns.planning import describe_recognition  # noqa: PLC0415 (torch is loaded by now)

        table.add_row("left-out views", describe_recognition(statistics["recognition"]))
    table.add_row("reliability R", describe_reliability(statistics["reliability_quantiles"]))
    if "refined_share" in statistics:
        unsupported = f"{statistics['unsupported_share']:.1%} have no direction and no neighbor with one"
        refined = f"{statistics['changed_share']:.1%} of the directions changed by more than 11 degrees"
        table.add_row("refined", f"{refined}; {unsupported}")
    seconds = {**before, **run.seconds}
    seconds |= {"other": total - sum(seconds.values())}
    stages = ", ".join(f"{name} {t:.1f}" for name, t in seconds.items() if round(t, 1) > 0)
    table.add_row("time", f"{total:.1f} s: {stages}")
    cost = manifest["cost"]
    gpu = f", GPU {cost['gpu_memory_gib']:.2f} GiB" if "gpu_memory_gib" in cost else ""
    if "memory_gib" in cost:
        table.add_row("peak memory", f"{cost['memory_gib']:.2f} GiB{gpu}")
    sizes = {name: f"{name} {form['bytes'] / 1e6:.1f} MB" for name, form in manifest["forms"].items()}
    error = f"cosine error at most {manifest['forms'][storage]['bound']:.1e}"
    table.add_row("stored as", f"{sizes.pop(storage)}, {error}")
    table.add_row("", "instead of " + ", ".join(sizes.values()))
    table.add_row("run", common.plain_text(run.folder))
    return Group(Text("Lifted", style="bold green"), table, Text("Search the run with:"))


def next_command(config: Path, queries: tuple[str, ...]) -> str:
    """Return the query command to type after a lift.

    >>> next_command(Path("a b/config.yml"), ("red mug",))
    "ns-normlift-query --load-config 'a b/config.yml' --text 'red mug'"
    """
    rest = f"--text {shlex.quote(queries[0])}" if len(queries) > 0 else "--interactive"
    return f"ns-normlift-query --load-config {shlex.quote(str(config))} {rest}"


def describe_reliability(quantiles: dict[str, float]) -> str:
    """Describe quantiles of the reliability of the Gaussians with a direction.

    >>> describe_reliability({"0.05": 0.21, "0.5": 0.68, "0.95": 0.93})
    'of the Gaussians with a direction, half are above 0.68 and 95% above 0.21; 1 means that many views agree'
    """
    values = {float(q): value for q, value in quantiles.items()}
    if not {0.05, 0.5} <= values.keys():
        return "no Gaussian has a direction"
    return (
        f"of the Gaussians with a direction, half are above {values[0.5]:.2f} and 95% above {values[0.05]:.2f}; "
        "1 means that many views agree"
    )


def describe_consensus(agreement: float, least: float, kind: str) -> str:
    """Describe the effect of the consensus on one level of regions.

    Args:
        agreement: Agreement B of the regions of the level across views, in 0..1.
        least: Value of --consensus-min-agreement.
        kind: Kind of regions, such as sam or superpixel.

    >>> describe_consensus(0.3, 0.4, "superpixel")
    'agreement 0.30, which does not exceed the limit 0.40, so features stay unchanged'
    >>> describe_consensus(0.3, 0.4, "files").split("; ")[1]
    'if the regions are rough masks of objects, try --consensus-min-agreement 0'
    >>> describe_consensus(0.0, 0.0, "sam")
    'agreement 0.00, which does not exceed the limit 0.00, so features stay unchanged'
    """
    from normlift_ns.core.consensus import AGREEMENT_RAMP  # noqa: PLC0415 (torch is loaded by now)

    if agreement > least:
        extent = "applied" if agreement >= least + AGREEMENT_RAMP else "applied in part"
        return f"agreement {agreement:.2f}, {extent}"
    unchanged = f"agreement {agreement:.2f}, which does not exceed the limit {least:.2f}, so features stay unchanged"
    if kind in ("superpixel", "grid", "patches") or least == 0:
        return unchanged
    return f"{unchanged}; if the regions are rough masks of objects, try --consensus-min-agreement 0"


def entrypoint() -> None:
    """Run ns-normlift, and return to the caller if it succeeds."""
    common.run_command(NormLift)


if __name__ == "__main__":
    common.run_command_process(NormLift)
