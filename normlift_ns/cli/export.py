"""ns-normlift-export: write a lifted run as a splat file and a table of objects."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.table import Table

from normlift_ns import options
from normlift_ns.cli import common, preflight
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import refuse_existing
from normlift_ns.io.run_dir import FIELD_FOLDER

if TYPE_CHECKING:
    from jaxtyping import Bool
    from plyfile import PlyData
    from torch import Tensor

    from normlift_ns.exports import ExportJob
    from normlift_ns.lifted_run import LiftedRun
    from normlift_ns.query.engine import Answer


@options.renamed(
    part="select", reach="object_max_gap", min_size="object_min_gaussians", floater_limit="floater_threshold"
)
@dataclass
class NormLiftExport(options.CheckedOptions):
    """Export a lifted run, a selection of its Gaussians, or the rest of the scene, as files for other splat tools."""

    load_config: Path
    """Path to the config.yml file of the lifted run."""
    output_dir: Path
    """Output folder. The command creates it if it is missing."""
    text: tuple[str, ...] = ()
    """Prompts to search for. Commas and semicolons separate prompts, except between double quotes. Without prompts, the
    command uses the queries stored in the run, if there are any, with their options."""
    select: Literal["scene", "selection", "rest", "clean"] = "scene"
    """Gaussians to export. scene: all. selection: those that any prompt selects. rest: those that no prompt selects.
    clean: all except likely floaters, which float in front of the cameras instead of belonging to a surface. Exports
    always leave out invisible Gaussians, whose opacity is below 1/255 or whose parameters are not finite."""
    ask: options.AskOptions = field(default_factory=options.AskOptions)
    output_filename: str = "splat.ply"
    """Name of the splat file. Its ending selects the format: .ply, .compressed.ply, .glb or .spz. The command also
    writes <name>_rows.npy, the index in the run of each exported Gaussian. With prompts, given or stored, it also
    writes <name>_names.json (names of class_id and instance_id) and <name>_objects.json (objects)."""
    coordinates: Literal["scene", "capture"] = "scene"
    """Coordinate system of the exported Gaussians and objects. scene: that of the trained Gaussians and of viewers.
    capture: that of the original cameras, before the training rotated and scaled them."""
    masks_dir: Path | None = None
    """Folder for a PNG mask of each training image, with 255 for pixels that mostly show selected Gaussians, else 0.
    --select rest swaps the values. The masks fit the undistorted images that the scene was trained with."""
    arrays_dir: Path | None = None
    """Folder for the exported Gaussians as arrays: coord.npy, segment.npy, instance.npy and names.json. Classes and
    objects are numbered from 0; -1 marks Gaussians without a class or an object."""
    exporters: tuple[str, ...] = ()
    """Further outputs: ply, compressed_ply, glb, spz (version 3), spz4 (version 4), or exporters of other packages.
    Each exporter writes <name>_<exporter> with its own suffix to the output folder."""
    transfer: Path | None = None
    """PLY point cloud or mesh to label. The command writes a copy, <name of the cloud>_labels.ply, with the class_id,
    instance_id and relevancies of the nearest visible Gaussian. They are 0 if no Gaussian is within
    --transfer-distance."""
    transfer_distance: float = options.MAX_TRANSFER_DISTANCE
    """Maximum distance from a point to the center of its Gaussian for --transfer, > 0. Larger values label more points.
    The unit is the median distance from a Gaussian to the nearest one at another position."""
    transfer_coordinates: Literal["capture", "scene"] = "capture"
    """Coordinate system of the cloud for --transfer. capture: that of the original cameras, before the training rotated
    and scaled them. scene: that of the trained Gaussians."""
    object_max_gap: float = options.OBJECT_MAX_GAP
    """Maximum gap between Gaussians of one object, > 0, in units of the median spacing of the Gaussians that its prompt
    selects. Larger values merge more objects."""
    object_min_gaussians: int = options.OBJECT_MIN_GAUSSIANS
    """Minimum number of Gaussians in an object, at least 1. Larger values list fewer objects."""
    floater_threshold: float = options.FLOATER_THRESHOLD
    """Floater score above which --select clean leaves out a Gaussian. Larger values leave out fewer Gaussians."""
    overwrite: bool = False
    """Replace existing files of the same names."""
    data: Path | None = None
    """Current path of the dataset, if it was moved."""
    device: str = "auto"
    """Device for the text encoder: auto, cpu, cuda, or one GPU such as cuda:1."""

    def main(self) -> Path:
        """Write the files and return the path of the splat file."""
        options.check_device(self.device)
        options.check_prompt_list("text", self.text)
        preflight.check_lifted_run(self.load_config, self.data, self.ask if len(self.text) > 0 else None)
        outputs = self._outputs()
        self._check_outputs(outputs)
        common.info_opening(self.load_config)
        from normlift_ns.exports import EXPORTERS, read_cloud  # noqa: PLC0415
        from normlift_ns.lifted_run import open_run  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.rendering.figures import mask_files  # noqa: PLC0415

        cloud = None if self.transfer is None else read_cloud(self.transfer)
        run = open_run(self.load_config, data=self.data, device=self.device, **self.ask.encoding())
        if self.masks_dir is not None:
            refuse_existing(*mask_files(run.scene, self.masks_dir), overwrite=self.overwrite, flags="--masks-dir")
        job = self._job(run, cloud)
        for kind, path in outputs.items():
            for line in EXPORTERS.load(kind).write(job, path):
                common.info(line)
        if job.objects is not None:
            common.CONSOLE.print(_objects_table(job.objects["queries"], self.coordinates))
        return outputs["ply"]

    def _job(self, run: LiftedRun, cloud: PlyData | None) -> ExportJob:
        """Return the job with the Gaussians to export and the answer to the prompts."""
        from normlift_ns import exports  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.analysis.objects import object_tables  # noqa: PLC0415
        from normlift_ns.query.question import split_texts  # noqa: PLC0415

        prompts = split_texts("--text", self.text)
        answer = run.ask(*prompts, **self.ask.rules()) if len(prompts) > 0 else run.ask_stored()
        to_capture = run.to_capture if self.coordinates == "capture" else None
        job = exports.ExportJob(
            run.scene, run.field, self._keep(run, answer), rest=self.select == "rest", overwrite=self.overwrite,
            to_capture=to_capture,
        )  # fmt: skip
        if answer is None:
            return job
        instances = exports.answer_instances(answer, self.object_max_gap, self.object_min_gaussians)
        means = job.splat.parameters["means"] if to_capture is not None else answer.means
        settings = {**answer.question.settings(), "coordinates": self.coordinates}
        objects = {"queries": object_tables(run.field, means, instances), **settings}
        transfer = None
        if cloud is not None:
            names = [*exports.INSTANCE_PROPERTIES, *(f"relevancy_{i}" for i in range(len(answer.texts)))]
            exports.check_no_properties(cloud, names)
            to_cloud = run.to_capture if self.transfer_coordinates == "capture" else None
            transfer = exports.CloudTransfer(cloud, self.transfer_distance, to_cloud)
        return replace(job, answer=answer, instances=instances, objects=objects, transfer=transfer)

    def _keep(self, run: LiftedRun, answer: Answer | None) -> Bool[Tensor, " n"]:
        """Return a mask of the Gaussians that --select exports."""
        import torch  # noqa: PLC0415 (--help should not wait for it)

        if self.select == "clean":
            floaters = run.floaters(self.floater_threshold).mask
            common.info(f"Likely floaters that are left out: {int(floaters.sum()):,}")
            return ~floaters
        if answer is None or self.select == "scene":
            return torch.ones(len(run.field), dtype=torch.bool)
        return answer.mask if self.select == "selection" else ~answer.mask

    def _outputs(self) -> dict[str, Path]:
        """Return the paths of all outputs, keyed by exporter."""
        name = self.output_filename
        if name in ("", "..") or Path(name).name != name:
            raise InputError(
                f"--output-filename {name!r} is not a valid file name; give a name without folders, such as splat.ply"
            )
        target = self.output_dir / name
        cloud = None if self.transfer is None else self.output_dir / f"{self.transfer.stem}_labels.ply"
        paths = {"ply": target, "masks": self.masks_dir, "arrays": self.arrays_dir, "cloud": cloud}
        outputs = {kind: path for kind, path in paths.items() if path is not None}
        for kind in self.exporters:
            from normlift_ns.exports import EXPORTERS  # noqa: PLC0415 (imports torch)

            outputs[kind] = target.with_name(f"{target.stem}_{kind}{EXPORTERS.load(kind).suffix}")
        return outputs

    def _check_outputs(self, outputs: Mapping[str, Path]) -> None:
        """Raise errors about the outputs that can be detected before anything is loaded."""
        target = outputs["ply"]
        suffixes = ("rows.npy", "names.json", "objects.json")
        files = (target, *(target.with_name(f"{target.stem}_{suffix}") for suffix in suffixes))
        cloud = outputs.get("cloud")
        self._check_answer()
        if self.select != "clean":
            preflight.refuse_unused(self, ("floater_threshold",), "--select clean")
        if self.transfer is None:
            preflight.refuse_unused(self, ("transfer_distance", "transfer_coordinates"), "--transfer FILE")
        preflight.check_readable_file(self.transfer, "--transfer")
        if self.masks_dir is not None and self.select == "clean":
            raise InputError("--masks-dir does not work with --select clean; give --select selection or --select rest")
        if cloud in files:
            raise InputError(f"{cloud} would be both the splat and the labeled cloud; give another --output-filename")
        preflight.check_writable_folder(self.masks_dir, "--masks-dir")
        named = (*files, *(outputs[kind] for kind in self.exporters))
        preflight.check_new_files(*named, overwrite=self.overwrite, flags="--output-dir or --output-filename")
        preflight.check_new_files(cloud, overwrite=self.overwrite, flags="--output-dir")
        if self.arrays_dir is not None:
            arrays = (self.arrays_dir / name for name in options.LABEL_ARRAY_FILES)
            preflight.check_new_files(*arrays, overwrite=self.overwrite, flags="--arrays-dir")

    def _check_answer(self) -> None:
        """Raise InputError if an output or an option needs prompts, but none are given or stored."""
        if len(self.text) == 0:
            preflight.refuse_unused(self.ask, vars(self.ask), "--text")
        stored = Path(os.path.abspath(self.load_config)).parent / FIELD_FOLDER / "queries.safetensors"
        if len(self.text) > 0 or stored.exists():
            return
        names = ("masks_dir", "arrays_dir", "transfer")
        flags = [f"--{name.replace('_', '-')}" for name in names if getattr(self, name)]
        for kind in self.exporters:
            from normlift_ns.exports import EXPORTERS  # noqa: PLC0415 (imports torch)

            flags += [f"--exporters {kind}"] if EXPORTERS.load(kind).needs_answer else []
        if self.select in ("selection", "rest"):
            flags.insert(0, f"--select {self.select}")
        if len(flags) > 0:
            raise InputError(f"{flags[0]} needs prompts, but the run stores no queries; give prompts with --text")
        preflight.refuse_unused(self, ("object_max_gap", "object_min_gaussians"), "--text")


def _objects_table(queries: list[dict[str, Any]], coordinates: str = "scene") -> Table:
    table = Table("text", "object", title=f"Objects; positions in {coordinates} coordinates")
    for name in ("Gaussians", "centroid", "box size", "mean reliability"):
        table.add_column(name, justify="right", overflow="fold")
    for entry in queries:
        for i, item in enumerate(entry["objects"]):
            box = item["box"]
            sizes = [high - low for low, high in zip(box["min"], box["max"])]
            numbers = map(common.format_number, (item["centroid"], sizes, item["mean_reliability"]))
            text = common.plain_text(entry["text"] if i == 0 else "")
            table.add_row(text, str(item["instance_id"]), f"{item['size']:,}", *numbers)
        text = common.plain_text("" if entry["objects"] else entry["text"])
        table.add_row(text, "smaller", f"{entry['in_smaller_parts']:,}")
    return table


def entrypoint() -> None:
    """Run ns-normlift-export, and return to the caller if it succeeds."""
    common.run_command(NormLiftExport)


if __name__ == "__main__":
    common.run_command_process(NormLiftExport)
