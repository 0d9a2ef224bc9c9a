"""ns-normlift-query: search a lifted run with text prompts."""

from __future__ import annotations

import glob
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any, Literal, cast

from normlift_ns.cli import common
from normlift_ns.cli.preflight import (
    check_lifted_run,
    check_new_files,
    check_readable_file,
    check_writable_folder,
    refuse_unused,
)
from normlift_ns.errors import InputError, user_state_folder
from normlift_ns.io.atomic import atomic_file, atomic_files, refuse_existing, safe_file_name, write_text_file
from normlift_ns.io.guard import read_text
from normlift_ns.io.run_dir import FIELD_FOLDER, cache_folder
from normlift_ns.options import (
    CATALOG_FILES,
    DEFAULT_SAM3,
    AskOptions,
    CheckedOptions,
    check_device,
    check_prompt_list,
    renamed,
)

if TYPE_CHECKING:
    import numpy as np
    from rich.table import Table

    from normlift_ns.analysis.explain import RecordedVotes, ViewVote, Why
    from normlift_ns.analysis.objects import Catalogue, CatalogueObject
    from normlift_ns.data.open_scene import StoredRun
    from normlift_ns.query.arrays import QuickRun
    from normlift_ns.query.engine import Answer
    from normlift_ns.query.question import Query


_OUTPUTS = ("output_json", "output_npz", "render_dir")
"""Names of the options for output files that contain an answer."""


@renamed(
    save="save_query",
    json="output_json",
    output_path="output_npz",
    why="explain",
    why_dir="explain_dir",
    metres_per_unit="meters_per_unit",
)
@dataclass
class NormLiftQuery(CheckedOptions):
    """Search a lifted run with text prompts, print a table of the results, and write files on request."""

    load_config: Path
    """Path to the config.yml file of the lifted run."""
    text: tuple[str, ...] = ()
    """Prompts to search for, such as --text mug 'red bowl' or --text 'mug, red bowl'. Commas and semicolons separate
    prompts, except between double quotes: --text '"salt, pepper"'."""
    ask: AskOptions = field(default_factory=AskOptions)
    interactive: bool = False
    """Read prompts from the terminal, one after another, while the run stays open."""
    stdin: bool = False
    """Read one prompt per line from standard input, and print each answer as one line of JSON."""
    history: bool = True
    """Keep a history of --interactive prompts in a file that only you can read."""
    coordinates: Literal["scene", "capture"] = "scene"
    """Coordinate system of the positions in tables and --output-json. scene: that of the Gaussians and of viewers.
    capture: that of the original cameras, before the training rotated and scaled them. The JSON file of
    --inventory has both. With --meters-per-unit, the table of objects always uses capture coordinates."""
    save_query: bool = False
    """Store the queries in the run in place of earlier ones. ns-render and ns-viewer then show their relevancy."""
    output_json: Path | None = None
    """JSON file for the table."""
    output_npz: Path | None = None
    """NPZ file for relevancy [N, Q], reliability [N], valid [N] and names [Q], for N Gaussians and Q prompts. --segment
    adds segment_relevancy, segment_reliability and segment_agreement, each [N, Q]."""
    render_dir: Path | None = None
    """Folder for renders of the relevancy."""
    render_views: tuple[str, ...] = ()
    """Names of the training images, such as 0001 0042, whose cameras render the scene. Without names, the command uses
    three evenly spaced images."""
    explain: bool = False
    """For each prompt, list up to three images with the largest weight in the selection, and up to three others that
    disagree. The columns are the weight, its share, the agreement, the disagreement and the number of regions.
    Terminals with fewer than 120 columns show neither the weight nor the number of regions."""
    explain_dir: Path | None = None
    """Folder for the images of --explain, with outlines of the regions that contributed."""
    segment: Literal["sam3"] | None = None
    """Also segment some training views for the prompts with this network, and lift its masks. A second table lists the
    results, with the agreement between views. sam3: SAM 3. None: no segmentation."""
    segment_model: str | None = None
    """Weights of SAM 3: a folder in transformers format, or a model name to download. None: facebook/sam3."""
    segment_views: int = 8
    """Maximum number of training views for --segment, evenly spaced, at least 1. More views take longer and give more
    reliable results."""
    objects: bool = False
    """List the objects in the selection, which are connected groups of at least 20 Gaussians. The column id is the
    instance_id in exports, and text is the prompt of the object. centroid is the mean position, weighted by evidence.
    box has the edge lengths of the oriented box, longest first, and extent has the size along x, y and z. Both span the
    1st to 99th percentile. R is the mean reliability. views counts the training images that show the object with at
    least a tenth of its largest visible area. best views has up to three of them. Images of the whole object come
    before images of a part of it. Both groups are sorted by the size of the object in the image, largest first. If
    there are more than 40 objects, the table lists only the 10 largest, and a line below counts the objects of each
    prompt."""
    objects_dir: Path | None = None
    """Folder for the list of --objects or --inventory in capture and scene coordinates, with the axes of the boxes. The
    files are objects.json and objects.csv, and objects.ply and objects_scene.ply with the meshes of the boxes.
    docs/objects.md explains every column."""
    meters_per_unit: float | None = None
    """Length of one capture unit in meters for --objects or --inventory, > 0. If given, the table of objects is in
    meters, in the coordinates of the capture."""
    inventory: bool = False
    """Without prompts, list at most 20 objects of the scene, by decreasing evidence, with the columns of --objects. An
    object is named after a word of the vocabulary that clearly matches it. Others get a number, such as object 3."""
    vocabulary: Path | None = None
    """Text file with names of objects for --inventory, one per line. None: the texts of the run's file of text
    embeddings, or else the words of the encoder: 1,000 classes for imagenet, and the names of colors for color. Other
    built-in encoders have no words, so objects are only numbered."""
    image: Path | None = None
    """PNG file for --inventory: a render with the outlines, numbers and names of the objects. The camera is that of the
    training image that shows the most objects."""
    overwrite: bool = False
    """Replace existing files of the same names."""
    data: Path | None = None
    """Current path of the dataset, if it was moved."""
    device: str = "auto"
    """Device for the text encoder and the renders: auto, cpu, cuda, or one GPU such as cuda:1."""

    def main(self) -> list[dict[str, Any]]:
        """Run the query, write files, print the table and return its rows; [] with --stdin or --interactive."""
        self._check()
        common.info_opening(self.load_config)
        if self.render_dir is not None:  # torch loads while the run answers without it
            Thread(target=import_module, args=("normlift_ns.rendering.figures",), daemon=True).start()
        if self.inventory:
            return self._list_inventory()
        run = self._open()
        if self.stdin:
            answer_lines(run, self.ask.rules())
            return []
        if self.interactive:
            run_repl(run, self.ask.rules(), keep_history=self.history, coordinates=self.coordinates)
            return []
        return self._answer(run)

    def _answer(self, run: QuickRun) -> list[dict[str, Any]]:
        """Answer --text, write files, print the table and return its rows."""
        from normlift_ns.query.question import save_query  # noqa: PLC0415 (--help should not wait for NumPy)

        result = run.ask(self._prompts, **self.ask.rules())
        save_renders = self._prepare_renders(result.question) if self.render_dir is not None else None
        rows = result.to_json()
        show_why = self._explain(result, rows) if self.explain else None
        sam3_arrays, show_sam3 = (
            self._segment(result, rows, run.field.arrays["means"]) if self.segment is not None else ({}, None)
        )
        show_objects = self._list_objects(result.question) if self.objects else None
        if self.output_json is not None:
            question = result.question
            rules = {"relevancy": question.rule, "threshold": question.threshold, "negatives": question.negatives}
            rules |= {"coordinates": self.coordinates}
            text = json.dumps({"queries": rows, **rules}, indent=2) + "\n"
            write_text_file(self.output_json, text, overwrite=self.overwrite)
        if self.output_npz is not None:
            _write_arrays(self.output_npz, result, sam3_arrays, self.overwrite)
        if save_renders is not None:
            save_renders()
        stored = save_query(run.run_dir / FIELD_FOLDER, result.question) if self.save_query else None
        folders = (self.render_dir, self.explain_dir, self.objects_dir)
        written = [path for path in (self.output_json, self.output_npz, *folders, stored) if path is not None]
        print_answer(rows, result.question, self.coordinates)
        for print_table in (show_sam3, show_why, show_objects):
            if print_table is not None:
                print_table()
        if len(written) > 0:
            common.info("Written: " + ", ".join(map(str, written)))
        return rows

    def _open(self) -> QuickRun:
        """Open the run; load its scene only if the files of the run do not determine the Gaussian centers."""
        from normlift_ns.query.arrays import open_quick  # noqa: PLC0415 (as above)

        if self.device.startswith("cuda"):
            from normlift_ns.core.device import choose_device  # noqa: PLC0415 (--help should not wait for torch)

            choose_device(self.device)
        open_with = partial(open_quick, self.load_config, device=self.device, **self.ask.encoding())
        run = open_with() or cast("QuickRun", open_with(means=self._run.scene.gaussians.means.numpy()))
        return run.in_capture() if self.coordinates == "capture" else run

    @cached_property
    def _prompts(self) -> tuple[str, ...]:
        """Prompts of --text; see `split_texts`."""
        from normlift_ns.query.question import split_texts  # noqa: PLC0415 (--help should not wait for NumPy)

        return split_texts("--text", self.text)

    @cached_property
    def _run(self) -> StoredRun:
        """Stored run with its scene. Most answers do not need the scene."""
        from normlift_ns.data.open_scene import open_stored_run  # noqa: PLC0415 (as above)

        return open_stored_run(self.load_config, self.data)

    @property
    def _votes(self) -> RecordedVotes:
        """Votes of the images that were lifted."""
        from normlift_ns.analysis.explain import RecordedVotes  # noqa: PLC0415 (as above)

        return RecordedVotes(self._run.scene, self._run.field, cache_folder(self._run.folder))

    def _answer_with_scene(self, question: Query) -> Answer:
        from normlift_ns.query.engine import run_query  # noqa: PLC0415 (as above)

        return run_query(self._run.field, self._run.scene.gaussians.means, question)

    def _prepare_renders(self, question: Query) -> Callable[[], list[Path]]:
        """Load everything that the renders need, and return a function that makes and saves them."""
        from normlift_ns.core.device import choose_device, init_cuda  # noqa: PLC0415
        from normlift_ns.rasterization.settings import RasterSettings  # noqa: PLC0415
        from normlift_ns.rendering.figures import save_overlays, training_cameras  # noqa: PLC0415

        device = choose_device(self.device)
        init_cuda(device)
        scene, folder = self._run.scene, cast(Path, self.render_dir)
        cameras = training_cameras(scene, self.render_views)
        result, settings = self._answer_with_scene(question), RasterSettings.recorded(self._run.field.manifest)
        shared = {"settings": settings, "device": device, "overwrite": self.overwrite}
        return lambda: save_overlays(scene, result, cameras, folder, **shared)

    def _explain(self, result: Answer, rows: list[dict[str, Any]]) -> Callable[[], None]:
        """Add explanations to the rows, write images on request, and return a function that prints the explanations.

        The explanation is None for a prompt that selects nothing.
        """
        import torch  # noqa: PLC0415

        votes, refined = self._votes, result.question.refined
        masks = torch.as_tensor(result.selected).T
        reasons = [votes.explain(mask, refined=refined) if bool(mask.any()) else None for mask in masks]
        for row, why in zip(rows, reasons):
            row["why"] = None if why is None else explanation_to_json(votes.names, why)
        if self.explain_dir is not None:
            save_vote_images(votes, result.question.texts, reasons, self.explain_dir, overwrite=self.overwrite)
        return lambda: print_explanations(votes.names, result.question.texts, reasons, self.explain_dir)

    def _segment(
        self, result: Answer, rows: list[dict[str, Any]], means: np.ndarray
    ) -> tuple[dict[str, Any], Callable[[], None]]:
        """Segment training views with SAM 3 for the prompts, lift the masks, and add a summary to each row.

        Args:
            means: Centers of the Gaussians for the summary, [N, 3].
        Returns:
            The arrays of the lifted masks, and a function that prints the summaries.
        """
        import torch  # noqa: PLC0415

        from normlift_ns.core.device import choose_device  # noqa: PLC0415
        from normlift_ns.encoders.cache import CachedTextMasks  # noqa: PLC0415
        from normlift_ns.query.sam3_query import query_sam3  # noqa: PLC0415
        from normlift_ns.rasterization.settings import RasterSettings  # noqa: PLC0415
        from normlift_ns.segmentation.checkpoint import TEXT_PROMPT_FAMILIES, check_sam_checkpoint  # noqa: PLC0415

        model, device = self.segment_model or DEFAULT_SAM3, choose_device(self.device)
        check_sam_checkpoint(model, TEXT_PROMPT_FAMILIES)
        run, question = self._run, result.question
        count = len(run.scene.train)
        common.info_progress(
            f"Running SAM 3 on {min(self.segment_views, count)} of {count} training view{'s' * (count != 1)}"
        )
        cached = CachedTextMasks(model, device, cache_folder(run.folder) / "masks")
        segmented = query_sam3(
            run.scene,
            cached.find,
            question.texts,
            views=self.segment_views,
            min_reliability=question.min_reliability,
            settings=RasterSettings.recorded(run.field.manifest),
            device=device,
        )
        summaries = segmented.summarize(torch.from_numpy(means), torch.as_tensor(result.selected))
        for row, summary in zip(rows, summaries):
            row["segment"] = {"model": model, **summary}
        columns = {
            "segment_relevancy": [answer.relevancy for answer in segmented.answers],
            "segment_reliability": [answer.scalars.reliability for answer in segmented.answers],
            "segment_agreement": [answer.scalars.c_inter for answer in segmented.answers],
        }
        arrays = {name: torch.stack(tensors, dim=1).cpu().numpy() for name, tensors in columns.items()}
        return arrays, lambda: print_sam3_table(result.question.texts, summaries)

    def _list_objects(self, question: Query) -> Callable[[], None]:
        """Find objects, write their files, and return a function that prints them.

        This opens the whole run, because best views need the cameras of the scene.
        """
        from normlift_ns.analysis import objects  # noqa: PLC0415 (as above)
        from normlift_ns.core.device import choose_device  # noqa: PLC0415

        run, answer = self._run, self._answer_with_scene(question)
        instances = objects.find_instances(answer.texts, answer.means, answer.relevancy, answer.selected)
        transform, device = objects.similarity_to_capture(run.folder, run.scene.identity), choose_device(self.device)
        catalog = objects.make_catalogue(
            run.scene, run.field, instances, transform, meters_per_unit=self.meters_per_unit, device=device
        )
        if self.objects_dir is not None:
            metadata = {"texts": list(question.texts), **question.settings()}
            objects.write_catalogue(catalog, self.objects_dir, question=metadata, overwrite=self.overwrite)
        return lambda: print_catalog(catalog, self._table_coordinates)

    @property
    def _table_coordinates(self) -> Literal["scene", "capture"]:
        """Coordinate system of the table of objects; a table in meters uses that of the capture."""
        return self.coordinates if self.meters_per_unit is None else "capture"

    def _list_inventory(self) -> list[dict[str, Any]]:
        """Find the objects of the scene, write files, print the table and return its rows."""
        from normlift_ns.analysis import inventory, objects  # noqa: PLC0415 (as above)
        from normlift_ns.core.device import choose_device  # noqa: PLC0415
        from normlift_ns.query.text_encoder import encoder_name, own_words  # noqa: PLC0415
        from normlift_ns.rendering.figures import save_inventory  # noqa: PLC0415

        words = None if self.vocabulary is None else read_vocabulary(self.vocabulary)
        run = self._open()
        encode = lambda texts: run.text_encoder.rows(texts)  # noqa: E731, PLW0108 (loads the encoder only if needed)
        known = inventory.Vocabulary.of(own_words(run) if words is None else words, encoder_name(run), encode, run.ask)
        folder, scene, stored = self._run
        transform, device = objects.similarity_to_capture(folder, scene.identity), choose_device(self.device)
        found = inventory.list_inventory(
            self._votes, known, transform, meters_per_unit=self.meters_per_unit, device=device
        )
        document = found.catalog.to_json()
        print_catalog(found.catalog, self._table_coordinates)
        texts = [item.text for item in found.catalog.objects]
        if len(texts) > 0 and all(text.startswith("object ") for text in texts):
            advice = "" if self.vocabulary is not None else "; give words of your own with --vocabulary FILE"
            problem = "No word of the vocabulary clearly matches an object" if known.words else "There is no vocabulary"
            common.info(f"{problem}{advice}.")
        if self.output_json is not None:
            write_text_file(self.output_json, json.dumps(document, indent=2) + "\n", overwrite=self.overwrite)
        if self.objects_dir is not None:
            objects.write_catalogue(found.catalog, self.objects_dir, overwrite=self.overwrite)
        if self.image is not None:
            save_inventory(scene, found, self.image, manifest=stored.manifest, overwrite=self.overwrite)
        written = [path for path in (self.output_json, self.objects_dir, self.image) if path is not None]
        if len(written) > 0:
            common.info("Written: " + ", ".join(map(str, written)))
        return document["objects"]

    def _check(self) -> None:
        """Raise errors that can be detected before anything is loaded."""
        check_device(self.device)
        self._check_texts()
        check_lifted_run(self.load_config, self.data, self.ask)
        outputs = [os.path.realpath(path) for path in (self.output_json, self.output_npz) if path is not None]
        if len(set(outputs)) < len(outputs):
            raise InputError(f"--output-json and --output-npz are the same file, {self.output_npz}; give two names")
        files = (("--output-json", self.output_json), ("--output-npz", self.output_npz), ("--image", self.image))
        for flag, path in files:
            check_new_files(path, overwrite=self.overwrite, flags=flag)
        check_writable_folder(self.render_dir, "--render-dir")
        check_writable_folder(self.explain_dir, "--explain-dir")
        tables: list[Path] = [] if self.objects_dir is None else [self.objects_dir / name for name in CATALOG_FILES]
        check_new_files(*tables, overwrite=self.overwrite, flags="--objects-dir")
        written = {Path(os.path.realpath(path)) for _, path in files if path is not None}
        written.update(Path(os.path.realpath(path)) for path in tables)
        for folder in filter(None, (self.render_dir, self.explain_dir, self.objects_dir)):
            place = Path(os.path.realpath(folder))
            for path in written & {place, *place.parents}:
                raise InputError(f"{path} is an output file, but {folder} needs a folder there; give another path")
        refuse_existing(*self._existing_renders(), overwrite=self.overwrite, flags="--render-dir")

    def _check_texts(self) -> None:
        flags = [f"--{name}" for name in ("text", "stdin", "interactive", "inventory") if getattr(self, name)]
        if len(flags) == 0:
            raise InputError(
                'no prompt is given; give one with --text, such as --text "orange", or enter prompts one at a time '
                "with --interactive"
            )
        if len(flags) > 1:
            raise InputError(f"{flags[0]} and {flags[1]} cannot be combined; leave one of them out")
        for name in ("save_query", "explain", "explain_dir", "segment", "objects", *_OUTPUTS):
            if flags != ["--text"] and getattr(self, name) and not (self.inventory and name == "output_json"):
                flag = name.replace("_", "-")
                needed = "--text or --inventory" if name == "output_json" else "--text"
                raise InputError(f"--{flag} works only with {needed}; remove it, or give --text instead of {flags[0]}")
        self._check_dependent_options()
        if self.interactive and not sys.stdin.isatty():
            raise InputError(
                "--interactive needs a terminal as standard input; to read prompts from a file, use --stdin True"
            )
        check_prompt_list("text", self.text)

    def _check_dependent_options(self) -> None:
        for names, needed, flag in (
            (("render_views",), self.render_dir, "--render-dir FOLDER"),
            (("explain_dir",), self.explain, "--explain True"),
            (("segment_model", "segment_views"), self.segment, "--segment sam3"),
            (("objects_dir", "meters_per_unit"), self.objects or self.inventory, "--objects True or --inventory True"),
            (("vocabulary", "image"), self.inventory, "--inventory True"),
            (("history",), self.interactive, "--interactive True"),
        ):
            if not needed:
                refuse_unused(self, names, flag)

    def _existing_renders(self) -> list[Path]:
        """Return the existing renders that new renders of these prompts and views would replace."""
        views = [glob.escape(Path(name).stem) for name in self.render_views] or ["*"]
        views += ["contact_sheet"] if len(views) > 1 else []
        names = [f"{view}_{i}_{safe_file_name(text)}.png" for view in views for i, text in enumerate(self._prompts)]
        return [] if self.render_dir is None else [path for name in names for path in self.render_dir.glob(name)]


def read_vocabulary(path: Path) -> list[str]:
    """Read the words of a text file, one per line, and skip empty lines and duplicates.

    Raises:
        OSError, ValueError: The file cannot be read, is not UTF-8 text, or has no words.
    """
    check_readable_file(path, "--vocabulary")
    try:
        lines = read_text(path, "utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"--vocabulary {path} is not UTF-8 text ({error}); save it as UTF-8") from error
    words = list(dict.fromkeys(filter(None, map(str.strip, lines))))
    if len(words) == 0:
        raise InputError(f"--vocabulary {path} has no words; write one per line")
    return words


_HELP = (
    'Separate prompts by commas. Put a prompt that contains a comma in double quotes: "salt, pepper".',
    "help: print this text. exit, quit or Ctrl-D: end. To search for one of these words, write it in double quotes.",
)


def run_repl(
    run: QuickRun,
    rules: Mapping[str, Any],
    *,
    keep_history: bool,
    coordinates: Literal["scene", "capture"] = "scene",
) -> None:
    """Answer the prompts that a user types, until `exit`, `quit` or Ctrl-D. Print an error for invalid prompts.

    Args:
        run: Lifted run.
        rules: Keyword arguments of `QuickRun.ask`.
        keep_history: Store prompts in the history file.
        coordinates: Coordinate system of the positions of the run.
    """
    from prompt_toolkit import PromptSession  # noqa: PLC0415 (only needed here)
    from prompt_toolkit.history import FileHistory, InMemoryHistory  # noqa: PLC0415

    from normlift_ns.query.question import split_prompts  # noqa: PLC0415

    file = _history_file() if keep_history else None
    session = PromptSession(history=InMemoryHistory() if file is None else FileHistory(str(file)))
    common.info(f"{len(run.field.arrays['source']):,} Gaussians. Type a prompt, help or exit.")
    while True:
        try:
            text = session.prompt("> ").strip()
        except KeyboardInterrupt:
            continue
        except EOFError:
            return
        if text in ("exit", "quit"):
            return
        if text in ("help", "?"):
            for line in _HELP:
                common.info(line)
            continue
        prompts = split_prompts(text)
        if len(prompts) == 0:
            continue
        try:
            answer = run.ask(prompts, **rules)
        except (InputError, OSError, MemoryError) as error:
            common.print_error(str(error))
        else:
            print_answer(answer.to_json(), answer.question, coordinates)


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
        run: Lifted run.
        rules: Keyword arguments of `QuickRun.ask`.
        lines: Prompts in UTF-8. If None, read standard input.
    Raises:
        ValueError: Standard output is closed, or some prompts failed. The JSON line of each failed prompt has the key
            `error`.
    """
    stdin: Any = sys.stdin  # None if it is closed
    source: Iterable[bytes] = (() if stdin is None else stdin.buffer) if lines is None else lines
    if sys.stdout is None:
        raise InputError(
            "standard output is closed, but --stdin prints answers there; open it, or redirect it to a file"
        )
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
        raise InputError(
            f"prompts without an answer: {failed} of {total}; their JSON lines give the reasons under the key error"
        )


def _write_arrays(path: Path, result: Answer, extra: dict[str, Any], overwrite: bool) -> None:
    import numpy as np  # noqa: PLC0415

    arrays = {"relevancy": result.relevancy, "reliability": result.field.scalars.reliability, "valid": result.valid}
    with atomic_file(path, overwrite=overwrite) as draft, draft.open("wb") as file:
        np.savez(file, names=np.array(result.question.texts), **arrays, **extra)


def print_answer(
    rows: list[dict[str, Any]], question: Query, coordinates: Literal["scene", "capture"] = "scene"
) -> None:
    """Print the table of an answer, and notes on some of its prompts.

    The notes are about prompts that have no clear match, are encoded only in part, or probably select too much; see
    `_is_loose`.
    """
    rule = f"{question.rule} > {question.threshold:.4g}"
    narrow = common.CONSOLE.width < 100
    common.CONSOLE.print(answer_table(rows, rule, question.threshold, coordinates, narrow=narrow))
    for row in rows:
        if row["read_as"] is not None:
            common.info(f'{row["text"]}: read as "{row["read_as"]}"; the encoder ignores the rest of the prompt.')
        if row["verdict"] in ("weak match", "probably not here"):
            position = "" if row["nearest"] is None else f", near {common.format_number(row['nearest'])}"
            peak = common.format_number(row["peak"])
            common.info(f"{row['text']}: {row['verdict']}. The largest relevancy is {peak}{position}.")
    loose = [row["text"] for row in rows if _is_loose(row, question.threshold)]
    if len(loose) > 0:
        common.info(f"{', '.join(loose)} may select too much; try a larger --threshold, as in the column suggested.")


def _is_loose(row: dict[str, Any], threshold: float) -> bool:
    """Return True if a prompt selects at least twice as many Gaussians as it would at its suggested threshold.

    Both counts are estimated from the histogram of the prompt.
    """
    if row["histogram"] is None:
        return False
    counts, low, high = (row["histogram"][name] for name in ("counts", "low", "high"))
    width = (high - low) / len(counts)
    centers = [low + (index + 0.5) * width for index in range(len(counts))]
    selected, left = (
        sum(count for count, center in zip(counts, centers) if center > least)
        for least in (threshold, row["suggested_threshold"])
    )
    return selected >= 2 * max(1, left)


def answer_table(
    rows: list[dict[str, Any]],
    rule: str,
    threshold: float,
    coordinates: Literal["scene", "capture"] = "scene",
    *,
    narrow: bool = False,
) -> Table:
    """Return a table with one row per prompt.

    Args:
        rows: Rows of `Answer.to_json`.
        rule: Selection rule for the title, such as lerf > 0.5.
        threshold: Threshold that each histogram marks with a bar |.
        coordinates: Coordinate system of the positions, for the title.
        narrow: Omit the histograms and the verdicts.
    """
    from rich.table import Table  # noqa: PLC0415 (--help needs no tables)

    from normlift_ns.query.threshold import draw_histogram  # noqa: PLC0415 (--help should not wait for NumPy)

    result = Table(title=f"Selected: {rule}; positions in {coordinates} coordinates", padding=(0, 0 if narrow else 1))
    wrapped = ("text", "centroid", "extent")
    for name in ("text", "Gaussians", "centroid", "extent", "peak", "reliability"):
        justify = "left" if name == "text" else "right"
        result.add_column(name, justify=justify, no_wrap=name not in wrapped, overflow="fold")
    if not narrow:
        result.add_column("histogram", no_wrap=True)
        result.add_column("verdict", no_wrap=True)
    result.add_column("suggested", justify="right", no_wrap=True)
    for row in rows:
        names = ("centroid", "extent", "peak", "mean_reliability", "suggested_threshold")
        *cells, suggested = (common.format_number(row[name]) for name in names)
        bins = row["histogram"]
        bars = "-" if bins is None else draw_histogram(bins["counts"], bins["low"], bins["high"], threshold)
        wide = () if narrow else (common.plain_text(bars), row["verdict"] or "-")
        result.add_row(
            common.plain_text(row["text"]),
            f"{row['fraction']:.2%}",
            *cells,
            *wide,
            suggested,
        )
    return result


# ns-normlift-query --objects: the objects in a selection.


_MAX_ROWS = 40
"""Maximum number of objects in a table of all objects."""
_LARGEST = 10
"""Number of objects in the table if there are more than `_MAX_ROWS`."""


def print_catalog(catalog: Catalogue, coordinates: Literal["scene", "capture"] = "scene") -> None:
    """Print a table of the objects; if there are more than 40, print the 10 largest and the counts of each prompt."""
    count = len(catalog.objects)
    largest = sorted(catalog.objects, key=lambda item: -item.gaussians)[: count if count <= _MAX_ROWS else _LARGEST]
    common.CONSOLE.print(_catalog_table(catalog, sorted(largest, key=lambda item: item.id), coordinates))
    if count > _MAX_ROWS:
        parts = [
            f"{text or 'selection'}: {len(sizes):,} object{'s' * (len(sizes) != 1)}, {sum(sizes):,} Gaussians"
            for text in dict.fromkeys(item.text for item in catalog.objects)
            for sizes in [[item.gaussians for item in catalog.objects if item.text == text]]
        ]
        common.info(
            f"{'; '.join(parts)}. The table lists only the {_LARGEST} largest objects; --objects-dir FOLDER writes "
            "files with all of them."
        )
    if catalog.num_in_small_components > 0:
        common.info(f"Selected Gaussians in groups too small to be listed: {catalog.num_in_small_components:,}.")


def _catalog_table(
    catalog: Catalogue, objects: Sequence[CatalogueObject], coordinates: Literal["scene", "capture"]
) -> Table:
    from rich.table import Table  # noqa: PLC0415 (--help needs no tables)

    unit = "" if catalog.meters_per_unit is None or coordinates == "scene" else ", in meters"
    title = f"Objects; positions in {coordinates} coordinates{unit}"
    table = Table(title=title, padding=(0, 0 if common.CONSOLE.width < 100 else 1))
    table.add_column("id")
    table.add_column("text", overflow="fold")
    narrow = common.CONSOLE.width < 70
    vectors = ("centroid", "box", *(() if narrow else ("extent",)))
    for name in ("Gaussians", *vectors, "R", "views"):
        width = 8 if name in vectors else None  # keeps each number on one line
        table.add_column(name, justify="right", no_wrap=name not in vectors, overflow="fold", min_width=width)
    if not narrow:
        table.add_column("best views")
    for item in objects:
        geometry = item.scene if coordinates == "scene" else item.capture
        rows = (geometry.centroid, geometry.box.size, geometry.extent)[: len(vectors)]
        numbers = (" ".join(f"{x:.3g}" for x in row) for row in rows)
        cells = (f"{item.gaussians:,}", *numbers, f"{item.reliability:.3f}", str(item.views))
        best = () if narrow else (common.plain_text(" ".join(Path(name).stem for name in item.best_views)),)
        table.add_row(str(item.id), common.plain_text(item.text), *cells, *best)
    return table


# ns-normlift-query --explain: the images that voted for a selection.


_LARGEST_WEIGHT = "weighs most"


def explanation_to_json(names: Sequence[str], why: Why) -> dict[str, Any]:
    """Return an explanation as JSON types, with the names of the images."""
    row = why.to_json()
    return {**row, "views": [{"photograph": names[view["view"]], **view} for view in row["views"]]}


def _votes_to_show(why: Why) -> dict[str, tuple[ViewVote, ...]]:
    """Return the votes of the images with the largest weight, and of others that disagree, by group."""
    return dict(zip((_LARGEST_WEIGHT, "disagrees"), why.images_to_show()))


def save_vote_images(
    recorded: RecordedVotes, texts: Sequence[str], reasons: Sequence[Why | None], folder: Path, *, overwrite: bool
) -> None:
    """Write the images with the largest weight, and others that disagree; if an error occurs, write no file.

    The files are <number>_<text>_1_<image>.png … and <number>_<text>_disagrees_1_<image>.png ….

    Raises:
        FileExistsError: A file exists, and `overwrite` is False.
        OSError: A file cannot be written.
        FileNotFoundError, ValueError: As in `RecordedVotes.pictures`.
    """
    from PIL import Image  # noqa: PLC0415 (the tables do not need it)

    from normlift_ns.rendering.figures import unique_file_names  # noqa: PLC0415

    names = unique_file_names(recorded.names)
    votes: dict[Path, ViewVote] = {}
    for index, (text, why) in enumerate(zip(texts, reasons)):
        for kind, group in ({} if why is None else _votes_to_show(why)).items():
            for rank, vote in enumerate(group, 1):
                prefix = "" if kind == _LARGEST_WEIGHT else "disagrees_"
                votes[folder / f"{index}_{safe_file_name(text)}_{prefix}{rank}_{names[vote.view]}.png"] = vote
    with atomic_files(*votes, overwrite=overwrite) if len(votes) > 0 else nullcontext(()) as drafts:
        for draft, picture in zip(drafts, recorded.pictures(votes.values())):
            Image.fromarray(picture.image.numpy()).save(draft, format="PNG")


def print_explanations(
    names: Sequence[str], texts: Sequence[str], reasons: Sequence[Why | None], folder: Path | None = None
) -> None:
    """Print a table of images, and for each prompt a sentence about their agreement.

    Args:
        names: Names of all images.
        texts: Prompts.
        reasons: Explanation of each prompt, or None if it selects nothing.
        folder: Folder that `save_vote_images` wrote to, if any.
    """
    result = explanation_table(names, texts, reasons, narrow=common.CONSOLE.width < 120)
    if result.row_count > 0:
        common.CONSOLE.print(result)
    for text, why in zip(texts, reasons):
        common.info(f"{text}: {'nothing is selected, so nothing can be explained.' if why is None else why.sentence}")
    if any(why is not None for why in reasons):
        advice = "add --explain-dir FOLDER" if folder is None else f"open the images in {folder}"
        common.info(f"Images can agree on a wrong answer. To see the regions that contributed, {advice}.")


def explanation_table(
    names: Sequence[str], texts: Sequence[str], reasons: Sequence[Why | None], *, narrow: bool = False
) -> Table:
    """Return a table of the images of every prompt. A narrow table omits weights and region counts."""
    from rich.table import Table  # noqa: PLC0415 (--help needs no tables)

    result = Table(title="Why", padding=(0, 0 if narrow else 1))
    for name in ("text", "", "image"):
        result.add_column(name, overflow="fold")
    for name in (*(() if narrow else ("weight in pixels",)), "share", "agreement", "disagreement"):
        result.add_column(name, justify="right", no_wrap=True)
    if not narrow:
        result.add_column("regions", justify="right", no_wrap=True)
    for text, why in zip(texts, reasons):
        label = text
        for kind, votes in ({} if why is None else _votes_to_show(why)).items():
            for vote in votes:
                shares = (f"{vote.share:.1%}", f"{vote.agreement:.3f}", f"{vote.disagreement:.0%}")
                numbers = shares if narrow else (f"{vote.weight:,.0f}", *shares, str(len(vote.regions)))
                result.add_row(common.plain_text(label), kind, common.plain_text(names[vote.view]), *numbers)
                label = ""
    return result


# ns-normlift-query --segment: SAM 3's masks for the same prompts.


def print_sam3_table(texts: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """Print a table of the lifted masks of SAM 3, with one row per prompt."""
    from normlift_ns.query.sam3_query import MIN_MASK_FRACTION  # noqa: PLC0415 (loads torch)

    limit = max(row["min_reliability"] for row in rows)
    reliable = f" and reliability at least {limit:g}" if limit > 0 else ""
    from rich.table import Table  # noqa: PLC0415 (--help needs no tables)

    table = Table(
        title=f"SAM 3: Gaussians with more than {MIN_MASK_FRACTION:.0%} of their weight in its masks{reliable}"
    )
    for name in ("text", "Gaussians", "centroid", "extent", "peak", "agreement", "reliability", "found in", "IoU"):
        table.add_column(name, justify="left" if name == "text" else "right")
    for text, row in zip(texts, rows):
        names = ("centroid", "extent", "peak", "agreement", "mean_reliability")
        numbers = (common.format_number(row[name]) for name in names)
        views = f"{len(row['found_in'])} of {len(row['views'])} views, {len(row['agree'])} agree"
        table.add_row(
            common.plain_text(text), f"{row['fraction']:.2%}", *numbers, views, common.format_number(row["iou"])
        )
    common.CONSOLE.print(table)


def entrypoint() -> None:
    """Run ns-normlift-query, and return to the caller if it succeeds."""
    common.run_command(NormLiftQuery)


if __name__ == "__main__":
    common.run_command_process(NormLiftQuery)
