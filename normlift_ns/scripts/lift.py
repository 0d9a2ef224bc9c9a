"""ns-normlift: give a trained splatfacto run semantics that can be asked."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.panel import Panel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from normlift_ns.encoders.build import SourceOptions, make_source
from normlift_ns.plugin.asking import encoder_settings, pose
from normlift_ns.plugin.lifting import Export, LiftOptions, LiftResult, Report, lift_run
from normlift_ns.scripts.shared import CONSOLE, choose_device, run_command


@dataclass
class NormLift:
    """Lift 2D features onto the Gaussians of a trained splatfacto run, without training."""

    load_config: Path
    """Path to config YAML file of the trained run."""
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
    """Write regions and features of all images into this folder too, in the format of LangSplat's preprocessing."""
    source: SourceOptions = field(default_factory=SourceOptions)
    options: LiftOptions = field(default_factory=LiftOptions)

    def main(self) -> Path:
        """Lifts, and returns the directory of the new run."""
        start = time.perf_counter()
        device = choose_device(self.device)
        source = make_source(self.source, device)
        texts = source.text(self.queries) if len(self.queries) > 0 else None

        from normlift_ns.plugin.adapters import load_run  # noqa: PLC0415 (nerfstudio takes 20 s; mistakes show before)
        from normlift_ns.plugin.run_dir import run_directory, write_run  # noqa: PLC0415

        run = load_run(self.load_config, data=self.data, load_step=self.load_step)
        target = run_directory(run, output_dir=self.output_dir, timestamp=self.timestamp)
        if target.exists() and not self.overwrite:
            raise FileExistsError(f"{target} exists; give another --timestamp or --output-dir, or --overwrite True.")
        CONSOLE.print(f"{len(run.scene):,} Gaussians, {len(run.train)} training views, on {device}")
        export = None if self.export_langsplat is None else Export(self.export_langsplat, self.overwrite)
        with progress_bars() as report:
            result = lift_run(
                run,
                source,
                self.options,
                target.parent / ".cache",
                device=device,
                encoder=encoder_settings(self.source),
                export=export,
                report=report,
            )
        if texts is not None and texts.shape[1] != result.field.dimension:
            raise ValueError(
                f"the vectors of --queries have {texts.shape[1]} numbers, the features {result.field.dimension}; name "
                "the model that made the features with --encoder-model and --encoder-pretrained, or give "
                "--text-vectors"
            )
        question = None if texts is None else pose(result.field, source, self.queries)
        written = write_run(
            run,
            result.field,
            question=question,
            output_dir=self.output_dir,
            timestamp=target.name,
            overwrite=self.overwrite,
        )
        CONSOLE.print(summary(result, written, time.perf_counter() - start, self.queries))
        return written


@contextmanager
def progress_bars() -> Iterator[Report]:
    """One bar per stage, with the time left."""
    names = {
        "features": "2D features",
        "lift": "lift, reliability",
        "neighbors": "neighbours",
        "store": "choosing the form",
    }
    columns = (TextColumn("{task.description:>17}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=CONSOLE) as progress:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(names.get(stage, stage), total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield report


def summary(result: LiftResult, run_dir: Path, total: float, queries: tuple[str, ...]) -> Panel:
    """The panel at the end: what was found, what it took, where it lies and what to type next."""
    facts: dict[str, Any] = dict(result.field.manifest)
    numbers = facts["statistics"]
    chosen = facts["forms"][facts["form"]]
    table = Table.grid(padding=(0, 2))
    quantiles = "  ".join(f"{float(q):.0%} {value:.2f}" for q, value in numbers["reliability_quantiles"].items())
    table.add_row("Gaussians", f"{numbers['gaussians']:,}, without evidence {numbers['zero_evidence_share']:.1%}")
    if numbers["excluded"] > 0:
        table.add_row("not drawn", f"{numbers['excluded']:,} with non-finite parameters")
    if numbers["left_out"] > 0:
        table.add_row("left out", f"{numbers['left_out']} images without features")
    features = facts["features"]
    table.add_row("2D features", features["kind"] if "kind" in features else features["regions"]["kind"])
    table.add_row("reliability R", quantiles)
    if "refined_share" in numbers:
        lost = f"{numbers['unsupported_share']:.1%} without any reliable neighbour"
        table.add_row("refined", f"{numbers['refined_share']:.1%} of Gaussians; {lost}")
    table.add_row(
        "seconds", "  ".join(f"{name} {t:.1f}" for name, t in result.seconds.items()) + f"  total {total:.1f}"
    )
    cost = facts["cost"]
    gpu = f", GPU {cost['gpu_memory_gib']:.2f} GiB" if "gpu_memory_gib" in cost else ""
    table.add_row("peak memory", f"{cost['memory_gib']:.2f} GiB{gpu}")
    table.add_row("stored as", f"{facts['form']}, {chosen['bytes'] / 1e6:.1f} MB, cosines within {chosen['bound']:.1e}")
    others = (f"{name} {form['bytes'] / 1e6:.1f} MB" for name, form in facts["forms"].items() if name != facts["form"])
    table.add_row("", "instead of " + ", ".join(others))
    table.add_row("run", str(run_dir))
    text = queries[0] if len(queries) > 0 else "…"
    table.add_row("next", f'ns-normlift-query --load-config {run_dir / "config.yml"} --text "{text}"')
    return Panel(table, title="[bold][green]:tada: Lifted :tada:", expand=False)


def entrypoint() -> None:
    """Entry point of ns-normlift."""
    run_command(NormLift)


if __name__ == "__main__":
    entrypoint()
