"""ns-normlift-eval: score lifted runs by published protocols or against instance masks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from rich.table import Column, Table

from normlift_ns.cli.common import CONSOLE, info, info_opening, plain_text, run_command, run_command_process
from normlift_ns.cli.preflight import check_lifted_run, check_new_files, check_readable_file, check_readable_folder
from normlift_ns.errors import InputError
from normlift_ns.evaluation.options import LerfOptions, MaskOptions, ScannetOptions, pose_output_paths
from normlift_ns.options import CheckedOptions, check_device, renamed

if TYPE_CHECKING:
    from normlift_ns.evaluation.options import Evaluation
    from normlift_ns.evaluation.protocols import EvaluatedRun
    from normlift_ns.evaluation.studies import Evaluate, Row


_WITH_FIGURE = ("sweeps", "signals")
"""Studies that write a figure."""
_WITHOUT_TRUTH = ("coverage", "timing")
"""Studies that need no ground truth."""


@renamed(text_vectors="text_embeddings")
@dataclass
class NormLiftEval(CheckedOptions):
    """Evaluate lifted runs, print tables, and write a JSON file in the format of ns-eval."""

    load_config: tuple[Path, ...]
    """Paths to the config.yml files of lifted runs, one per scene."""
    protocol: Literal["scannet", "lerf", "masks", "none"] = "none"
    """Evaluation protocol. scannet: in 3D, with one Gaussian per labeled vertex. lerf: in 2D, with the polygons of
    LERF-OVS. masks: in 3D and 2D, with instance masks of any capture, for a single run. none: no ground truth and no
    scores; needs --study coverage or timing."""
    labels: tuple[Path, ...] = ()
    """Ground truth of each run, in the order of --load-config. scannet: a *_vh_clean_2.labels.ply file. lerf: a folder
    of JSON files. masks: a folder of instance masks. none: no ground truth."""
    output_path: Path = Path("output.json")
    """JSON file to write."""
    overwrite: bool = False
    """Replace an existing output file, and files of studies next to it."""
    refined: bool = True
    """Evaluate the directions after the vote. False: evaluate the directions before the vote."""
    study: tuple[Literal["ablation", "sweeps", "signals", "timing", "baselines", "coverage"], ...] = ()
    """Additional studies, which load all runs into memory. ablation: scores of variants of the vote, with and without
    consensus. sweeps: scores for different values of beta, k, sigma_d, tau, gamma and delta, including the defaults and
    the values of the run. signals: the share of Gaussians without evidence, accuracy by reliability and by the norm of
    the mean feature, and a comparison of reliability with opacity. timing: seconds of the lift and, on a GPU, of the
    method of SFS (Splat Feature Solver), which composites 512 channels with gsplat. baselines: scores of techniques
    from SFS, Occam's LGS, VALA and Dr.Splat, reimplemented on the features of the run. coverage, for a single run:
    parts of the scene without reliable evidence, unused images that would help, and new camera poses, as renders and as
    a camera path."""
    compare: Literal["paper"] | None = None
    """Published results to compare with yours, in the printed tables and in the output file. paper: results of the
    paper. Needs --protocol scannet, which also compares the studies ablation and signals, or lerf, which also compares
    timing."""
    text_embeddings: Path | None = None
    """NPZ file with one vector per class name, used instead of the text encoder of the runs."""
    data: Path | None = None
    """Current path of the dataset, if it was moved. Works only with a single run in --load-config."""
    device: str = "auto"
    """Device for the text encoder and --study: auto, cpu, cuda, or one GPU such as cuda:1."""
    scannet: ScannetOptions = field(default_factory=ScannetOptions)
    lerf: LerfOptions = field(default_factory=LerfOptions)
    masks: MaskOptions = field(default_factory=MaskOptions)

    def main(self) -> Evaluation:
        """Evaluate the runs, write the output file and print the tables."""
        self._check()
        info_opening(*self.load_config)
        from normlift_ns.core.device import choose_device  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.evaluation import studies  # noqa: PLC0415
        from normlift_ns.evaluation.coverage import coverage_of, write_poses  # noqa: PLC0415
        from normlift_ns.evaluation.options import write_evaluation  # noqa: PLC0415
        from normlift_ns.evaluation.published import compare_with_paper  # noqa: PLC0415

        device = choose_device(self.device)
        names: list[tuple[str, str]] = []
        # Scenes are large, so only studies load more than one into memory.
        runs: Iterable[EvaluatedRun] = self._load(device, names)
        loaded = list(runs) if self.study or self.protocol == "masks" else []
        runs = loaded or runs
        evaluate, measure_signals = self._protocol(runs)
        evaluation = evaluate(runs)
        covered = coverage_of(loaded[0].scene, loaded[0].field, device=device) if "coverage" in self.study else None
        measure: dict[str, Callable[[], list[Row]]] = {
            "signals": lambda: measure_signals(loaded),
            "timing": lambda: studies.study_timing(loaded, device, info),
            "baselines": lambda: studies.study_baselines(loaded, evaluate, device),
            "coverage": lambda: [] if covered is None else [covered.to_json()],
            "ablation": lambda: studies.study_ablation(loaded, evaluate, device, info),
            "sweeps": lambda: studies.study_votes(loaded, evaluate, studies.sweeps, device),
        }
        found: dict[str, list[Row]] = {name: measure[name]() for name in self.study}
        compared = compare_with_paper(evaluation, found) if self.compare == "paper" else {}
        write_evaluation(
            self.output_path, evaluation, names, studies=found, comparison=compared, overwrite=self.overwrite
        )
        written = [self.output_path, *self._plots(found, evaluation.results)]
        if covered is not None:
            written += write_poses(self._beside("coverage"), covered.poses, covered.pictures, overwrite=self.overwrite)
        _print_tables(evaluation, found)
        for title, rows in compared.items():
            CONSOLE.print(rows_table(rows, title))
        info(f"Written: {', '.join(map(str, written))}")
        return evaluation

    def _load(self, device: str, names: list[tuple[str, str]]) -> Iterator[EvaluatedRun]:
        """Yield the runs, and append the name and the checkpoint of each to `names`."""
        from normlift_ns.evaluation.protocols import EvaluatedRun  # noqa: PLC0415
        from normlift_ns.io.run_dir import cache_folder  # noqa: PLC0415
        from normlift_ns.lifted_run import open_run  # noqa: PLC0415 (--help should not wait for torch)

        for config in self.load_config:
            run = open_run(config, data=self.data, device=device, text_embeddings=self.text_embeddings)
            names.append((run.scene.name, str(run.scene.checkpoint_path)))
            texts = cast(Any, None) if self.protocol == "none" else run.texts  # no encoder is needed without prompts
            yield EvaluatedRun(run.scene, run.field, texts, self.refined, cache_folder(run.folder))

    def _check(self) -> None:
        """Raise errors that can be detected before anything is loaded."""
        check_device(self.device)
        for name in {"scannet", "lerf", "masks"} - {self.protocol}:
            given, default = vars(getattr(self, name)), vars(type(getattr(self, name))())
            for option in (option for option in given if given[option] != default[option]):
                raise InputError(
                    f"--{option.replace('_', '-')} is an option of --protocol {name}, not of {self.protocol}; leave it "
                    f"out, or give --protocol {name}"
                )
        if self.compare == "paper" and self.protocol not in ("scannet", "lerf"):
            raise InputError(
                f"--compare paper needs --protocol scannet or lerf, not {self.protocol}; give one of these, or leave "
                "--compare out"
            )
        runs = len(self.load_config)
        if self.protocol == "none":
            self._check_without_truth()
        elif runs == 0 or runs != len(self.labels):
            raise InputError(
                f"--load-config and --labels must have the same number of paths, at least one, got {runs} and "
                f"{len(self.labels)}; give one --labels path for each run, in the same order"
            )
        if runs > 1 and (self.protocol == "masks" or self.data is not None):
            flag = "--data" if self.data is not None else "--protocol masks"
            raise InputError(f"{flag} works only with a single run; give one path with --load-config")
        if runs > 1 and "coverage" in self.study:
            raise InputError("--study coverage works only with a single run; give one path with --load-config")
        self._check_files()

    def _check_files(self) -> None:
        """Raise an error if an input file does not exist or an output file cannot be written."""
        check_readable_file(self.text_embeddings, "--text-embeddings")
        for config in self.load_config:
            check_lifted_run(config, self.data)
        for labels in self.labels:
            (check_readable_file if self.protocol == "scannet" else check_readable_folder)(labels, "--labels")
        check_readable_file(self.masks.names, "--names")
        figures = [self._beside(f"{name}.svg") for name in _WITH_FIGURE if name in self.study]
        figures += pose_output_paths(self._beside("coverage")) if "coverage" in self.study else []
        check_new_files(self.output_path, *figures, overwrite=self.overwrite, flags="--output-path")

    def _check_without_truth(self) -> None:
        """Raise InputError if the options do not suit a study without ground truth."""
        others = [name for name in self.study if name not in _WITHOUT_TRUTH]
        if len(self.load_config) == 0 or len(self.study) == 0 or len(others) > 0 or len(self.labels) > 0:
            raise InputError(
                f"--protocol none needs --load-config and --study {' or '.join(_WITHOUT_TRUTH)}, without --labels; for "
                "scores and other studies, give another --protocol"
            )

    def _protocol(self, runs: Iterable[EvaluatedRun]) -> tuple[Evaluate, Callable[[Sequence[EvaluatedRun]], list[Row]]]:
        """Return a function that scores runs, and a function for --study signals."""
        from normlift_ns.evaluation import lerf, protocols, scannet, studies  # noqa: PLC0415 (--help should not wait for torch)
        from normlift_ns.evaluation.options import Evaluation  # noqa: PLC0415

        if self.protocol == "none":
            return lambda runs: Evaluation({}, [], {"protocol": "none"}), lambda runs: []
        if self.protocol == "scannet":
            kwargs = {"labels": self.labels, "options": self.scannet}
            return partial(scannet.run_scannet, **kwargs), partial(studies.scannet_signals, **kwargs)
        if self.protocol == "lerf":
            evaluate = partial(lerf.run_lerf, labels=self.labels, options=self.lerf)
            return evaluate, partial(studies.plain_signals, labels=self.labels)
        run = next(iter(runs))
        truth = protocols.mask_truth(run.scene, self.labels[0], self.masks, settings=run.settings)
        return (
            lambda runs: protocols.run_masks(next(iter(runs)), truth),
            lambda runs: studies.mask_signals(runs[0], truth),
        )

    def _plots(self, studies: Mapping[str, list[Row]], results: Mapping[str, float]) -> Iterator[Path]:
        """Save the figures next to the output file and yield their paths. Sweeps show the first metric."""
        from normlift_ns.evaluation.studies import save_figure, signals_figure, sweeps_figure  # noqa: PLC0415

        metric, result = next(iter(results.items()), ("", 0.0))
        draw = {"sweeps": lambda rows: sweeps_figure(rows, metric, metric, result), "signals": signals_figure}
        for name in (name for name in _WITH_FIGURE if name in studies):
            save_figure(draw[name](studies[name]), self._beside(f"{name}.svg"), overwrite=self.overwrite)
            yield self._beside(f"{name}.svg")

    def _beside(self, end: str) -> Path:
        """Return the path <stem>_<end> next to the output file."""
        return self.output_path.with_name(f"{self.output_path.stem}_{end}")


def _print_tables(evaluation: Evaluation, studies: Mapping[str, list[Row]]) -> None:
    if len(evaluation.results) > 0:
        CONSOLE.print(rows_table(evaluation.rows))
        if len(evaluation.scenes) > 1:
            CONSOLE.print(rows_table(evaluation.scenes, "scenes"))
        means = ((name, f"{value:.4f}") for name, value in evaluation.results.items())
        CONSOLE.print(_table(("metric", "value"), means, f"Protocol {evaluation.settings['protocol']}"))
    for name, rows in studies.items():
        if name != "coverage":
            CONSOLE.print(signals_table(rows) if name == "signals" else rows_table(rows, name))
            continue
        for part in ("regions", "photographs", "poses"):
            CONSOLE.print(rows_table([_short(i, row) for i, row in enumerate(rows[0][part], 1)], part))
        for remark in rows[0]["remarks"]:
            info(remark)


def _table(columns: Iterable[object], rows: Iterable[Iterable[object]], title: str | None) -> Table:
    table = Table(*(Column(plain_text(name), overflow="fold") for name in columns), title=title)
    for row in rows:
        table.add_row(*map(plain_text, row))
    return table


def rows_table(rows: Sequence[Row], title: str | None = None) -> Table:
    """Return a table of rows, for example one per class, frame or vote variant."""
    lines = ([f"{x:.3f}" if isinstance(x, float) else x for x in row.values()] for row in rows)
    return _table(rows[0] if len(rows) > 0 else (), lines, title)


def _short(number: int, row: Row) -> Row:
    """Return a numbered row of the coverage study for a table, without values that only programs need."""
    shown: dict[str, Any] = {"": number}
    for name, value in row.items():
        if name not in ("box", "camera_to_world", "lifted_reliability"):
            is_vector = isinstance(value, list) and all(isinstance(x, float) for x in value)
            shown[name] = " ".join(f"{x:.2f}" for x in value) if is_vector else value
    return shown


def signals_table(rows: Sequence[Row]) -> Table:
    """Return a table of signals with one column per scene. p-values have three significant digits."""
    digits = {name: ".3g" if name.endswith("_p") else ".3f" for name in rows[0] if name != "scene"}
    lines = ([name, *(f"{row[name]:{format_}}" for row in rows)] for name, format_ in digits.items())
    return _table(("signal", *(row.get("scene", "value") for row in rows)), lines, "signals")


def entrypoint() -> None:
    """Run ns-normlift-eval, and return to the caller if it succeeds."""
    run_command(NormLiftEval)


if __name__ == "__main__":
    run_command_process(NormLiftEval)
