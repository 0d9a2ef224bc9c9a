"""ns-normlift-export: a lifted run as a PLY file of Gaussians and a table of objects."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from rich.table import Table

from normlift_ns.core.files import refuse_existing
from normlift_ns.errors import InputError
from normlift_ns.options import FLOATER_LIMIT, MIN_SIZE, REACH, AskOptions
from normlift_ns.ranges import check_device, check_options, check_texts
from normlift_ns.scripts.early import check_lifted, has_question, writable_file
from normlift_ns.scripts.shared import CONSOLE, plain, run_command, run_process, say, say_opening


@dataclass
class NormLiftExport:
    """Write a lifted run, what a query selects in it, or the scene without that, for other splat tools."""

    load_config: Path
    """Path to config YAML file of the lifted run."""
    output_dir: Path
    """Folder to write to; made if missing."""
    text: tuple[str, ...] = ()
    """What to look for. By default the queries stored in the run, with the options stored with them."""
    part: Literal["scene", "selection", "rest", "clean"] = "scene"
    """scene: all Gaussians. selection: what any of the texts selects. rest: the scene without that. clean: the scene
    without likely floaters, Gaussians that hang free before the cameras."""
    ask: AskOptions = field(default_factory=AskOptions)
    output_filename: str = "splat.ply"
    """Name of the PLY file. The number of each Gaussian in the run goes to <name>_rows.npy, the objects to
    <name>_objects.json."""
    reach: float = REACH
    """Gaussians of one object are at most this far apart, in units of the selection's median spacing."""
    min_size: int = MIN_SIZE
    """Least number of Gaussians of an object."""
    floater_limit: float = FLOATER_LIMIT
    """Score above which a Gaussian is a likely floater, for --part clean. Higher: fewer are left out."""
    overwrite: bool = False
    """Replace files of these names."""
    data: Path | None = None
    """Where the dataset is now, if it was moved."""
    device: str = "auto"
    """Where the text encoder runs: auto, cpu or cuda."""

    def __post_init__(self) -> None:
        check_options(self)

    def main(self) -> Path:
        """Writes the files; returns the path of the PLY file."""
        check_device(self.device)
        check_texts("text", self.text)
        check_lifted(self.load_config, self.data, self.ask if len(self.text) > 0 else None)
        if self.part in ("selection", "rest") and len(self.text) == 0 and not has_question(self.load_config):
            raise InputError(f"--part {self.part} needs something to look for: give --text, the run stores no queries.")
        name = Path(self.output_filename).name
        if name == "":
            raise InputError("--output-filename is empty; give the name of a PLY file, such as splat.ply")
        target = self.output_dir / name
        files = (target, *(target.with_name(f"{target.stem}_{name}") for name in ("rows.npy", "objects.json")))
        refuse_existing(*files, overwrite=self.overwrite, instead="--output-dir or --output-filename")
        for file in files:
            writable_file(file, "--output-dir")
        say_opening(self.load_config)
        from normlift_ns.front_door import open_run  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.objects import find_objects  # noqa: PLC0415

        run = open_run(
            self.load_config,
            data=self.data,
            device=self.device,
            text_vectors=self.ask.text_vectors,
            text_template=self.ask.text_template,
        )
        answer = run.ask(*self.text, **self.ask.rules()) if len(self.text) > 0 else run.ask_stored()
        part = None if answer is None or self.part == "scene" else answer.mask
        part = ~part if part is not None and self.part == "rest" else part
        if self.part == "clean":
            floaters = run.floaters(self.floater_limit).mask
            part = ~floaters
            say(f"{int(floaters.sum()):,} likely floaters are left out")
        objects: dict[str, Any] | None = None
        if answer is not None:
            limits, question = {"reach": self.reach, "min_size": self.min_size}, answer.question
            tables = [
                {"text": found.text, **find_objects(run.field, answer.means, found.mask, **limits).to_json()}
                for found in answer
            ]
            objects = {
                "queries": tables,
                "relevancy": question.rule,
                "threshold": question.threshold,
                "min_reliability": question.min_reliability,
            }
        rows = run.export(target, part, answer=answer, objects=objects, overwrite=self.overwrite)
        say(f"{len(rows):,} of {len(run.scene.gaussians):,} Gaussians in {target}")
        if objects is not None:
            CONSOLE.print(_table(objects["queries"]))
        return target


def _table(tables: list[dict[str, Any]]) -> Table:
    table = Table("text", "object", title="Objects")
    for name in ("Gaussians", "centroid", "size of the box", "mean reliability"):
        table.add_column(name, justify="right")
    for entry in tables:
        for i, found in enumerate(entry["objects"]):
            box = found["box"]
            sides = (high - low for low, high in zip(box["min"], box["max"]))
            vectors = (" ".join(f"{x:.2f}" for x in row) for row in (found["centroid"], sides))
            numbers = (f"{found['size']:,}", *vectors, f"{found['mean_reliability']:.3f}")
            table.add_row(plain(entry["text"] if i == 0 else ""), str(i), *numbers)
        table.add_row(
            plain("" if entry["objects"] else entry["text"]), "smaller", f"{entry['in_smaller_parts']:,}", "", "", ""
        )
    return table


def entrypoint() -> None:
    """ns-normlift-export, in a process that goes on."""
    run_command(NormLiftExport)


def main() -> None:
    """Entry point of ns-normlift-export."""
    run_process(NormLiftExport)


if __name__ == "__main__":
    main()
