"""Lifted runs: made by `lift_run`, opened by `open_run`, and all that can be done with one."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from numpy import ndarray
from torch import Tensor

from normlift_ns.asking import (
    Answer,
    Finding,
    Question,
    answer,
    encoder_of,
    encoder_settings,
    given_settings,
    make_question,
    with_texts,
)
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera
from normlift_ns.core.gpu import choose_device
from normlift_ns.core.query import CANONICAL_NEGATIVES
from normlift_ns.core.scene import Scene
from normlift_ns.encoders.build import make_source
from normlift_ns.encoders.given import GivenFeatures, features_by_name
from normlift_ns.encoders.source import FeatureSource, TextEncoder
from normlift_ns.lifting import Export, lift_scene
from normlift_ns.options import LiftOptions, Rule, SourceOptions
from normlift_ns.raster.rasterize import render, render_picture
from normlift_ns.runs.files import (
    FIELD_FOLDER,
    TEXTS_FILE,
    cache_folder,
    load_field,
    refuse_existing,
    run_directory,
    texts_cache,
    with_paths,
)
from normlift_ns.runs.question import load_question, save_question
from normlift_ns.runs.splats import write_splats
from normlift_ns.stages import Report
from normlift_ns.viewer.display import draw, make_display


@dataclass(frozen=True)
class LiftedRun:
    """A trained scene with its semantics, on disk and in memory.

    >>> run = open_run(config)
    >>> red = run.ask("red")["red"]
    >>> red.mask.shape == red.relevancy.shape == (len(run.scene.gaussians),)
    True
    >>> run.render("0001", red).shape
    torch.Size([120, 160, 3])
    """

    folder: Path
    """The run directory, which holds config.yml."""
    scene: Scene
    field: SemanticField
    device: str = "cpu"
    """Where the text encoder works."""
    seconds: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Of each stage of the lift that made the run; empty where it was opened."""

    @property
    def config(self) -> Path:
        """The config.yml, for ns-viewer and the other commands."""
        return self.folder / "config.yml"

    @cached_property
    def texts(self) -> TextEncoder:
        """The encoder of texts that fits the field; it loads its network when it first needs it.

        Raises:
            ValueError, FileNotFoundError: as `encoder_of`.
        """
        return encoder_of(self.field, self.device, texts_cache(self.folder))

    def ask(
        self,
        *texts: str,
        negatives: Sequence[str] | None = None,
        rule: Rule | Literal["auto"] = "auto",
        threshold: float | None = None,
        min_reliability: float = 0.0,
        refined: bool = True,
    ) -> Answer:
        """Relevancy and selection of every Gaussian for each text.

        Args:
            negatives: texts to compare with; None: LERF's, where the encoder knows them.
            rule: how relevancy follows from cosines, see `relevancy`. "auto": lerf with negatives, else cosine.
            threshold: relevancy above which a Gaussian is selected; None: 0.5, for rule margin 0.02.
            min_reliability: minimum R of a selected Gaussian, in 0..1.
            refined: use refined features.
        Raises:
            ValueError: no text, an empty one, or one that the encoder does not understand.
        """
        question = make_question(
            self.field,
            self.texts,
            texts,
            negatives=negatives,
            rule=rule,
            threshold=threshold,
            min_reliability=min_reliability,
            refined=refined,
        )
        return answer(self.field, self.scene.gaussians.means, question)

    def ask_stored(self) -> Answer | None:
        """The answer to the question stored in the run; None if there is none."""
        question = load_question(self.folder / FIELD_FOLDER)
        return None if question is None else answer(self.field, self.scene.gaussians.means, question)

    def save(self, question: Question) -> Path:
        """Stores a question in the run, in place of an earlier one: ns-render and ns-viewer draw its answer."""
        return save_question(self.folder / FIELD_FOLDER, question)

    def export(
        self,
        path: str | Path,
        part: Answer | Finding | Bool[Tensor, " n"] | None = None,
        *,
        answer: Answer | None = None,
        overwrite: bool = False,
    ) -> Int64[ndarray, " m"]:
        """Writes Gaussians to a PLY file, and beside it their rows in the scene as <stem>_rows.npy; returns those rows.

        Args:
            part: what an answer, or one of its findings, selects; or a mask of Gaussians; None: the whole scene.
            answer: whose relevancies and labels the file gets; None: that of `part`, if it has one.
            overwrite: replace files of these names.
        Raises:
            FileExistsError: a file is there and `overwrite` is False.
            ValueError: no Gaussian of the part is ever drawn.
        """
        path = Path(path)
        for file in (path, path.with_name(f"{path.stem}_rows.npy")):
            if file.exists() and not overwrite:
                raise FileExistsError(f"{file} exists; give another name, or overwrite=True")
        if answer is None and not isinstance(part, Tensor | None):
            answer = part if isinstance(part, Answer) else part.answer
        everything = torch.ones(len(self.scene.gaussians), dtype=torch.bool)
        keep = everything if part is None else part if isinstance(part, Tensor) else part.mask
        path.parent.mkdir(parents=True, exist_ok=True)
        return write_splats(
            path,
            self.scene.parameters,
            self.field,
            answer,
            keep=keep,
            spherical_harmonics=self.scene.has_harmonics,
        )

    def camera(self, view: str | int) -> Camera:
        """The camera of a training image, by its number or its name; the folder and the suffix may be left out.

        Raises:
            KeyError, IndexError: no such image.
        """
        cameras, names = self.scene.train.cameras, self.scene.train.names
        if isinstance(view, int):
            return cameras[view]
        for name, camera in zip(names, cameras):
            if view in (name, Path(name).name, Path(name).stem):
                return camera
        raise KeyError(f"there is no training image {view!r}; there are {len(names)}, from {names[0]} to {names[-1]}")

    def render(self, view: str | int | Camera, found: Answer | Finding | None = None) -> UInt8[Tensor, "h w 3"]:
        """The scene as a camera sees it; with an answer, in grey where nothing is selected, coloured by relevancy.

        Args:
            view: a training image, as `camera` takes it, or any camera.
            found: an answer, or what it says of one text.
        """
        camera = view if isinstance(view, Camera) else self.camera(view)
        picture = render_picture(self.scene, camera)
        if found is None:
            return picture
        shown, answered = (found.index, found.answer) if isinstance(found, Finding) else (None, found)
        display = make_display(self.field, answered, shown=shown)
        values, alpha = render(self.scene.gaussians, camera, display.values, rasterize_mode=self.scene.rasterize_mode)
        overlay = draw(display, picture.float() / 255, values, alpha)["overlay"]
        return (overlay.clamp(0, 1) * 255).round().to(torch.uint8)


def open_scene(load_config: str | Path, *, data: str | Path | None = None, load_step: int | None = None) -> Scene:
    """A trained splatfacto run, from any working directory.

    Args:
        load_config: config.yml of the run.
        data: where the dataset is now, if it was moved.
        load_step: step of the checkpoint; None: the last.
    Raises:
        FileNotFoundError: config, checkpoint, dataset or an image is missing.
        ValueError: a config of another method or program, a damaged checkpoint, another dataset than the run's.

    >>> scene = open_scene(config)
    >>> len(scene.train), scene.train[1].image.shape
    (12, torch.Size([120, 160, 3]))
    """
    from normlift_ns.nerfstudio_plugin.load import load_scene  # noqa: PLC0415 (nerfstudio takes 20 s)

    return load_scene(Path(load_config), data=None if data is None else Path(data), load_step=load_step)


def open_run(
    load_config: str | Path,
    *,
    data: str | Path | None = None,
    device: str = "auto",
    text_vectors: str | Path | None = None,
    text_template: str | None = None,
) -> LiftedRun:
    """Opens a lifted run, from any working directory.

    Args:
        load_config: config.yml of the run.
        data: where the dataset is now, if it was moved.
        device: where the text encoder works: auto, cpu or cuda.
        text_vectors: NPZ file, text -> vector, to look texts up in instead of the encoder that the run was lifted with.
        text_template: what open_clip reads for a text, which takes the place of {}; None: as the run was lifted.
    Raises:
        FileNotFoundError, ValueError: as `open_scene`; a run without semantics, or with those of other Gaussians.

    >>> run = open_run(config)
    >>> answer = run.ask("red", "yellow", min_reliability=0.3)
    >>> answer["yellow"].objects[0].size > 20
    True
    """
    device, scene = choose_device(device), open_scene(load_config, data=data)
    folder = Path(os.path.abspath(load_config)).parent
    loaded = load_field(folder, scene.gaussians.means, checkpoint=scene.checkpoint_path)
    vectors = None if text_vectors is None else Path(text_vectors)
    return LiftedRun(folder, scene, with_texts(loaded, vectors=vectors, template=text_template), device)


def lift_run(
    config_or_scene: str | Path | Scene,
    *,
    source: SourceOptions | None = None,
    features: Sequence[tuple[Any, Any]] | Mapping[str, tuple[Any, Any]] | None = None,
    texts: Mapping[str, Float[Tensor, " d"]] | None = None,
    lift: LiftOptions | None = None,
    queries: Sequence[str] = (),
    data: str | Path | None = None,
    load_step: int | None = None,
    output_dir: str | Path | None = None,
    timestamp: str | None = None,
    overwrite: bool = False,
    device: str = "auto",
    export: Export | None = None,
    report: Report = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> LiftedRun:
    """Lifts 2D features onto the Gaussians of a trained run, and writes a lifted run beside it.

    The new run is outputs/<experiment>/normlift/<timestamp>, which ns-viewer, ns-render and the ns-normlift commands
    open.

    Args:
        config_or_scene: config.yml of the trained run, or a scene of `open_scene`.
        source: which 2D features to make of the photographs; None: as ns-normlift does by default.
        features: features of your own in place of `source`: per training image a label map [H, W] of the undistorted
            image, with regions 0..R-1 and -1 for none, and vectors [R, D]. One pair per image, or a dictionary by names
            of images.
        texts: with `features`: what the run can be asked, with vectors [D]; they are stored in the run.
        lift: how to lift.
        queries: texts to store in the run; ns-render and ns-viewer show their relevancy.
        data, load_step: as in `open_scene`, for a config.
        output_dir: in place of the run's own outputs folder.
        timestamp: name of the new run directory; None: the present time.
        overwrite: replace a run directory of that name, and exported files of other content.
        device: auto, cpu or cuda.
        export: where to write the 2D features too, in LangSplat's format.
        report: called with (stage, steps done, steps in all).
        say: called with a sentence once the scene is loaded, for example `print`.
    Raises:
        FileExistsError: the run directory exists and `overwrite` is False.
        FileNotFoundError, ValueError: as `open_scene`; an image, a label map or an option that does not fit.
        MemoryError: the GPU's memory does not hold the lift.

    >>> scene = open_scene(config)
    >>> left = [(torch.arange(160).expand(120, 160) // 80, torch.eye(2)) for _ in scene.train.names]
    >>> run = lift_run(scene, features=left, texts={"left": torch.tensor([1.0, 0.0])}, output_dir=folder)
    >>> 0.2 < run.ask("left")["left"].fraction < 0.8
    True
    """
    device, options = choose_device(device), source or SourceOptions()
    made = None if features is not None else make_source(options, device)  # mistakes show before the scene loads
    if made is not None and len(queries) > 0:
        made.text(queries)
    from normlift_ns.nerfstudio_plugin.load import NerfstudioScene  # noqa: PLC0415 (nerfstudio takes 20 s)
    from normlift_ns.nerfstudio_plugin.write import write_run  # noqa: PLC0415

    scene = config_or_scene
    if isinstance(scene, str | Path):
        scene = open_scene(scene, data=data, load_step=load_step)
    if not isinstance(scene, NerfstudioScene):
        raise TypeError(f"lift_run takes the config.yml of a run or a scene of open_scene, got {type(scene).__name__}")
    run_dir = run_directory(scene.runs_dir if output_dir is None else Path(output_dir), scene.name, timestamp)
    refuse_existing(run_dir, overwrite)
    say(f"{len(scene.gaussians):,} Gaussians, {len(scene.train)} training views, on {device}")
    settings = encoder_settings(options)
    if made is None:
        made = GivenFeatures(features_by_name(features, scene.train.names), texts or {})
        settings = given_settings(TEXTS_FILE if texts else None)
    field, seconds = lift_scene(
        scene, made, lift or LiftOptions(), cache_folder(run_dir), device=device, encoder=settings, export=export,
        report=report,
    )  # fmt: skip
    question = _question(field, made, queries)
    write_run(scene, field, run_dir, question=question, texts=texts, overwrite=overwrite)
    return LiftedRun(run_dir, scene, with_paths(field.to("cpu"), run_dir / FIELD_FOLDER), device, seconds)


def _question(field: SemanticField, source: FeatureSource, queries: Sequence[str]) -> Question | None:
    if len(queries) == 0:
        return None
    length = source.text(queries).shape[1]
    if length != field.dimension:
        raise ValueError(
            f"the vectors of --queries have {length} numbers, the features {field.dimension}; name the model that made "
            "the features with --encoder-model and --encoder-pretrained, or give --text-vectors"
        )
    negatives = None
    if isinstance(source, GivenFeatures):  # the file of its texts is not written yet
        negatives = CANONICAL_NEGATIVES if set(CANONICAL_NEGATIVES) <= set(source.texts) else ()
    return make_question(field, source, queries, negatives=negatives)
