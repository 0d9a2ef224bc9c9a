"""ns-normlift-eval: score lifted runs by published protocols, or against instance masks of any capture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rich.table import Table

from normlift_ns.evaluation.protocols import (
    LerfOptions,
    LiftedRun,
    MaskOptions,
    ScannetOptions,
    run_lerf,
    run_masks,
    run_scannet,
)
from normlift_ns.evaluation.results import Evaluation, write_evaluation
from normlift_ns.scripts.shared import CONSOLE, choose_device, run_command


@dataclass
class NormLiftEval:
    """Evaluate lifted runs: a table, and a JSON file in the shape of ns-eval's."""

    protocol: Literal["scannet", "lerf", "masks"]
    """scannet: 3D, one Gaussian per labelled vertex. lerf: 2D, polygons of LERF-OVS. masks: instance masks of any
    capture, 3D and 2D."""
    load_config: tuple[Path, ...]
    """Paths to config YAML files of lifted runs, one per scene."""
    labels: tuple[Path, ...]
    """Truth of every run, in the same order. scannet: *_vh_clean_2.labels.ply; lerf: folder of JSON files; masks:
    folder of masks."""
    output_path: Path = Path("output.json")
    """Name of the output file."""
    refined: bool = True
    """Evaluate the refined directions."""
    text_vectors: Path | None = None
    """NPZ file, text -> vector, to look names up in instead of the encoder that the runs were lifted with."""
    data: Path | None = None
    """Where the dataset is now, if it was moved; for one run."""
    device: str = "auto"
    """auto, cpu or cuda: where the text encoder runs."""
    scannet: ScannetOptions = field(default_factory=ScannetOptions)
    lerf: LerfOptions = field(default_factory=LerfOptions)
    masks: MaskOptions = field(default_factory=MaskOptions)

    def main(self) -> Evaluation:
        """Evaluates, prints and writes."""
        if len(self.load_config) == 0 or len(self.load_config) != len(self.labels):
            raise ValueError(
                f"{len(self.load_config)} runs and {len(self.labels)} --labels were given; give one for each run, in "
                "the same order"
            )
        if len(self.load_config) > 1 and (self.protocol == "masks" or self.data is not None):
            raise ValueError("protocol masks and --data take one run at a time; name a single --load-config")
        device = choose_device(self.device)

        from normlift_ns.plugin.adapters import load_run  # noqa: PLC0415 (nerfstudio takes 20 s)
        from normlift_ns.plugin.asking import encoder_of, with_texts  # noqa: PLC0415
        from normlift_ns.plugin.run_dir import load_field  # noqa: PLC0415

        names: list[tuple[str, str]] = []

        def lifted(config: Path) -> LiftedRun:
            run = load_run(config, data=self.data)
            names.append((str(run.config.experiment_name), str(run.checkpoint.path)))
            semantics = with_texts(load_field(run), vectors=self.text_vectors)
            return LiftedRun(run, semantics, encoder_of(semantics, device), self.refined)

        runs: Iterator[LiftedRun] = (lifted(config) for config in self.load_config)  # scenes are large
        if self.protocol == "scannet":
            evaluation = run_scannet(runs, self.labels, self.scannet)
        elif self.protocol == "lerf":
            evaluation = run_lerf(runs, self.labels, self.lerf)
        else:
            evaluation = run_masks(next(runs), self.labels[0], self.masks)
        experiments, checkpoints = (", ".join(values) for values in zip(*names))
        write_evaluation(
            self.output_path, evaluation, experiment_name=experiments, method_name="normlift", checkpoint=checkpoints
        )
        CONSOLE.print(rows_table(evaluation))
        CONSOLE.print(results_table(evaluation))
        CONSOLE.print(f"Written: {self.output_path}", highlight=False)
        return evaluation


def results_table(evaluation: Evaluation) -> Table:
    """The means."""
    table = Table("metric", "value", title=f"Protocol {evaluation.settings['protocol']}")
    for name, value in evaluation.results.items():
        table.add_row(name, f"{value:.4f}")
    return table


def rows_table(evaluation: Evaluation) -> Table:
    """One row per class, with scene or frame where there are several."""
    table = Table(*(evaluation.rows[0] if len(evaluation.rows) > 0 else ()))
    for row in evaluation.rows:
        table.add_row(*(f"{x:.3f}" if isinstance(x, float) else str(x) for x in row.values()))
    return table


def entrypoint() -> None:
    """Entry point of ns-normlift-eval."""
    run_command(NormLiftEval)


if __name__ == "__main__":
    entrypoint()
