"""ns-normlift-query: ask a lifted run."""

from __future__ import annotations

import glob
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from normlift_ns.core.files import file_name, new_file, refuse_existing, write_text
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_SAM3, OBJECT_FILES, AskOptions
from normlift_ns.ranges import check_device, check_options, check_texts
from normlift_ns.runs.files import FIELD_FOLDER
from normlift_ns.scripts.early import check_lifted, different, writable_file, writable_folder
from normlift_ns.scripts.shared import run_command, run_process, say, say_opening

if TYPE_CHECKING:
    from normlift_ns.question import Question
    from normlift_ns.quick import QuickAnswer, QuickRun


@dataclass
class NormLiftQuery:
    """Search a lifted run with text: a table of what is found, and files on request."""

    load_config: Path
    """Path to config YAML file of the lifted run."""
    text: tuple[str, ...] = ()
    """What to look for, one or several texts: --text mug 'red bowl'. A text may contain commas."""
    ask: AskOptions = field(default_factory=AskOptions)
    interactive: bool = False
    """Ask text after text at a prompt; the run stays open."""
    stdin: bool = False
    """Ask every line of the standard input, and print the answer to each as one line of JSON."""
    history: bool = True
    """Keep what is asked at the prompt, in a file that only you can read."""
    save: bool = False
    """Store the queries in the run, in place of earlier ones. ns-render and ns-viewer then draw the answer."""
    json: Path | None = None
    """Write the table to this file."""
    output_path: Path | None = None
    """Write relevancy [N, Q], reliability [N], valid [N] and names to this .npz file."""
    render_dir: Path | None = None
    """Write pictures of the relevancy into this folder."""
    render_views: tuple[str, ...] = ()
    """Training images from whose cameras to render, such as 0001 0042. By default three of them, evenly spread."""
    why: bool = False
    """Say which photographs and regions voted for what is selected, and how far they agree."""
    why_dir: Path | None = None
    """With --why: write those photographs, with the outlines of the regions that voted, into this folder."""
    segment: Literal["sam3"] | None = None
    """Ask SAM 3 for the texts too, in some training views, and lift its masks: relevancy, agreement between views and
    reliability beside the answer of the run."""
    segment_model: str | None = None
    """Weights of SAM 3: a folder in the format of transformers, or a name to download. By default facebook/sam3."""
    segment_views: int = 8
    """Training views to ask SAM 3 in, at most, evenly spread."""
    objects: bool = False
    """List the objects of what is selected, connected parts of 20 Gaussians or more. id: number, the instance_id of
    ns-normlift-export. text: the one of largest relevancy. Gaussians: how many. centroid: mean place, weighted by what
    the views saw. box: lengths of the edges of the oriented box, the longest first. extent: size along x, y and z. Box
    and extent reach from the 1st to the 99th percentile. R: mean reliability. views: training photographs that show at
    least a tenth of what the best one does. best views: three that show it whole and large. In units of the
    capture."""
    objects_dir: Path | None = None
    """With --objects: write the list into this folder, with the axes of the boxes, in the coordinates of the capture
    and in those of the Gaussians: objects.json, objects.csv, and boxes as meshes, objects.ply and objects_scene.ply.
    docs/objects.md explains every column."""
    metres_per_unit: float | None = None
    """With --objects: length of one unit of the capture, so that places and sizes in it are in metres."""
    overwrite: bool = False
    """Replace files of these names."""
    data: Path | None = None
    """Where the dataset is now, if it was moved."""
    device: str = "auto"
    """Where the text encoder runs: auto, cpu or cuda."""

    def __post_init__(self) -> None:
        check_options(self)

    def main(self) -> list[dict[str, Any]]:
        """Asks, writes and prints; returns the rows of the table."""
        self._check()
        say_opening(self.load_config)
        from normlift_ns.runs.question import save_question  # noqa: PLC0415 (--help should not wait for NumPy)
        from normlift_ns.scripts.answers.prompting import answer_lines, converse, show  # noqa: PLC0415

        run = self._open()
        if self.stdin:
            answer_lines(run, self.ask.rules())
            return []
        if self.interactive:
            converse(run, self.ask.rules(), keep_history=self.history)
            return []
        found = run.ask(self.text, **self.ask.rules())
        pictured = self._pictured(found.question) if self.render_dir is not None else None
        rows = found.summarize()
        tell = self._explain(found, rows) if self.why else None
        segmented = self._segment(found, rows) if self.segment is not None else {}
        tell_objects = self._list_objects(found.question) if self.objects else None
        if self.json is not None:
            _write_json(self.json, rows, found.question, self.overwrite)
        if self.output_path is not None:
            _write_arrays(self.output_path, found, segmented, self.overwrite)
        if pictured is not None:
            pictured()
        stored = save_question(run.folder / FIELD_FOLDER, found.question) if self.save else None
        folders = (self.render_dir, self.why_dir, self.objects_dir)
        written = [path for path in (self.json, self.output_path, *folders, stored) if path is not None]
        show(rows, found.question)
        if self.segment is not None:
            from normlift_ns.scripts.answers.segmenting import show_segments  # noqa: PLC0415 (imported by now)

            show_segments(self.text, [row["segment"] for row in rows])
        for also in (tell, tell_objects):
            if also is not None:
                also()
        if len(written) > 0:
            say("Written: " + ", ".join(map(str, written)))
        return rows

    def _open(self) -> QuickRun:
        """The run, with its scene only where its own files do not tell which that is."""
        from normlift_ns.quick import open_quick  # noqa: PLC0415 (as above)

        if self.device.startswith("cuda"):
            from normlift_ns.core.gpu import choose_device  # noqa: PLC0415 (--help should not wait for torch)

            choose_device(self.device)
        opened = partial(
            open_quick, self.load_config, device=self.device, text_vectors=self.ask.text_vectors,
            text_template=self.ask.text_template,
        )  # fmt: skip
        run = opened()
        if run is not None:
            return run
        from normlift_ns.front_door import open_run  # noqa: PLC0415 (as above)

        return cast("QuickRun", opened(means=open_run(self.load_config, data=self.data).scene.gaussians.means.numpy()))

    def _pictured(self, question: Question) -> Callable[[], list[Path]]:
        """What draws the pictures; everything that they need is there when it is returned."""
        from normlift_ns.asking import answer  # noqa: PLC0415 (as above)
        from normlift_ns.front_door import open_run  # noqa: PLC0415
        from normlift_ns.raster.settings import RasterSettings  # noqa: PLC0415
        from normlift_ns.viewer.pictures import save_overlays, training_cameras  # noqa: PLC0415

        run, folder = open_run(self.load_config, data=self.data), cast(Path, self.render_dir)
        cameras = training_cameras(run.scene, self.render_views)
        found = answer(run.field, run.scene.gaussians.means, question)
        settings = RasterSettings.recorded(run.field.manifest)
        return lambda: save_overlays(run.scene, found, cameras, folder, settings=settings, overwrite=self.overwrite)

    def _explain(self, found: QuickAnswer, rows: list[dict[str, Any]]) -> Callable[[], None]:
        """Adds to every row why it is selected, and writes the pictures; returns what prints it."""
        from normlift_ns.scripts.answers.reasons import find_reasons, save_pictures, show_reasons, to_json  # noqa: PLC0415

        run, reasons = find_reasons(self.load_config, self.data, found)
        for row, reason in zip(rows, reasons):
            row["why"] = to_json(run, reason)
        if self.why_dir is not None:
            save_pictures(run, self.text, reasons, self.why_dir, overwrite=self.overwrite)
        return lambda: show_reasons(run, self.text, reasons)

    def _segment(self, found: QuickAnswer, rows: list[dict[str, Any]]) -> dict[str, Any]:
        """Adds to every row what SAM 3 answers; returns its arrays."""
        from normlift_ns.scripts.answers.segmenting import ask_sam3, segment_arrays  # noqa: PLC0415 (as above)

        how = {"model": self.segment_model or DEFAULT_SAM3, "views": self.segment_views, "device": self.device}
        answered, numbers = ask_sam3(self.load_config, self.data, found, **how)
        for row, of_text in zip(rows, numbers):
            row["segment"] = of_text
        return segment_arrays(answered)

    def _list_objects(self, question: Question) -> Callable[[], None]:
        """Finds objects, and writes their files; returns what prints them."""
        from normlift_ns.objects.tables import write_catalogue  # noqa: PLC0415 (as above)
        from normlift_ns.scripts.answers.catalogue import facts, find_catalogue, show_catalogue  # noqa: PLC0415

        catalogue = find_catalogue(self.load_config, self.data, question, self.metres_per_unit)
        if self.objects_dir is not None:
            write_catalogue(catalogue, self.objects_dir, question=facts(question), overwrite=self.overwrite)
        return lambda: show_catalogue(catalogue)

    def _check(self) -> None:
        """Raises what can be told before anything is loaded."""
        check_device(self.device)
        self._check_texts()
        check_lifted(self.load_config, self.data, self.ask)
        different(json=self.json, output_path=self.output_path)
        for flag, path in (("--json", self.json), ("--output-path", self.output_path)):
            if path is not None:
                refuse_existing(path, overwrite=self.overwrite, instead=flag)
                writable_file(path, flag)
        writable_folder(self.render_dir, "--render-dir")
        writable_folder(self.why_dir, "--why-dir")
        if self.objects_dir is not None:
            writable_folder(self.objects_dir, "--objects-dir")
            files = [self.objects_dir / name for name in OBJECT_FILES]
            refuse_existing(*files, overwrite=self.overwrite, instead="--objects-dir")
        refuse_existing(*self._pictures(), overwrite=self.overwrite, instead="--render-dir")

    def _check_texts(self) -> None:
        ways = [f"--{name}" for name in ("text", "stdin", "interactive") if getattr(self, name)]
        if len(ways) == 0:
            raise InputError(
                'no text given; name at least one thing to look for, such as --text "orange", or ask one after the '
                "other with --interactive"
            )
        if len(ways) > 1:
            raise InputError(f"{ways[0]} and {ways[1]} are two ways to give texts; leave one of them out")
        for name in ("json", "output_path", "render_dir", "save", "why", "why_dir", "segment", "objects"):
            if ways != ["--text"] and getattr(self, name):
                raise InputError(f"--{name.replace('_', '-')} goes with --text only; leave it out with {ways[0]}")
        if len(self.render_views) > 0 and self.render_dir is None:
            raise InputError("--render-views has no effect without --render-dir; give the folder for the pictures")
        if self.why_dir is not None and not self.why:
            raise InputError("--why-dir has no effect without --why True; add that flag")
        for name in ("segment_model", "segment_views"):
            if self.segment is None and getattr(self, name) != getattr(type(self), name):
                raise InputError(f"--{name.replace('_', '-')} has no effect without --segment sam3; add that flag")
        for name in ("objects_dir", "metres_per_unit"):
            if getattr(self, name) is not None and not self.objects:
                flag = f"--{name.replace('_', '-')}"
                raise InputError(f"{flag} has no effect without --objects True; add that flag")
        if self.interactive and not sys.stdin.isatty():
            raise InputError(
                "--interactive needs a terminal to read from; to ask the lines of a file, use --stdin True"
            )
        check_texts("text", self.text)

    def _pictures(self) -> list[Path]:
        """Pictures that new ones would replace: of the same texts, and of the same views where some are named."""
        views = [glob.escape(Path(name).stem) for name in self.render_views] or ["*"]
        views += ["contact_sheet"] if len(views) > 1 else []
        names = [f"{view}_{i}_{file_name(text)}.png" for view in views for i, text in enumerate(self.text)]
        return [] if self.render_dir is None else [path for name in names for path in self.render_dir.glob(name)]


def _write_json(path: Path, rows: list[dict[str, Any]], question: Question, overwrite: bool) -> None:
    facts = {"relevancy": question.rule, "threshold": question.threshold, "negatives": list(question.negatives)}
    write_text(path, json.dumps({"queries": rows, **facts}, indent=2) + "\n", overwrite=overwrite)


def _write_arrays(path: Path, found: QuickAnswer, more: dict[str, Any], overwrite: bool) -> None:
    import numpy as np  # noqa: PLC0415

    arrays: dict[str, Any] = {
        "relevancy": found.relevancy,
        "reliability": found.field.arrays["reliability"],
        "valid": found.valid,
        **more,
    }
    with new_file(path, overwrite=overwrite) as draft, draft.open("wb") as file:
        np.savez(file, names=np.array(found.question.texts), **arrays)


def entrypoint() -> None:
    """ns-normlift-query, in a process that goes on."""
    run_command(NormLiftQuery)


def main() -> None:
    """Entry point of ns-normlift-query."""
    run_process(NormLiftQuery)


if __name__ == "__main__":
    main()
