"""ns-normlift: give a trained splatfacto run semantics that can be searched with text."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from rich.panel import Panel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from normlift_ns.errors import InputError
from normlift_ns.options import LiftOptions, SourceOptions, SplatOptions
from normlift_ns.ranges import check_device, check_options
from normlift_ns.scripts.early import (
    check_config,
    check_effect,
    check_new_run,
    check_source,
    check_splat,
    writable_folder,
)
from normlift_ns.scripts.shared import CONSOLE, plain, run_command, run_process, say

if TYPE_CHECKING:
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
    check: bool = True
    """Compare three training views with renders of the scene before the lift. False: lift whatever they say."""
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
    queries: tuple[str, ...] = ()
    """Texts to store in the run; ns-render and ns-viewer show their relevancy."""
    export_langsplat: Path | None = None
    """Write regions and features of the images that are lifted into this folder too, in the format of LangSplat's
    preprocessing."""
    source: SourceOptions = field(default_factory=SourceOptions)
    lift: LiftOptions = field(default_factory=LiftOptions)

    def __post_init__(self) -> None:
        check_options(self)

    def main(self) -> LiftedRun:
        """Lifts, and returns the new run."""
        start = time.perf_counter()
        self._check()
        say(f"Opening {self.load_config or self.load_ply or self.load_gsplat}")
        from normlift_ns.front_door import lift_run  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.lifting import Export  # noqa: PLC0415

        imported = time.perf_counter()
        opened: list[float] = []

        def tell(text: str) -> None:
            opened.append(time.perf_counter())
            say(text)

        with progress_bars() as report:
            run = lift_run(
                self._trained(),
                source=self.source,
                lift=self.lift,
                queries=self.queries,
                data=self.data,
                load_step=self.load_step,
                output_dir=self.output_dir,
                timestamp=self.timestamp,
                overwrite=self.overwrite,
                check=self.check,
                device=self.device,
                export=None if self.export_langsplat is None else Export(self.export_langsplat, self.overwrite),
                report=report,
                say=tell,
            )
        before = {"start": imported - start, "open": (opened or [imported])[0] - imported}
        CONSOLE.print(summary(run, before, time.perf_counter() - start, self.queries))
        return run

    def _check(self) -> None:
        """Raises what can be told before anything is loaded."""
        check_device(self.device)
        self._check_splat()
        if self.load_config is None:
            check_splat(self.load_ply, self.load_gsplat, self.splat)
        else:
            check_config(self.load_config, self.data, self.load_step)
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

    def _trained(self) -> Path | Scene:
        """The run, or the splat, opened."""
        splat = self.load_ply or self.load_gsplat
        if splat is None:
            return cast(Path, self.load_config)
        from normlift_ns.scenes.opening import open_splat  # noqa: PLC0415

        return open_splat(splat, self.splat, say=say)


@contextmanager
def progress_bars() -> Iterator[Report]:
    """One bar per stage, with the time left; a line per stage where nobody watches."""
    names = {
        "features": "2D features",
        "lift": "lift, reliability",
        "neighbors": "neighbours",
        "store": "choosing storage",
    }
    columns = (
        TextColumn("{task.description:>17}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    begun: set[str] = set()

    def tell(stage: str, done: int, total: int) -> None:
        if stage not in begun:
            begun.add(stage)
            say(f"{names.get(stage, stage)} …")

    if not CONSOLE.is_terminal:
        yield tell
        return
    with Progress(*columns, console=CONSOLE) as progress:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(names.get(stage, stage), total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield report


def summary(run: LiftedRun, before: dict[str, float], total: float, queries: tuple[str, ...]) -> Panel:
    """The panel at the end: what was found, what it took, where it lies and what to type next."""
    facts: dict[str, Any] = dict(run.field.manifest)
    numbers = facts["statistics"]
    chosen = facts["forms"][facts["form"]]
    table = Table.grid(padding=(0, 2))
    quantiles = "  ".join(f"{float(q):.0%} {value:.2f}" for q, value in numbers["reliability_quantiles"].items())
    table.add_row("Gaussians", f"{numbers['gaussians']:,}, without evidence {numbers['zero_evidence_share']:.1%}")
    if numbers["excluded"] > 0:
        table.add_row("not drawn", f"{numbers['excluded']:,} with parameters that are not finite or out of range")
    if numbers["left_out"] > 0:
        table.add_row("left out", f"{numbers['left_out']} images without features")
    features = facts["features"]
    table.add_row("2D features", features["kind"] if "kind" in features else features["regions"]["kind"])
    if "consensus" in numbers:
        table.add_row("consensus", "; ".join(map(consensus_of, numbers["consensus"]["agreement"])))
    table.add_row("reliability R", quantiles)
    if "refined_share" in numbers:
        lost = f"{numbers['unsupported_share']:.1%} without any reliable neighbour"
        table.add_row("copied", f"{numbers['refined_share']:.1%} of Gaussians take a neighbour's direction; {lost}")
    seconds = {**before, **run.seconds}
    seconds |= {"other": total - sum(seconds.values()), "total": total}
    table.add_row("seconds", "  ".join(f"{name} {t:.1f}" for name, t in seconds.items()))
    cost = facts["cost"]
    gpu = f", GPU {cost['gpu_memory_gib']:.2f} GiB" if "gpu_memory_gib" in cost else ""
    if "memory_gib" in cost:
        table.add_row("peak memory", f"{cost['memory_gib']:.2f} GiB{gpu}")
    table.add_row("stored as", f"{facts['form']}, {chosen['bytes'] / 1e6:.1f} MB, cosines within {chosen['bound']:.1e}")
    others = (f"{name} {way['bytes'] / 1e6:.1f} MB" for name, way in facts["forms"].items() if name != facts["form"])
    table.add_row("", "instead of " + ", ".join(others))
    table.add_row("run", plain(run.folder))
    text = queries[0] if len(queries) > 0 else "…"
    table.add_row(
        "next", plain(f"ns-normlift-query --load-config {shlex.quote(str(run.config))} --text {shlex.quote(text)}")
    )
    return Panel(table, title=Text("Lifted", style="bold green"), expand=False)


def consensus_of(agreement: float) -> str:
    """What the consensus found in a level of regions.

    >>> consensus_of(0.3)
    'regions overlap by chance (agreement 0.30 of 0.40 at least), features stay as they were'
    """
    from normlift_ns.core.consensus import CHANCE, THINGS  # noqa: PLC0415 (torch is there by now)

    found = f"agreement {agreement:.2f}"
    if agreement <= CHANCE:
        return f"regions overlap by chance ({found} of {CHANCE:.2f} at least), features stay as they were"
    return f"{found}, features agreed" if agreement >= THINGS else f"{found}, features agreed in part"


def entrypoint() -> None:
    """ns-normlift, in a process that goes on."""
    run_command(NormLift)


def main() -> None:
    """Entry point of ns-normlift."""
    run_process(NormLift)


if __name__ == "__main__":
    main()
