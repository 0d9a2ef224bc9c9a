"""ns-normlift-query: ask a lifted run."""

from __future__ import annotations

import glob
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from normlift_ns.core.files import file_name, new_file, refuse_existing, write_text
from normlift_ns.errors import InputError
from normlift_ns.options import AskOptions
from normlift_ns.ranges import check_device, check_options, check_texts
from normlift_ns.scripts.early import check_lifted, different, writable_file, writable_folder
from normlift_ns.scripts.shared import CONSOLE, plain, run_command, say

if TYPE_CHECKING:
    from normlift_ns.lifted_run import Answer


@dataclass
class NormLiftQuery:
    """Search a lifted run with text: a table of what is found, and files on request."""

    load_config: Path
    """Path to config YAML file of the lifted run."""
    text: tuple[str, ...]
    """What to look for, one or several texts."""
    ask: AskOptions = field(default_factory=AskOptions)
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
        from normlift_ns.asking import summarize  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.front_door import open_run  # noqa: PLC0415
        from normlift_ns.viewer.pictures import save_overlays, training_cameras  # noqa: PLC0415

        run = open_run(
            self.load_config,
            data=self.data,
            device=self.device,
            text_vectors=self.ask.text_vectors,
            text_template=self.ask.text_template,
        )
        cameras = training_cameras(run.scene, self.render_views)
        answer = run.ask(*self.text, **self.ask.rules())
        rows, question = summarize(answer), answer.question
        if self.json is not None:
            _write_json(self.json, rows, answer, self.overwrite)
        if self.output_path is not None:
            _write_arrays(self.output_path, answer, self.overwrite)
        if self.render_dir is not None:
            save_overlays(run.scene, answer, cameras, self.render_dir, overwrite=self.overwrite)
        stored = run.save(question) if self.save else None
        written = [path for path in (self.json, self.output_path, self.render_dir, stored) if path is not None]
        CONSOLE.print(_table(rows, f"{question.rule} > {question.threshold:g}"))
        if len(written) > 0:
            say("Written: " + ", ".join(map(str, written)))
        return rows

    def _check(self) -> None:
        """Raises what can be told before anything is loaded."""
        check_device(self.device)
        if len(self.text) == 0:
            raise InputError('no text given; name at least one thing to look for, such as --text "orange"')
        check_texts("text", self.text)
        check_lifted(self.load_config, self.data, self.ask)
        different(json=self.json, output_path=self.output_path)
        for flag, path in (("--json", self.json), ("--output-path", self.output_path)):
            if path is not None:
                refuse_existing(path, overwrite=self.overwrite, instead=flag)
                writable_file(path, flag)
        writable_folder(self.render_dir, "--render-dir")
        refuse_existing(*self._pictures(), overwrite=self.overwrite, instead="--render-dir")

    def _pictures(self) -> list[Path]:
        """Pictures that new ones would replace: of the same texts, and of the same views where some are named."""
        views = [glob.escape(Path(name).stem) for name in self.render_views] or ["*"]
        names = [f"{view}_{i}_{file_name(text)}.png" for view in views for i, text in enumerate(self.text)]
        return [] if self.render_dir is None else [path for name in names for path in self.render_dir.glob(name)]


def _write_json(path: Path, rows: list[dict[str, Any]], answer: Answer, overwrite: bool) -> None:
    question = answer.question
    facts = {"relevancy": question.rule, "threshold": question.threshold, "negatives": list(question.negatives)}
    write_text(path, json.dumps({"queries": rows, **facts}, indent=2) + "\n", overwrite=overwrite)


def _write_arrays(path: Path, answer: Answer, overwrite: bool) -> None:
    import numpy as np  # noqa: PLC0415

    tensors = {
        "relevancy": answer.relevancy,
        "reliability": answer.field.scalars.reliability,
        "valid": answer.valid,
    }
    arrays: dict[str, Any] = {name: value.numpy() for name, value in tensors.items()}
    with new_file(path, overwrite=overwrite) as draft, draft.open("wb") as file:
        np.savez(file, names=np.array(answer.texts), **arrays)


def _table(rows: list[dict[str, Any]], rule: str) -> Table:
    table = Table(title=f"Selected: {rule}")
    for name in ("text", "Gaussians", "centroid", "extent", "peak relevancy", "mean reliability"):
        table.add_column(name, justify="left" if name == "text" else "right")
    for row in rows:
        vectors = (" ".join(f"{x:.2f}" for x in row[name]) if row[name] else "-" for name in ("centroid", "extent"))
        numbers = (f"{row[name]:.3f}" if row[name] is not None else "-" for name in ("peak", "mean_reliability"))
        table.add_row(plain(row["text"]), f"{row['fraction']:.2%}", *vectors, *numbers)
    return table


def entrypoint() -> None:
    """Entry point of ns-normlift-query."""
    run_command(NormLiftQuery)


if __name__ == "__main__":
    entrypoint()
