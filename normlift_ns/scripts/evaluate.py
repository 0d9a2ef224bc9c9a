"""ns-normlift-eval: score lifted runs by published protocols, or against instance masks of any capture."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from rich.table import Column, Table

from normlift_ns.core.files import refuse_existing
from normlift_ns.errors import InputError
from normlift_ns.evaluation.options import LerfOptions, MaskOptions, ScannetOptions, pose_files
from normlift_ns.ranges import check_device, check_options
from normlift_ns.scripts.early import check_lifted, readable_file, readable_folder, writable_file
from normlift_ns.scripts.shared import CONSOLE, plain, run_command, run_process, say, say_opening

if TYPE_CHECKING:
    from normlift_ns.evaluation.protocols import EvaluatedRun
    from normlift_ns.evaluation.results import Evaluation
    from normlift_ns.evaluation.studies import Evaluate, Row

_WITH_FIGURE = ("sweeps", "signals")
"""Studies that are drawn."""
_WITHOUT_TRUTH = ("coverage", "timing")
"""Studies that need no truth."""


@dataclass
class NormLiftEval:
    """Evaluate lifted runs: a table, and a JSON file in the shape of ns-eval's."""

    load_config: tuple[Path, ...]
    """Paths to config YAML files of lifted runs, one per scene."""
    protocol: Literal["scannet", "lerf", "masks", "none"] = "none"
    """scannet: 3D, one Gaussian per labelled vertex. lerf: 2D, polygons of LERF-OVS. masks: instance masks of any
    capture, 3D and 2D. none: no truth and no score, for --study coverage and timing."""
    labels: tuple[Path, ...] = ()
    """Truth of every run, in the same order. scannet: *_vh_clean_2.labels.ply; lerf: folder of JSON files; masks:
    folder of masks; none: nothing."""
    output_path: Path = Path("output.json")
    """Name of the output file."""
    overwrite: bool = False
    """Replace the output file and the figures beside it."""
    refined: bool = True
    """Evaluate the refined directions."""
    study: tuple[Literal["ablation", "sweeps", "signals", "timing", "baselines", "coverage"], ...] = ()
    """What to measure besides. ablation: the variants of the refinement, with and without consensus. sweeps: every
    parameter of the vote around the run's own, with the default. signals: Gaussians without evidence, accuracy by R and
    by norm, R against opacity. timing: what lifting took and, on a GPU, what SFS's way takes, 512 channels through
    gsplat. baselines: the ideas of SFS, Occam's LGS, VALA and Dr.Splat on the features of the run, in our
    implementation. coverage: regions without reliable evidence, photographs left out of the lift that would help, and
    new poses, drawn and as a camera path. Holds all runs in memory."""
    text_vectors: Path | None = None
    """NPZ file, text -> vector, to look names up in instead of the encoder that the runs were lifted with."""
    data: Path | None = None
    """Where the dataset is now, if it was moved; for one run."""
    device: str = "auto"
    """auto, cpu or cuda: where the text encoder and --study run."""
    scannet: ScannetOptions = field(default_factory=ScannetOptions)
    lerf: LerfOptions = field(default_factory=LerfOptions)
    masks: MaskOptions = field(default_factory=MaskOptions)

    def __post_init__(self) -> None:
        check_options(self)

    def main(self) -> Evaluation:
        """Evaluates, writes and prints."""
        self._check()
        say_opening(*self.load_config)
        from normlift_ns.core.gpu import choose_device  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.evaluation.coverage.files import write_poses  # noqa: PLC0415
        from normlift_ns.evaluation.coverage.study import coverage_of  # noqa: PLC0415
        from normlift_ns.evaluation.protocols import EvaluatedRun  # noqa: PLC0415
        from normlift_ns.evaluation.results import write_evaluation  # noqa: PLC0415
        from normlift_ns.evaluation.studies import baselines, study_ablation, study_votes, timing  # noqa: PLC0415
        from normlift_ns.evaluation.votes import sweeps  # noqa: PLC0415
        from normlift_ns.front_door import open_run  # noqa: PLC0415
        from normlift_ns.runs.files import cache_folder  # noqa: PLC0415

        device = choose_device(self.device)
        names: list[tuple[str, str]] = []

        def evaluated(config: Path) -> EvaluatedRun:
            run = open_run(config, data=self.data, device=device, text_vectors=self.text_vectors)
            names.append((run.scene.name, str(run.scene.checkpoint_path)))
            texts = cast(Any, None) if self.protocol == "none" else run.texts  # nothing is asked then
            return EvaluatedRun(run.scene, run.field, texts, self.refined, cache_folder(run.folder))

        # Scenes are large: one is held at a time, unless they are studied.
        runs: Iterable[EvaluatedRun] = (evaluated(config) for config in self.load_config)
        if self.study or self.protocol == "masks":
            runs = list(runs)
        evaluate, measure_signals = self._protocol(runs)
        evaluation, studies, posed = evaluate(runs), {}, ((), ())
        for name in self.study:
            held = list(runs)
            if name == "signals":
                studies[name] = measure_signals(held)
            elif name == "timing":
                studies[name] = timing(held, device, say)
            elif name == "baselines":
                studies[name] = baselines(held, evaluate, device)
            elif name == "coverage":
                seen = coverage_of(held[0].scene, held[0].field, device=device)
                studies[name] = [seen.to_json()]
                posed = seen.poses, seen.pictures
            elif name == "ablation":
                studies[name] = study_ablation(held, evaluate, device, say)
            else:
                studies[name] = study_votes(held, evaluate, sweeps, device)
        experiments, checkpoints = (", ".join(values) for values in zip(*names))
        write_evaluation(
            self.output_path, evaluation, experiment_name=experiments, method_name="normlift", checkpoint=checkpoints,
            studies=studies, overwrite=self.overwrite,
        )  # fmt: skip
        written = [self.output_path, *self._plots(studies, evaluation.results)]
        written += write_poses(self._coverage, *posed, overwrite=self.overwrite)
        if len(evaluation.results) > 0:
            CONSOLE.print(rows_table(evaluation.rows))
            if len(evaluation.scenes) > 1:
                CONSOLE.print(rows_table(evaluation.scenes, "scenes"))
            CONSOLE.print(results_table(evaluation))
        for name, rows in studies.items():
            if name == "coverage":
                for part in ("regions", "photographs", "poses"):
                    CONSOLE.print(rows_table([_short(i, row) for i, row in enumerate(rows[0][part], 1)], part))
                for remark in rows[0]["remarks"]:
                    say(remark)
            else:
                CONSOLE.print(signals_table(rows) if name == "signals" else rows_table(rows, name))
        say(f"Written: {', '.join(map(str, written))}")
        return evaluation

    def _check(self) -> None:
        """Raises what can be told before anything is loaded."""
        check_device(self.device)
        if self.protocol == "none":
            self._check_without_truth()
        elif len(self.load_config) == 0 or len(self.load_config) != len(self.labels):
            raise InputError(
                f"{len(self.load_config)} runs and {len(self.labels)} --labels were given; give one for each run, in "
                "the same order"
            )
        if len(self.load_config) > 1 and (self.protocol == "masks" or self.data is not None):
            raise InputError("protocol masks and --data take one run at a time; name a single --load-config")
        if len(self.load_config) > 1 and "coverage" in self.study:
            raise InputError("--study coverage takes one run at a time; name a single --load-config")
        readable_file(self.text_vectors, "--text-vectors")
        for config in self.load_config:
            check_lifted(config, self.data)
        for labels in self.labels:
            (readable_file if self.protocol == "scannet" else readable_folder)(labels, "--labels")
        readable_file(self.masks.names, "--names")
        figures = [self._figure(name) for name in _WITH_FIGURE if name in self.study]
        figures += pose_files(self._coverage) if "coverage" in self.study else []
        refuse_existing(self.output_path, *figures, overwrite=self.overwrite, instead="--output-path")
        for path in (self.output_path, *figures):
            writable_file(path, "--output-path")

    def _check_without_truth(self) -> None:
        """What only studies can tell."""
        others = [name for name in self.study if name not in _WITHOUT_TRUTH]
        if len(self.load_config) == 0 or len(self.study) == 0 or len(others) > 0 or len(self.labels) > 0:
            raise InputError(
                f"protocol none takes runs (--load-config), no --labels, and --study {' or '.join(_WITHOUT_TRUTH)}; "
                "for all else, name the protocol that scores them"
            )

    def _protocol(self, runs: Iterable[EvaluatedRun]) -> tuple[Evaluate, Callable[[Sequence[EvaluatedRun]], list[Row]]]:
        """How to score runs, and how to measure the signals of R."""
        from normlift_ns.evaluation import protocols, studies  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.evaluation.results import Evaluation  # noqa: PLC0415

        if self.protocol == "none":
            return lambda some: Evaluation({}, [], {"protocol": "none"}), lambda some: []
        if self.protocol == "scannet":
            given = {"labels": self.labels, "options": self.scannet}
            return partial(protocols.run_scannet, **given), partial(studies.scannet_signals, **given)
        if self.protocol == "lerf":
            evaluate = partial(protocols.run_lerf, labels=self.labels, options=self.lerf)
            return evaluate, partial(studies.plain_signals, labels=self.labels)
        run = next(iter(runs))
        truth = protocols.mask_truth(run.scene, self.labels[0], self.masks, settings=run.settings)
        return (
            lambda some: protocols.run_masks(next(iter(some)), truth),
            lambda some: studies.mask_signals(some[0], truth),
        )

    def _plots(self, studies: Mapping[str, list[Row]], results: Mapping[str, float]) -> Iterator[Path]:
        """Figures beside the output file; sweeps are of the first result."""
        from normlift_ns.evaluation.plots import plot_signals, plot_sweeps  # noqa: PLC0415

        metric, result = next(iter(results.items()), ("", 0.0))
        for name in _WITH_FIGURE:
            if name not in studies:
                continue
            path = self._figure(name)
            if name == "sweeps":
                plot_sweeps(studies[name], metric, metric, path, result=result, overwrite=self.overwrite)
            else:
                plot_signals(studies[name], path, overwrite=self.overwrite)
            yield path

    @property
    def _coverage(self) -> Path:
        """How names of files of the study of coverage begin."""
        return self.output_path.with_name(f"{self.output_path.stem}_coverage")

    def _figure(self, study: str) -> Path:
        return self.output_path.with_name(f"{self.output_path.stem}_{study}.svg")


def results_table(evaluation: Evaluation) -> Table:
    """The means."""
    table = Table("metric", "value", title=f"Protocol {evaluation.settings['protocol']}")
    for name, value in evaluation.results.items():
        table.add_row(name, f"{value:.4f}")
    return table


def rows_table(rows: Sequence[Row], title: str | None = None) -> Table:
    """One row per class, with scene or frame where there are several; or per vote."""
    table = Table(*(Column(plain(name), overflow="fold") for name in (rows[0] if len(rows) > 0 else ())), title=title)
    for row in rows:
        table.add_row(*(f"{x:.3f}" if isinstance(x, float) else plain(x) for x in row.values()))
    return table


def _short(number: int, row: Row) -> Row:
    """A numbered row of the study of coverage, without what only programs need."""
    found: dict[str, Any] = {"": number}
    for name, value in row.items():
        if name not in ("box", "camera_to_world", "lifted_reliability"):
            numbers = isinstance(value, list) and all(isinstance(x, float) for x in value)
            found[name] = " ".join(f"{x:.2f}" for x in value) if numbers else value
    return found


def signals_table(rows: Sequence[Row]) -> Table:
    """One column per scene."""
    scenes = (Column(plain(row.get("scene", "value")), overflow="fold") for row in rows)
    table = Table("signal", *scenes, title="signals")
    for name in (key for key in rows[0] if key != "scene"):
        digits = ".3g" if name.endswith("_p") else ".3f"  # p-values may be tiny
        table.add_row(name, *(f"{row[name]:{digits}}" for row in rows))
    return table


def entrypoint() -> None:
    """ns-normlift-eval, in a process that goes on."""
    run_command(NormLiftEval)


def main() -> None:
    """Entry point of ns-normlift-eval."""
    run_process(NormLiftEval)


if __name__ == "__main__":
    main()
