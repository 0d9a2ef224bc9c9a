"""ns-normlift-query: ask a lifted run."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from normlift_ns.core.files import atomic_path
from normlift_ns.scripts.shared import CONSOLE, AskOptions, choose_device, run_command


@dataclass
class NormLiftQuery:
    """Ask a lifted run where things are: a table, and files on request."""

    load_config: Path
    """Path to config YAML file of the lifted run."""
    text: tuple[str, ...]
    """What to look for, one or several texts."""
    rule: AskOptions = field(default_factory=AskOptions)
    save: bool = False
    """Store the question in the run, in place of an earlier one: ns-render and ns-viewer then draw its answer."""
    json: Path | None = None
    """Write the table to this file."""
    output_path: Path | None = None
    """Write relevancy [N, Q], reliability [N], valid [N] and names to this .npz file."""
    render_dir: Path | None = None
    """Write pictures of the relevancy into this folder."""
    render_views: tuple[str, ...] = ()
    """Training images from whose cameras to render, such as 0001 0042; by default three of them, evenly spread."""
    data: Path | None = None
    """Where the dataset is now, if it was moved."""
    device: str = "auto"
    """auto, cpu or cuda: where the text encoder runs."""

    def main(self) -> list[dict[str, Any]]:
        """Asks, prints and writes; returns the rows of the table."""
        device = choose_device(self.device)

        from normlift_ns.plugin.adapters import load_run  # noqa: PLC0415 (nerfstudio takes 20 s)
        from normlift_ns.plugin.asking import ask, encoder_of, summarize, with_texts  # noqa: PLC0415
        from normlift_ns.plugin.config import FIELD_FOLDER  # noqa: PLC0415
        from normlift_ns.plugin.pictures import save_overlays, training_cameras  # noqa: PLC0415
        from normlift_ns.plugin.queries import save_question  # noqa: PLC0415
        from normlift_ns.plugin.run_dir import load_field  # noqa: PLC0415

        run = load_run(self.load_config, data=self.data)
        cameras = training_cameras(run, self.render_views)
        semantics = with_texts(load_field(run), vectors=self.rule.text_vectors, template=self.rule.text_template)
        texts = encoder_of(semantics, device, run.location.run_dir.parent / ".cache" / "texts")
        answer = ask(semantics, texts, self.text, **self.rule.keywords())
        rows, rule = summarize(answer, semantics, run.scene), answer.question
        CONSOLE.print(_table(rows, f"{rule.form} > {rule.threshold:g}"))
        if self.json is not None:
            facts = {"relevancy": rule.form, "threshold": rule.threshold, "negatives": list(rule.negatives)}
            with atomic_path(self.json) as temporary:
                temporary.write_text(json.dumps({"queries": rows, **facts}, indent=2) + "\n")
        if self.output_path is not None:
            tensors = {
                "relevancy": answer.relevancy,
                "reliability": semantics.scalars.reliability,
                "valid": answer.valid,
            }
            arrays: dict[str, Any] = {name: value.numpy() for name, value in tensors.items()}
            with atomic_path(self.output_path) as temporary, temporary.open("wb") as file:
                np.savez(file, names=np.array(self.text), **arrays)
        if self.render_dir is not None:
            save_overlays(run, answer, cameras, self.render_dir)
        stored = save_question(run.location.run_dir / FIELD_FOLDER, rule) if self.save else None
        written = [path for path in (self.json, self.output_path, self.render_dir, stored) if path is not None]
        if len(written) > 0:
            CONSOLE.print("Written: " + ", ".join(map(str, written)), highlight=False)
        return rows


def _table(rows: list[dict[str, Any]], rule: str) -> Table:
    table = Table(title=f"Selected: {rule}")
    for name in ("text", "Gaussians", "centroid", "extent", "peak relevancy", "mean reliability"):
        table.add_column(name, justify="left" if name == "text" else "right")
    for row in rows:
        vectors = (" ".join(f"{x:.2f}" for x in row[name]) if row[name] else "-" for name in ("centroid", "extent"))
        numbers = (f"{row[name]:.3f}" if row[name] is not None else "-" for name in ("peak", "mean_reliability"))
        table.add_row(row["text"], f"{row['fraction']:.2%}", *vectors, *numbers)
    return table


def entrypoint() -> None:
    """Entry point of ns-normlift-query."""
    run_command(NormLiftQuery)


if __name__ == "__main__":
    entrypoint()
