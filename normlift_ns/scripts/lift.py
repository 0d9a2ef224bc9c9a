"""ns-normlift: give a trained splatfacto run semantics that can be searched with text."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from rich.console import Group
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

from normlift_ns.errors import InputError
from normlift_ns.options import LiftOptions, SourceOptions, SplatOptions
from normlift_ns.ranges import check_device, check_number, check_options
from normlift_ns.scripts import terminal
from normlift_ns.scripts.early import (
    check_config,
    check_effect,
    check_new_run,
    check_source,
    check_splat,
    readable_file,
    writable_folder,
)
from normlift_ns.scripts.several import in_team
from normlift_ns.scripts.shared import (
    CONSOLE,
    STAGES,
    plain,
    run_command,
    run_process,
    say,
    say_error,
    say_progress,
)
from normlift_ns.team.launch import rank_of, start

if TYPE_CHECKING:
    from normlift_ns.core.portions import Team
    from normlift_ns.core.scene import Scene
    from normlift_ns.lifted_run import LiftedRun
    from normlift_ns.stages import Report


@dataclass
class NormLift:
    """Lift 2D features onto the Gaussians of a trained splat, without training: a splatfacto run, a PLY file or a
    checkpoint of gsplat's trainer."""

    load_config: Path | None = None
    """Path to config YAML file of the trained run."""
    load_ply: Path | None = None
    """Instead of --load-config: PLY file of a splat, with --colmap or --transforms."""
    load_gsplat: Path | None = None
    """Instead of --load-config: checkpoint of gsplat's simple_trainer, ckpt_<step>_rank0.pt, with --colmap."""
    splat: SplatOptions = field(default_factory=SplatOptions)
    add_images: Path | None = None
    """Photographs that were taken after the training: the folder of a COLMAP project, or a transforms.json, that names
    them beside the old ones, whose cameras must not have moved. New ones are lifted too."""
    check: bool = True
    """Compare three training views with renders of the scene before the lift. False: lift whatever they say."""
    dry_run: bool = False
    """Print what the lift will take, and lift nothing: seconds of every stage, from a few photographs that are looked
    at for real, memory, disk, and what is cached."""
    data: Path | None = None
    """Where the dataset is now, if it was moved since training."""
    load_step: int | None = None
    """Training step of the checkpoint; the last one by default."""
    output_dir: Path | None = None
    """Replaces the run's own outputs folder."""
    timestamp: str | None = None
    """Name of the new run directory; the present time by default."""
    overwrite: bool = False
    """Replace a run directory of that name, and exported files of other content."""
    device: str = "auto"
    """auto, cpu or cuda."""
    num_devices: int = 1
    """Lift with so many processes on this machine, a GPU for each, or a share of the processor's cores. torchrun starts
    them on several machines."""
    queries: tuple[str, ...] = ()
    """Texts to store in the run; ns-render and ns-viewer show their relevancy."""
    export_langsplat: Path | None = None
    """Write regions and features of the images that are lifted into this folder too, in the format of LangSplat's
    preprocessing."""
    source: SourceOptions = field(default_factory=SourceOptions)
    lift: LiftOptions = field(default_factory=LiftOptions)

    def __post_init__(self) -> None:
        check_options(self)

    def main(self) -> LiftedRun | None:
        """Lifts, and returns the new run; None for a dry run, and where other processes have made the run."""
        self.check_early()
        if self.dry_run:
            self._plan()
            return None
        if self.num_devices > 1 and rank_of(os.environ) is None:
            cores = os.cpu_count() or 1
            if self.num_devices > cores:
                say(f"{self.num_devices} processes share {cores} cores: more than {cores} will hardly be faster.")
            code = start([sys.executable, "-m", "normlift_ns.scripts.lift", *sys.argv[1:]], self.num_devices, say_error)
            if code > 0:
                sys.exit(code)
            return None
        with in_team(self.device) as team:
            return self._lift(team)

    def _plan(self) -> None:
        begun = time.perf_counter()
        say_progress(f"Opening {self.load_config or self.load_ply or self.load_gsplat}")
        from normlift_ns.scripts.planned import dry_run, needs, plan_table  # noqa: PLC0415 (loads torch)

        plan = dry_run(self, begun)
        CONSOLE.print(plan_table(plan))
        say(needs(plan))

    def _lift(self, team: Team) -> LiftedRun | None:
        begun = time.perf_counter()
        say_progress(f"Opening {self.load_config or self.load_ply or self.load_gsplat}")
        from normlift_ns.front_door import opener  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.team.seen import Export  # noqa: PLC0415
        from normlift_ns.together import lift_run_together  # noqa: PLC0415

        imported = time.perf_counter()
        opened: list[float] = []

        def tell(text: str) -> None:
            opened.append(time.perf_counter())
            say_progress(text)

        with progress_bars() as report:
            trained = self.trained()
            of_run = isinstance(trained, Path)
            run = lift_run_together(
                team,
                opener(trained, self.data if of_run else None, self.load_step if of_run else None),
                source=self.source,
                features=None,
                texts=None,
                lift=self.lift,
                queries=self.queries,
                output_dir=self.output_dir,
                timestamp=self.timestamp,
                overwrite=self.overwrite,
                check=self.check,
                device=self.device,
                export=None if self.export_langsplat is None else Export(self.export_langsplat, self.overwrite),
                report=report,
                say=tell,
            )
        if run is None:
            return None
        before = {"start": imported - begun, "open": (opened or [imported])[0] - imported}
        if not terminal.now[-1].quiet:
            CONSOLE.print(summary(run, before, time.perf_counter() - begun))
        say(next_command(run.config, self.queries))
        return run

    def check_early(self) -> None:
        """Raises what can be told before anything is loaded."""
        check_device(self.device)
        check_number("num_devices", self.num_devices, int)
        if self.num_devices > 1 and ":" in self.device:
            raise InputError(f"--device {self.device} is one GPU, but --num-devices is {self.num_devices}; give cuda")
        self._check_splat()
        if self.load_config is None:
            check_splat(self.load_ply, self.load_gsplat, self.splat)
        else:
            check_config(self.load_config, self.data, self.load_step)
        if self.add_images is not None and not self.add_images.is_dir():
            readable_file(self.add_images, "--add-images")
        check_effect(self.lift)
        check_source(self.source, self.queries)
        check_new_run(self.load_config, self.splat, self.output_dir, self.timestamp, self.overwrite)
        writable_folder(self.export_langsplat, "--export-langsplat")

    def _check_splat(self) -> None:
        """Raises a ValueError unless one trained splat is given, and only options that fit it."""
        given = [path for path in (self.load_config, self.load_ply, self.load_gsplat) if path is not None]
        if len(given) != 1:
            raise InputError(
                f"Give one trained splat, got {len(given)}: --load-config with the config.yml of a splatfacto run, "
                "--load-ply with a PLY file, or --load-gsplat with a checkpoint of gsplat's trainer."
            )
        default = SplatOptions()
        if self.load_config is None:
            options, names, hint = self, ("data", "load_step"), "--load-config; for a splat see --images"
        else:
            options, names, hint = self.splat, tuple(vars(default)), "--load-ply and --load-gsplat"
        for name in names:
            if getattr(options, name) != getattr(default, name, None):
                raise InputError(f"--{name.replace('_', '-')} is for {hint}. Leave it out.")

    def trained(self) -> Path | Scene:
        """The run; or the splat, or the run with photographs that are new, opened."""
        splat = self.load_ply or self.load_gsplat
        if splat is None and self.add_images is None:
            return cast(Path, self.load_config)
        from normlift_ns.front_door import open_scene  # noqa: PLC0415 (as above)
        from normlift_ns.scenes.added import add_photographs  # noqa: PLC0415
        from normlift_ns.scenes.opening import open_splat  # noqa: PLC0415

        if splat is not None:
            scene: Any = open_splat(splat, self.splat, say=say_progress)
        else:
            scene = open_scene(cast(Path, self.load_config), data=self.data, load_step=self.load_step)
        if self.add_images is None:
            return scene
        before = len(scene.train)
        scene = add_photographs(scene, self.add_images)
        say_progress(f"{len(scene.train) - before} photographs of {self.add_images} are new, and are lifted too.")
        return scene


@contextmanager
def progress_bars() -> Iterator[Report]:
    """One bar per stage, with the time that it took so far; a line per stage where nobody watches or a log is kept."""
    names = STAGES | {"features": "2D features", "lift": "lift, reliability", "store": "choosing storage"}
    columns = (
        TextColumn("{task.description:>17}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    begun: set[str] = set()

    def tell(stage: str, done: int, total: int) -> None:
        if stage not in begun:
            begun.add(stage)
            say_progress(f"{names.get(stage, stage)} …")

    if not CONSOLE.is_terminal or terminal.now[-1] != terminal.Terminal():
        yield tell
        return
    with Progress(*columns, console=CONSOLE) as progress:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(names.get(stage, stage), total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield report


def summary(run: LiftedRun, before: dict[str, float], total: float) -> Group:
    """The table at the end: what was found, what it took and where it lies."""
    facts: dict[str, Any] = dict(run.field.manifest)
    numbers = facts["statistics"]
    chosen = facts["forms"][facts["form"]]
    table = Table.grid(Column(), Column(overflow="fold"), padding=(0, 2))
    table.add_row("Gaussians", f"{numbers['gaussians']:,}; {numbers['zero_evidence_share']:.1%} show in no image")
    if numbers["excluded"] > 0:
        table.add_row("not drawn", f"{numbers['excluded']:,} with parameters that are not finite or out of range")
    if numbers["left_out"] > 0:
        table.add_row("left out", f"{numbers['left_out']} images without features")
    features = facts["features"]
    kind = features["kind"] if "kind" in features else features["regions"]["kind"]
    table.add_row("2D features", kind)
    if "consensus" in numbers:
        found = numbers["consensus"]
        table.add_row("consensus", "; ".join(consensus_of(x, found["least"], kind) for x in found["agreement"]))
    table.add_row("reliability R", reliability_of(numbers["reliability_quantiles"]))
    if "refined_share" in numbers:
        lost = f"{numbers['unsupported_share']:.1%} have no reliable neighbour"
        table.add_row("refined", f"{numbers['refined_share']:.1%} of Gaussians took over a neighbour's feature; {lost}")
    seconds = {**before, **run.seconds}
    seconds |= {"other": total - sum(seconds.values())}
    parts = ", ".join(f"{STAGES.get(name, name)} {t:.1f}" for name, t in seconds.items() if round(t, 1) > 0)
    table.add_row("time", f"{total:.1f} s: {parts}")
    cost = facts["cost"]
    gpu = f", GPU {cost['gpu_memory_gib']:.2f} GiB" if "gpu_memory_gib" in cost else ""
    if "memory_gib" in cost:
        table.add_row("peak memory", f"{cost['memory_gib']:.2f} GiB{gpu}")
    table.add_row("stored as", f"{facts['form']}, {chosen['bytes'] / 1e6:.1f} MB, cosines within {chosen['bound']:.1e}")
    others = (f"{name} {way['bytes'] / 1e6:.1f} MB" for name, way in facts["forms"].items() if name != facts["form"])
    table.add_row("", "instead of " + ", ".join(others))
    table.add_row("run", plain(run.folder))
    return Group(Text("Lifted", style="bold green"), table, Text("Search it with:"))


def next_command(config: Path, queries: tuple[str, ...]) -> str:
    """What to type next, in one line.

    >>> next_command(Path("a b/config.yml"), ("red mug",))
    "ns-normlift-query --load-config 'a b/config.yml' --text 'red mug'"
    """
    rest = f"--text {shlex.quote(queries[0])}" if len(queries) > 0 else "--interactive"
    return f"ns-normlift-query --load-config {shlex.quote(str(config))} {rest}"


def reliability_of(quantiles: dict[str, float]) -> str:
    """Quantiles of the reliability, in words.

    >>> reliability_of({"0.05": 0.21, "0.5": 0.68, "0.95": 0.93})
    'from 0, views contradict each other, to 1, all agree: half of the Gaussians above 0.68, 95% above 0.21'
    """
    found = {float(q): value for q, value in quantiles.items()}
    if not {0.05, 0.5} <= found.keys():
        return "no Gaussian has any"
    return (
        "from 0, views contradict each other, to 1, all agree: "
        f"half of the Gaussians above {found[0.5]:.2f}, 95% above {found[0.05]:.2f}"
    )


def consensus_of(agreement: float, least: float, kind: str) -> str:
    """What the consensus found in a level of regions of a kind.

    >>> consensus_of(0.3, 0.4, "superpixel")
    'regions overlap by chance (agreement 0.30 of 0.40 at least), features stay as they were'
    >>> consensus_of(0.3, 0.4, "files").split("; ")[1]
    'if they are bad masks of things, try --consensus-least 0'
    """
    from normlift_ns.core.consensus import RISE  # noqa: PLC0415 (torch is there by now)

    found = f"agreement {agreement:.2f}"
    if agreement > least:
        return f"{found}, features agreed" if agreement >= least + RISE else f"{found}, features agreed in part"
    kept = f"regions overlap by chance ({found} of {least:.2f} at least), features stay as they were"
    if kind in ("superpixel", "grid", "patches"):
        return kept
    return f"{kept}; if they are bad masks of things, try --consensus-least 0"


def entrypoint() -> None:
    """ns-normlift, in a process that goes on."""
    run_command(NormLift)


def main() -> None:
    """Entry point of ns-normlift."""
    run_process(NormLift)


if __name__ == "__main__":
    main()
