"""ns-normlift-export: a lifted run as a PLY file of Gaussians and a table of objects."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from rich.table import Table

from normlift_ns.core.files import atomic_path
from normlift_ns.scripts.shared import CONSOLE, AskOptions, choose_device, run_command


@dataclass
class NormLiftExport:
    """Write a lifted run, the things asked for, or the scene without them, for other splat tools."""

    load_config: Path
    """Path to config YAML file of the lifted run."""
    output_dir: Path
    """Folder to write to; made if missing."""
    text: tuple[str, ...] = ()
    """What to look for; by default the queries stored in the run, with the rule stored with them."""
    part: Literal["scene", "selection", "rest"] = "scene"
    """scene: all Gaussians. selection: what any of the texts selects. rest: the scene without that."""
    ask: AskOptions = field(default_factory=AskOptions)
    output_filename: str = "splat.ply"
    """Name of the PLY file; the rows it has of the run go to <name>_rows.npy, the objects to <name>_objects.json."""
    reach: float = 4.0
    """Gaussians of one object are at most this far apart, in units of the selection's median spacing."""
    min_size: int = 20
    """Least number of Gaussians of an object."""
    overwrite: bool = False
    """Replace files of these names."""
    data: Path | None = None
    """Where the dataset is now, if it was moved."""
    device: str = "auto"
    """auto, cpu or cuda: where the text encoder runs."""

    def main(self) -> Path:
        """Writes the files; returns the path of the PLY file."""
        device = choose_device(self.device)
        target = self.output_dir / Path(self.output_filename).name
        beside = {kind: target.with_name(f"{target.stem}_{kind}") for kind in ("rows.npy", "objects.json")}
        found = [path for path in (target, *beside.values()) if path.exists()]
        if len(found) > 0 and not self.overwrite:
            raise FileExistsError(
                f"{found[0]} exists; give another --output-dir or --output-filename, or --overwrite True."
            )

        from normlift_ns.plugin.adapters import load_run  # noqa: PLC0415 (nerfstudio takes 20 s)
        from normlift_ns.plugin.asking import encoder_of, pose, respond, with_texts  # noqa: PLC0415
        from normlift_ns.plugin.config import FIELD_FOLDER  # noqa: PLC0415
        from normlift_ns.plugin.objects import object_table  # noqa: PLC0415
        from normlift_ns.plugin.ply import write_splats  # noqa: PLC0415
        from normlift_ns.plugin.queries import load_question  # noqa: PLC0415
        from normlift_ns.plugin.run_dir import load_field  # noqa: PLC0415

        run = load_run(self.load_config, data=self.data)
        semantics = with_texts(load_field(run), vectors=self.ask.text_vectors, template=self.ask.text_template)
        if len(self.text) > 0:
            texts = encoder_of(semantics, device, run.location.run_dir.parent / ".cache" / "texts")
            question = pose(semantics, texts, self.text, **self.ask.keywords())
        else:
            question = load_question(run.location.run_dir / FIELD_FOLDER)
        if question is None and self.part != "scene":
            raise ValueError(f"--part {self.part} needs something to look for: give --text, the run stores no queries.")
        answer = None if question is None else respond(semantics, question)
        chosen = torch.zeros(len(run.scene), dtype=torch.bool) if answer is None else answer.selected.any(dim=1)
        self.output_dir.mkdir(parents=True, exist_ok=True)
        state = run.checkpoint.model
        rows = write_splats(
            target,
            {name.removeprefix("gauss_params."): x for name, x in state.items() if name.startswith("gauss_params.")},
            semantics,
            answer,
            keep={"scene": torch.ones_like(chosen), "selection": chosen, "rest": ~chosen}[self.part],
            spherical_harmonics=run.model_config.sh_degree > 0,
        )
        CONSOLE.print(f"{len(rows):,} of {len(run.scene):,} Gaussians in {target}", highlight=False)
        beside["objects.json"].unlink(missing_ok=True)
        if answer is not None:
            rule = answer.question
            tables: list[dict[str, Any]] = [
                {"text": text, **object_table(semantics, run.scene, chosen, reach=self.reach, min_size=self.min_size)}
                for text, chosen in zip(answer.texts, answer.selected.T)
            ]
            facts = {"relevancy": rule.form, "threshold": rule.threshold, "min_reliability": rule.min_reliability}
            with atomic_path(beside["objects.json"]) as temporary:
                temporary.write_text(json.dumps({"queries": tables, **facts}, indent=2) + "\n")
            CONSOLE.print(_table(tables))
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
            table.add_row(entry["text"] if i == 0 else "", str(i), *numbers)
        table.add_row(
            "" if entry["objects"] else entry["text"], "smaller", f"{entry['in_smaller_parts']:,}", "", "", ""
        )
    return table


def entrypoint() -> None:
    """Entry point of ns-normlift-export."""
    run_command(NormLiftExport)


if __name__ == "__main__":
    entrypoint()
