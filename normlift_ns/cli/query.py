"""ns-normlift-query: search a lifted run with text prompts."""

from __future__ import annotations

import glob
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from normlift_ns.cli.common import info, info_opening, print_error, run_command, run_command_process
from normlift_ns.cli.preflight import check_distinct_paths, check_lifted_run, check_new_files, check_writable_folder
from normlift_ns.errors import InputError, user_state_folder
from normlift_ns.io.atomic import atomic_file, refuse_existing, safe_file_name, write_text_file
from normlift_ns.io.run_dir import FIELD_FOLDER, cache_folder
from normlift_ns.options import CATALOG_FILES, DEFAULT_SAM3, AskOptions, check_device, check_options, check_prompt_list

if TYPE_CHECKING:
    from normlift_ns.lifted_run import LiftedRun
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
        from normlift_ns.cli.answers import print_answer  # noqa: PLC0415 (--help should not wait for NumPy)
        from normlift_ns.query.question import save_query  # noqa: PLC0415

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
        vectors, template = self.ask.text_vectors, self.ask.text_template
        open_with = partial(
            open_quick, self.load_config, device=self.device, text_vectors=vectors, text_template=template
        )
        return open_with() or cast("QuickRun", open_with(means=self._run.scene.gaussians.means.numpy()))

    @cached_property
    def _run(self) -> LiftedRun:
        """The run with its scene, which most answers do not need."""
        from normlift_ns.api import open_run  # noqa: PLC0415 (as above)

        return open_run(self.load_config, data=self.data)

    def _answer_with_scene(self, question: Query) -> Answer:
        from normlift_ns.query.engine import run_query  # noqa: PLC0415 (as above)

        return run_query(self._run.field, self._run.scene.gaussians.means, question)

    def _prepare_renders(self, question: Query) -> Callable[[], list[Path]]:
        """Load everything that renders need, and return a function that renders and saves them."""
        from normlift_ns.rasterization.settings import RasterSettings  # noqa: PLC0415
        from normlift_ns.rendering.figures import save_overlays, training_cameras  # noqa: PLC0415

        scene, folder = self._run.scene, cast(Path, self.render_dir)
        cameras = training_cameras(scene, self.render_views)
        result, settings = self._answer_with_scene(question), RasterSettings.recorded(self._run.field.manifest)
        return lambda: save_overlays(scene, result, cameras, folder, settings=settings, overwrite=self.overwrite)

    def _explain(self, result: Answer, rows: list[dict[str, Any]]) -> Callable[[], None]:
        """Add an explanation to every row, write the images, and return a function that prints the explanations.

        A prompt that selects nothing has no explanation.
        """
        import torch  # noqa: PLC0415

        from normlift_ns.cli import answers  # noqa: PLC0415

        votes, refined = self._run.votes, result.question.refined
        masks = torch.as_tensor(result.selected).T
        reasons = [votes.explain(mask, refined=refined) if bool(mask.any()) else None for mask in masks]
        for row, why in zip(rows, reasons):
            row["why"] = None if why is None else answers.explanation_to_json(votes.names, why)
        if self.why_dir is not None:
            answers.save_vote_images(votes, self.text, reasons, self.why_dir, overwrite=self.overwrite)
        return lambda: answers.print_explanations(votes.names, self.text, reasons)

    def _segment(self, result: Answer, rows: list[dict[str, Any]]) -> tuple[dict[str, Any], Callable[[], None]]:
        """Segment training views with SAM 3 for the same prompts, lift the masks, and add their summary to every row.

        Returns:
            The arrays of the lifted masks, and a function that prints the summaries.
        """
        import torch  # noqa: PLC0415

        from normlift_ns.cli.answers import print_sam3_table  # noqa: PLC0415
        from normlift_ns.core.device import choose_device  # noqa: PLC0415
        from normlift_ns.encoders.cache import CachedTextMasks  # noqa: PLC0415
        from normlift_ns.query.sam3_query import query_sam3  # noqa: PLC0415
        from normlift_ns.rasterization.settings import RasterSettings  # noqa: PLC0415
        from normlift_ns.segmentation.checkpoint import TEXT_PROMPT_FAMILIES, check_sam_checkpoint  # noqa: PLC0415

        model, device = self.segment_model or DEFAULT_SAM3, choose_device(self.device)
        check_sam_checkpoint(model, TEXT_PROMPT_FAMILIES)
        run, question = self._run, result.question
        count = len(run.scene.train)
        info(f"Running SAM 3 on {min(self.segment_views, count)} of {count} training views")
        cached = CachedTextMasks(model, device, cache_folder(run.folder) / "masks")
        segmented = query_sam3(
            run.scene, cached.find, question.texts,
            views=self.segment_views, min_reliability=question.min_reliability,
            settings=RasterSettings.recorded(run.field.manifest), device=device,
        )  # fmt: skip
        summaries = segmented.summarize(run.scene.gaussians.means, torch.as_tensor(result.selected))
        for row, summary in zip(rows, summaries):
            row["segment"] = {"model": model, **summary}
        columns = {
            "segment_relevancy": [answer.relevancy for answer in segmented.answers],
            "segment_reliability": [answer.scalars.reliability for answer in segmented.answers],
            "segment_agreement": [answer.scalars.c_inter for answer in segmented.answers],
        }
        arrays = {name: torch.stack(tensors, dim=1).cpu().numpy() for name, tensors in columns.items()}
        return arrays, lambda: print_sam3_table(self.text, summaries)

    def _list_objects(self, question: Query) -> Callable[[], None]:
        """Find objects, write their files, and return a function that prints them.

        This opens the whole run, because best views need the cameras of the scene.
        """
        from normlift_ns.analysis.catalogue import write_catalogue  # noqa: PLC0415 (as above)
        from normlift_ns.cli.answers import print_catalog  # noqa: PLC0415

        answer = self._answer_with_scene(question)
        catalog = self._run.catalogue(answer, metres_per_unit=self.metres_per_unit)
        if self.objects_dir is not None:
            metadata = {
                "texts": list(question.texts),
                "relevancy": question.rule,
                "threshold": question.threshold,
                "min_reliability": question.min_reliability,
            }
            write_catalogue(catalog, self.objects_dir, question=metadata, overwrite=self.overwrite)
        return lambda: print_catalog(catalog)

    def _check(self) -> None:
        """Raise errors that can be detected before anything is loaded."""
        check_device(self.device)
        self._check_texts()
        check_lifted_run(self.load_config, self.data, self.ask)
        check_distinct_paths(json=self.json, output_path=self.output_path)
        for flag, path in (("--json", self.json), ("--output-path", self.output_path)):
            check_new_files(path, overwrite=self.overwrite, flags=flag)
        check_writable_folder(self.render_dir, "--render-dir")
        check_writable_folder(self.why_dir, "--why-dir")
        if self.objects_dir is not None:
            files = (self.objects_dir / name for name in CATALOG_FILES)
            check_new_files(*files, overwrite=self.overwrite, flags="--objects-dir")
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
        for name, needed, flag in (
            ("render_views", self.render_dir, "--render-dir FOLDER"),
            ("why_dir", self.why, "--why True"),
            ("segment_model", self.segment, "--segment sam3"),
            ("segment_views", self.segment, "--segment sam3"),
            ("objects_dir", self.objects, "--objects True"),
            ("metres_per_unit", self.objects, "--objects True"),
        ):
            if not needed and getattr(self, name) != getattr(type(self), name):
                raise InputError(f"--{name.replace('_', '-')} has no effect without {flag}; add that flag")

    def _existing_renders(self) -> list[Path]:
        """Return existing renders that new ones could replace: of the same prompts, and of --render-views if given."""
        views = [glob.escape(Path(name).stem) for name in self.render_views] or ["*"]
        views += ["contact_sheet"] if len(views) > 1 else []
        names = [f"{view}_{i}_{safe_file_name(text)}.png" for view in views for i, text in enumerate(self.text)]
        return [] if self.render_dir is None else [path for name in names for path in self.render_dir.glob(name)]


def run_repl(run: QuickRun, rules: Mapping[str, Any], *, keep_history: bool) -> None:
    """Answer prompts that a user types, one per line, until Ctrl-D; invalid prompts print an error message.

    Args:
        run: The lifted run.
        rules: Keyword arguments of `QuickRun.ask`.
        keep_history: Store prompts in the history file.
    """
    from prompt_toolkit import PromptSession  # noqa: PLC0415 (only needed here)
    from prompt_toolkit.history import FileHistory, InMemoryHistory  # noqa: PLC0415

    from normlift_ns.cli.answers import print_answer  # noqa: PLC0415

    file = _history_file() if keep_history else None
    session = PromptSession(history=InMemoryHistory() if file is None else FileHistory(str(file)))
    info(f"{len(run.field.arrays['source']):,} Gaussians. Type one prompt per line; Ctrl-D quits.")
    while True:
        try:
            text = session.prompt("> ").strip()
        except KeyboardInterrupt:
            continue
        except EOFError:
            return
        if text == "":
            continue
        try:
            answer = run.ask([text], **rules)
        except (InputError, OSError, MemoryError) as error:
            print_error(str(error))
        else:
            print_answer(answer.to_json(), answer.question)


def _history_file() -> Path | None:
    """Return the history file, which only the user can read; None if it cannot be created."""
    with suppress(OSError):
        folder = user_state_folder()
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            os.close(os.open(folder / "history", os.O_RDWR | os.O_CREAT, 0o600))
            (folder / "history").chmod(0o600)
            return folder / "history"
    return None


def answer_lines(run: QuickRun, rules: Mapping[str, Any], lines: Iterable[bytes] | None = None) -> None:
    """Answer one prompt per line, and print each answer immediately as one line of JSON; skip empty lines.

    Args:
        run: The lifted run.
        rules: Keyword arguments of `QuickRun.ask`.
        lines: The prompts; None: lines of standard input.
    Raises:
        ValueError: Some lines failed; the JSON line of each has an `error`.
    """
    stdin: Any = sys.stdin  # None if it is closed
    source: Iterable[bytes] = (() if stdin is None else stdin.buffer) if lines is None else lines
    if sys.stdout is None:
        raise InputError("standard output is closed; --stdin prints its answers there")
    failed = total = 0
    for line in source:
        text = line.decode("utf8", "replace").lstrip("\ufeff").strip()  # byte order mark of files from Windows
        if text == "":
            continue
        total += 1
        try:
            answer = run.ask([text], **rules)
            (row,) = answer.to_json()
            output = {**row, "rule": answer.question.rule, "threshold": answer.question.threshold}
        except InputError as error:
            failed += 1
            output = {"text": text, "error": str(error)}
        sys.stdout.write(json.dumps(output) + "\n")
        sys.stdout.flush()
    if failed > 0:
        raise InputError(f"{failed} of {total} lines could not be answered; see their `error` for the reasons")


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


if __name__ == "__main__":
    run_command_process(NormLiftQuery)
