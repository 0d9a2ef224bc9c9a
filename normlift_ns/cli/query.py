"""ns-normlift-query: search a lifted run with text prompts."""

from __future__ import annotations

import glob
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from normlift_ns.cli.common import info, info_opening, run_command, run_command_process
from normlift_ns.cli.preflight import check_distinct_paths, check_lifted_run, check_writable_file, check_writable_folder
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import atomic_file, refuse_existing, safe_file_name, write_text_file
from normlift_ns.io.run_dir import FIELD_FOLDER
from normlift_ns.options import CATALOG_FILES, DEFAULT_SAM3, AskOptions, check_device, check_options, check_prompt_list

if TYPE_CHECKING:
    from normlift_ns.query.arrays import QuickRun
    from normlift_ns.query.engine import Answer
    from normlift_ns.query.question import Query


@dataclass
class NormLiftQuery:
    """Search a lifted run with text prompts. Prints a table of the results and writes files on request."""

    load_config: Path
    """Path to config YAML file of the lifted run."""
    text: tuple[str, ...] = ()
    """One or several prompts to search for: --text mug 'red bowl'. A prompt may contain commas."""
    ask: AskOptions = field(default_factory=AskOptions)
    interactive: bool = False
    """Read prompts from the terminal, one after another, while the run stays open."""
    stdin: bool = False
    """Read one prompt per line from standard input, and print each answer as one line of JSON."""
    history: bool = True
    """Keep a history of --interactive prompts in a file that only you can read."""
    save: bool = False
    """Store the queries in the run, replacing earlier ones. ns-render and ns-viewer then render their relevancy."""
    json: Path | None = None
    """JSON file to write the table to."""
    output_path: Path | None = None
    """NPZ file to write relevancy [N, Q], reliability [N], valid [N] and names to, for N Gaussians and Q prompts."""
    render_dir: Path | None = None
    """Folder for renders of the relevancy."""
    render_views: tuple[str, ...] = ()
    """Training images whose cameras to render from, such as 0001 0042. Default: three evenly spaced images."""
    why: bool = False
    """List the images and regions that voted for the selection, and how well they agree."""
    why_dir: Path | None = None
    """Folder for the images of --why, with outlines of the regions that voted."""
    segment: Literal["sam3"] | None = None
    """Also segment some training views with SAM 3 and lift its masks. The table then has their relevancy, their
    agreement between views and their reliability."""
    segment_model: str | None = None
    """Weights of SAM 3: a folder in transformers format, or a name to download. Default: facebook/sam3."""
    segment_views: int = 8
    """Largest number of evenly spaced training views for --segment, at least 1; more views are slower and more
    reliable."""
    objects: bool = False
    """List the objects in the selection: connected groups of at least 20 Gaussians. id: instance_id in exports. text:
    prompt with the largest relevancy. Gaussians: their number. centroid: mean position, weighted by evidence. box: edge
    lengths of the oriented box, longest first. extent: size along x, y and z. Both span the 1st to 99th percentile. R:
    mean reliability. views: training images that show at least a tenth as much of the object as the best one. best
    views: three images that show it whole and large. Lengths are in capture units."""
    objects_dir: Path | None = None
    """Folder for the list of --objects with box axes, in capture and scene coordinates: objects.json, objects.csv, and
    boxes as meshes (objects.ply, objects_scene.ply). docs/objects.md explains every column."""
    metres_per_unit: float | None = None
    """Length of one capture unit in meters for --objects, > 0; positions and sizes are then in meters."""
    overwrite: bool = False
    """Replace existing files of the same names."""
    data: Path | None = None
    """Current path of the dataset, if it was moved."""
    device: str = "auto"
    """Device for the text encoder: auto, cpu or cuda."""

    def __post_init__(self) -> None:
        check_options(self)

    def main(self) -> list[dict[str, Any]]:
        """Run the query, write files, print the table and return its rows."""
        self._check()
        info_opening(self.load_config)
        from normlift_ns.cli.repl import answer_lines, run_repl  # noqa: PLC0415 (--help should not wait for NumPy)

        run = self._open()
        if self.stdin:
            answer_lines(run, self.ask.rules())
            return []
        if self.interactive:
            run_repl(run, self.ask.rules(), keep_history=self.history)
            return []
        return self._answer(run)

    def _answer(self, run: QuickRun) -> list[dict[str, Any]]:
        """Answer --text, write files, print the table and return its rows."""
        from normlift_ns.cli.repl import print_answer  # noqa: PLC0415
        from normlift_ns.query.question import save_query  # noqa: PLC0415 (--help should not wait for NumPy)

        result = run.ask(self.text, **self.ask.rules())
        save_renders = self._prepare_renders(result.question) if self.render_dir is not None else None
        rows = result.to_json()
        show_why = self._explain(result, rows) if self.why else None
        sam3_arrays, show_sam3 = self._segment(result, rows) if self.segment is not None else ({}, None)
        show_objects = self._list_objects(result.question) if self.objects else None
        if self.json is not None:
            _write_json(self.json, rows, result.question, self.overwrite)
        if self.output_path is not None:
            _write_arrays(self.output_path, result, sam3_arrays, self.overwrite)
        if save_renders is not None:
            save_renders()
        stored = save_query(run.run_dir / FIELD_FOLDER, result.question) if self.save else None
        folders = (self.render_dir, self.why_dir, self.objects_dir)
        written = [path for path in (self.json, self.output_path, *folders, stored) if path is not None]
        print_answer(rows, result.question)
        for print_table in (show_sam3, show_why, show_objects):
            if print_table is not None:
                print_table()
        if len(written) > 0:
            info("Written: " + ", ".join(map(str, written)))
        return rows

    def _open(self) -> QuickRun:
        """Open the run; load its scene only if the files of the run lack the Gaussian centers."""
        from normlift_ns.query.arrays import open_quick  # noqa: PLC0415 (as above)

        if self.device.startswith("cuda"):
            from normlift_ns.core.device import choose_device  # noqa: PLC0415 (--help should not wait for torch)

            choose_device(self.device)
        open_with = partial(
            open_quick, self.load_config, device=self.device, text_vectors=self.ask.text_vectors,
            text_template=self.ask.text_template,
        )  # fmt: skip
        run = open_with()
        if run is not None:
            return run
        from normlift_ns.lifted_run import open_run  # noqa: PLC0415 (as above)

        means = open_run(self.load_config, data=self.data).scene.gaussians.means.numpy()
        return cast("QuickRun", open_with(means=means))

    def _prepare_renders(self, question: Query) -> Callable[[], list[Path]]:
        """Load everything that renders need, and return a function that renders and saves them."""
        from normlift_ns.lifted_run import open_run  # noqa: PLC0415
        from normlift_ns.query.engine import run_query  # noqa: PLC0415 (as above)
        from normlift_ns.rasterization.settings import RasterSettings  # noqa: PLC0415
        from normlift_ns.rendering.figures import save_overlays, training_cameras  # noqa: PLC0415

        run, folder = open_run(self.load_config, data=self.data), cast(Path, self.render_dir)
        cameras = training_cameras(run.scene, self.render_views)
        result = run_query(run.field, run.scene.gaussians.means, question)
        settings = RasterSettings.recorded(run.field.manifest)
        return lambda: save_overlays(run.scene, result, cameras, folder, settings=settings, overwrite=self.overwrite)

    def _explain(self, result: Answer, rows: list[dict[str, Any]]) -> Callable[[], None]:
        """Add an explanation to every row, write the images, and return a function that prints the explanations."""
        from normlift_ns.cli.answers import explain_answer, explanation_to_json, print_explanations, save_vote_images  # noqa: PLC0415

        run, reasons = explain_answer(self.load_config, self.data, result)
        for row, reason in zip(rows, reasons):
            row["why"] = explanation_to_json(run, reason)
        if self.why_dir is not None:
            save_vote_images(run, self.text, reasons, self.why_dir, overwrite=self.overwrite)
        return lambda: print_explanations(run, self.text, reasons)

    def _segment(self, result: Answer, rows: list[dict[str, Any]]) -> tuple[dict[str, Any], Callable[[], None]]:
        """Add SAM 3's answer to every row, and return its arrays and a function that prints it."""
        from normlift_ns.cli.answers import print_sam3_table, sam3_arrays, segment_with_sam3  # noqa: PLC0415

        kwargs = {"model": self.segment_model or DEFAULT_SAM3, "views": self.segment_views, "device": self.device}
        segmented, summaries = segment_with_sam3(self.load_config, self.data, result, **kwargs)
        for row, summary in zip(rows, summaries):
            row["segment"] = summary
        return sam3_arrays(segmented), lambda: print_sam3_table(self.text, summaries)

    def _list_objects(self, question: Query) -> Callable[[], None]:
        """Find objects, write their files, and return a function that prints them."""
        from normlift_ns.analysis.objects import write_catalogue  # noqa: PLC0415 (as above)
        from normlift_ns.cli.answers import find_catalog, print_catalog, query_metadata  # noqa: PLC0415

        catalog = find_catalog(self.load_config, self.data, question, self.metres_per_unit)
        if self.objects_dir is not None:
            write_catalogue(catalog, self.objects_dir, question=query_metadata(question), overwrite=self.overwrite)
        return lambda: print_catalog(catalog)

    def _check(self) -> None:
        """Raise errors that can be detected before anything is loaded."""
        check_device(self.device)
        self._check_texts()
        check_lifted_run(self.load_config, self.data, self.ask)
        check_distinct_paths(json=self.json, output_path=self.output_path)
        for flag, path in (("--json", self.json), ("--output-path", self.output_path)):
            if path is not None:
                refuse_existing(path, overwrite=self.overwrite, flags=flag)
                check_writable_file(path, flag)
        check_writable_folder(self.render_dir, "--render-dir")
        check_writable_folder(self.why_dir, "--why-dir")
        if self.objects_dir is not None:
            check_writable_folder(self.objects_dir, "--objects-dir")
            files = [self.objects_dir / name for name in CATALOG_FILES]
            refuse_existing(*files, overwrite=self.overwrite, flags="--objects-dir")
        refuse_existing(*self._existing_renders(), overwrite=self.overwrite, flags="--render-dir")

    def _check_texts(self) -> None:
        flags = [f"--{name}" for name in ("text", "stdin", "interactive") if getattr(self, name)]
        if len(flags) == 0:
            raise InputError(
                'no prompts given; name at least one object to search for, such as --text "orange", or enter prompts '
                "one after another with --interactive"
            )
        if len(flags) > 1:
            raise InputError(f"{flags[0]} and {flags[1]} cannot be combined; leave one of them out")
        for name in ("json", "output_path", "render_dir", "save", "why", "why_dir", "segment", "objects"):
            if flags != ["--text"] and getattr(self, name):
                raise InputError(f"--{name.replace('_', '-')} works with --text only; leave it out with {flags[0]}")
        self._check_dependent_options()
        if self.interactive and not sys.stdin.isatty():
            raise InputError(
                "--interactive needs a terminal to read from; to read prompts from a file, use --stdin True"
            )
        check_prompt_list("text", self.text)

    def _check_dependent_options(self) -> None:
        if len(self.render_views) > 0 and self.render_dir is None:
            raise InputError("--render-views has no effect without --render-dir; give the folder for the renders")
        if self.why_dir is not None and not self.why:
            raise InputError("--why-dir has no effect without --why True; add that flag")
        for name in ("segment_model", "segment_views"):
            if self.segment is None and getattr(self, name) != getattr(type(self), name):
                raise InputError(f"--{name.replace('_', '-')} has no effect without --segment sam3; add that flag")
        for name in ("objects_dir", "metres_per_unit"):
            if getattr(self, name) is not None and not self.objects:
                flag = f"--{name.replace('_', '-')}"
                raise InputError(f"{flag} has no effect without --objects True; add that flag")

    def _existing_renders(self) -> list[Path]:
        """Return existing renders that new ones could replace: of the same prompts, and of --render-views if given."""
        views = [glob.escape(Path(name).stem) for name in self.render_views] or ["*"]
        views += ["contact_sheet"] if len(views) > 1 else []
        names = [f"{view}_{i}_{safe_file_name(text)}.png" for view in views for i, text in enumerate(self.text)]
        return [] if self.render_dir is None else [path for name in names for path in self.render_dir.glob(name)]


def _write_json(path: Path, rows: list[dict[str, Any]], question: Query, overwrite: bool) -> None:
    rules = {"relevancy": question.rule, "threshold": question.threshold, "negatives": list(question.negatives)}
    write_text_file(path, json.dumps({"queries": rows, **rules}, indent=2) + "\n", overwrite=overwrite)


def _write_arrays(path: Path, result: Answer, extra: dict[str, Any], overwrite: bool) -> None:
    import numpy as np  # noqa: PLC0415

    arrays: dict[str, Any] = {
        "relevancy": result.relevancy,
        "reliability": result.field.scalars.reliability,
        "valid": result.valid,
        **extra,
    }
    with atomic_file(path, overwrite=overwrite) as draft, draft.open("wb") as file:
        np.savez(file, names=np.array(result.question.texts), **arrays)


def entrypoint() -> None:
    """Run ns-normlift-query in a process that continues afterwards."""
    run_command(NormLiftQuery)


def main() -> None:
    """Run ns-normlift-query as a process."""
    run_command_process(NormLiftQuery)


if __name__ == "__main__":
    main()
