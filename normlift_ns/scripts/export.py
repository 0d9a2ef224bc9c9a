"""ns-normlift-export: a lifted run as a PLY file of Gaussians and a table of objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from rich.table import Table

from normlift_ns.core.files import refuse_existing
from normlift_ns.errors import InputError
from normlift_ns.options import ARRAY_FILES, FLOATER_LIMIT, MIN_SIZE, REACH, TRANSFER_DISTANCE, AskOptions
from normlift_ns.ranges import check_device, check_options, check_texts
from normlift_ns.scripts.early import check_lifted, has_question, readable_file, writable_file, writable_folder
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
    """Name of the PLY file. The number of each Gaussian in the run goes to <name>_rows.npy, what class_id and
    instance_id mean to <name>_names.json, the objects to <name>_objects.json."""
    masks_dir: Path | None = None
    """Write masks of every training photograph into this folder, as PNG: 255 where it shows what the texts select,
    else 0. With --part rest the other way round. Lens distortion is taken out, as the scene was trained."""
    arrays_dir: Path | None = None
    """Write the Gaussians of the PLY file as arrays into this folder: coord.npy, segment.npy and instance.npy, in which
    -1 is ignored, and names.json."""
    transfer: Path | None = None
    """Point cloud or mesh (PLY) to label: <name of the cloud>_labels.ply is the same with class_id, instance_id and
    relevancies of the Gaussian whose centre is nearest, of those that are ever drawn; 0 where it is too far."""
    transfer_distance: float = TRANSFER_DISTANCE
    """For --transfer: how far a point may be from the centre of its Gaussian, in units of the median distance from a
    Gaussian to the nearest one at another place."""
    transfer_coordinates: Literal["capture", "scene"] = "capture"
    """For --transfer: those of the cloud. capture: of the cameras before nerfstudio turned and scaled them. scene: of
    the Gaussians, as in exported files."""
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
        ends = ("rows.npy", "names.json", "objects.json")
        files = (target, *(target.with_name(f"{target.stem}_{name}") for name in ends))
        refuse_existing(*files, overwrite=self.overwrite, instead="--output-dir or --output-filename")
        for file in files:
            writable_file(file, "--output-dir")
        self._check_beside(files)
        say_opening(self.load_config)
        from normlift_ns.front_door import open_run  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.objects.instances import tabulate  # noqa: PLC0415
        from normlift_ns.runs.splats import instances_of  # noqa: PLC0415
        from normlift_ns.runs.transfer import check_free, read_cloud  # noqa: PLC0415
        from normlift_ns.scripts.answers import beside  # noqa: PLC0415
        from normlift_ns.viewer.pictures import mask_files  # noqa: PLC0415

        cloud = None if self.transfer is None else read_cloud(self.transfer)
        run = open_run(
            self.load_config,
            data=self.data,
            device=self.device,
            text_vectors=self.ask.text_vectors,
            text_template=self.ask.text_template,
        )
        if self.masks_dir is not None:
            refuse_existing(*mask_files(run.scene, self.masks_dir), overwrite=self.overwrite, instead="--masks-dir")
        answer = run.ask(*self.text, **self.ask.rules()) if len(self.text) > 0 else run.ask_stored()
        part = None if answer is None or self.part == "scene" else answer.mask
        part = ~part if part is not None and self.part == "rest" else part
        if self.part == "clean":
            floaters = run.floaters(self.floater_limit).mask
            part = ~floaters
            say(f"{int(floaters.sum()):,} likely floaters are left out")
        objects: dict[str, Any] | None = None
        instances = None
        if answer is not None:
            limits, question = {"reach": self.reach, "min_size": self.min_size}, answer.question
            instances = instances_of(answer, **limits)
            objects = {
                "queries": tabulate(run.field, answer.means, instances),
                "relevancy": question.rule,
                "threshold": question.threshold,
                "min_reliability": question.min_reliability,
            }
            if cloud is not None:  # before anything is written
                texts = range(len(objects["queries"]))
                check_free(cloud, ("class_id", "instance_id", *(f"relevancy_{i}" for i in texts)))
        rows = run.export(
            target, part, answer=answer, objects=objects, reach=self.reach, min_size=self.min_size,
            overwrite=self.overwrite,
        )  # fmt: skip
        say(f"{len(rows):,} of {len(run.scene.gaussians):,} Gaussians in {target}")
        if answer is not None and instances is not None:
            if self.masks_dir is not None:
                beside.masks(run, answer.mask, self.masks_dir, rest=self.part == "rest", overwrite=self.overwrite)
            if self.arrays_dir is not None:
                beside.arrays(run, instances, rows, self.arrays_dir, overwrite=self.overwrite)
            if cloud is not None:
                reach, given = self.transfer_distance, self.transfer_coordinates
                beside.transfer(run, answer, instances, cloud, self._labelled, reach, given, overwrite=self.overwrite)
        if objects is not None:
            CONSOLE.print(_table(objects["queries"]))
        return target

    @property
    def _labelled(self) -> Path:
        """The cloud with its labels."""
        return self.output_dir / f"{Path() if self.transfer is None else self.transfer.stem}_labels.ply"

    def _check_beside(self, files: Sequence[Path]) -> None:
        """Raises what can be told of masks, arrays and clouds before anything is loaded."""
        for name in ("masks_dir", "arrays_dir", "transfer"):
            if getattr(self, name) is None:
                continue
            flag = f"--{name.replace('_', '-')}"
            if len(self.text) == 0 and not has_question(self.load_config):
                raise InputError(f"{flag} needs something to look for: give --text, the run stores no queries.")
            if name != "transfer":
                writable_folder(getattr(self, name), flag)
        if self.masks_dir is not None and self.part == "clean":
            raise InputError("--masks-dir is of what the texts select, or with --part rest of all else; not of clean")
        if self.arrays_dir is not None:
            found = [self.arrays_dir / name for name in ARRAY_FILES]
            refuse_existing(*found, overwrite=self.overwrite, instead="--arrays-dir")
        if self.transfer is not None:
            readable_file(self.transfer, "--transfer")
            if self._labelled in files:
                raise InputError(f"{self._labelled} would be the splat and the labelled cloud; --output-filename")
            writable_file(self._labelled, "--output-dir")
            refuse_existing(self._labelled, overwrite=self.overwrite, instead="--output-dir")


def _table(tables: list[dict[str, Any]]) -> Table:
    table = Table("text", "object", title="Objects, in scene units")
    for name in ("Gaussians", "centroid", "size of the box", "mean reliability"):
        table.add_column(name, justify="right", overflow="fold")
    for entry in tables:
        for i, found in enumerate(entry["objects"]):
            box = found["box"]
            sides = (high - low for low, high in zip(box["min"], box["max"]))
            vectors = (" ".join(f"{x:.2f}" for x in row) for row in (found["centroid"], sides))
            numbers = (f"{found['size']:,}", *vectors, f"{found['mean_reliability']:.3f}")
            table.add_row(plain(entry["text"] if i == 0 else ""), str(found["instance_id"]), *numbers)
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
