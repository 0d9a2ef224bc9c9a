"""A lifted run: a trained scene with its semantics, and all that can be done with it."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Int64, UInt8
from numpy import ndarray
from torch import Tensor

from normlift_ns.asking import Answer, Finding, answer
from normlift_ns.core.field import SemanticField
from normlift_ns.core.files import refuse_run_files
from normlift_ns.core.gaussians import Camera
from normlift_ns.core.scene import Scene
from normlift_ns.errors import InputError
from normlift_ns.insight.floaters import Floaters, find_floaters
from normlift_ns.insight.why import Why
from normlift_ns.objects.catalogue import Catalogue, Similarity, make_catalogue
from normlift_ns.objects.instances import Instances, find_instances
from normlift_ns.options import FLOATER_LIMIT, MIN_SIZE, REACH, TRANSFER_DISTANCE, Rule
from normlift_ns.question import Question, make_question
from normlift_ns.ranges import check_bool, check_number, check_path
from normlift_ns.raster.rasterize import render, render_picture
from normlift_ns.raster.settings import RasterSettings
from normlift_ns.runs.files import FIELD_FOLDER, cache_folder, texts_cache
from normlift_ns.runs.question import load_question, save_question
from normlift_ns.runs.splats import drawn_rows, export_files, instances_of, semantic_columns, write_splats
from normlift_ns.runs.transfer import Labelled, label_cloud, read_cloud
from normlift_ns.runs.votes import Votes
from normlift_ns.scenes.similarity import capture_worlds
from normlift_ns.text_encoders import Texts, encoder_of
from normlift_ns.viewer.display import draw, make_display
from normlift_ns.viewer.pictures import write_masks


@dataclass(frozen=True, eq=False, repr=False)
class LiftedRun:
    """A trained scene with its semantics, on disk and in memory.

    >>> from normlift_ns import open_run
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

    def __repr__(self) -> str:
        return f"LiftedRun {self.folder}: {len(self.field):,} Gaussians"

    @property
    def config(self) -> Path:
        """The config.yml, for ns-viewer and the other commands."""
        return self.folder / "config.yml"

    @cached_property
    def texts(self) -> Texts:
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
        threshold: float | Literal["auto"] | None = None,
        min_reliability: float = 0.0,
        refined: bool = True,
    ) -> Answer:
        """Relevancy and selection of every Gaussian for each text.

        Args:
            negatives: texts to compare with; None: LERF's, where the encoder knows them.
            rule: how relevancy follows from cosines, see `relevancy`. "auto": lerf with negatives, else cosine.
            threshold: relevancy above which a Gaussian is selected. "auto": what the histogram of the relevancies
                suggests. None: 0.5, for rule margin 0.02, for bare cosines of other encoders than colour "auto".
            min_reliability: minimum R of a selected Gaussian, in 0..1.
            refined: use refined features.
        Raises:
            ValueError: no text, an empty one, or one that the encoder does not understand.
        """
        if not all(isinstance(text, str) for text in texts):
            raise InputError(f'ask takes texts one after the other, as in ask("red", "blue"); got {texts!r}')
        question = make_question(
            self.field,
            self.texts.rows,
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

    def save(self, question: Question | Answer) -> Path:
        """Stores a question in the run, in place of an earlier one: ns-render and ns-viewer draw its answer.

        Raises:
            ValueError: vectors of another length than the field's.
        """
        question = question.question if isinstance(question, Answer) else question
        if not isinstance(question, Question):
            raise InputError(f"save takes an answer of this run or its question, got {type(question).__name__}")
        if question.vectors.shape[1] != self.field.dimension:
            raise InputError(
                f"the question has vectors of {question.vectors.shape[1]} numbers, the features of {self.folder} have "
                f"{self.field.dimension}; ask this run, then save its answer"
            )
        return save_question(self.folder / FIELD_FOLDER, question)

    def export(
        self,
        path: str | Path,
        part: Answer | Finding | Bool[Tensor, " n"] | None = None,
        *,
        answer: Answer | None = None,
        objects: Mapping[str, Any] | None = None,
        reach: float = REACH,
        min_size: int = MIN_SIZE,
        overwrite: bool = False,
    ) -> Int64[ndarray, " m"]:
        """Writes Gaussians to a PLY file, and beside it their rows in the scene as <stem>_rows.npy; returns those rows.
        With an answer, the names of its classes and objects go to <stem>_names.json.

        Args:
            part: what an answer, or one of its findings, selects; or a mask of Gaussians; None: the whole scene.
            answer: whose relevancies, class_id and instance_id the file gets; None: that of `part`, if it has one.
            objects: a table to write beside it as <stem>_objects.json, JSON types only.
            reach: of objects, as in `find_objects`.
            min_size: likewise.
            overwrite: replace files of these names; without `objects`, an earlier table of them goes.
        Raises:
            FileExistsError: a file is there and `overwrite` is False.
            ValueError: no Gaussian of the part is ever drawn; a mask of another type or length; the name of a file of a
                run.
        """
        path = check_path("path", path)
        check_bool("overwrite", overwrite)
        if path.name == "":
            raise InputError(f"{path} is no name of a file; give one such as splat.ply")
        if answer is not None and not isinstance(answer, Answer):
            raise InputError(f"answer must be an answer of this run, got {type(answer).__name__}")
        refuse_run_files(*export_files(path), instead="name")
        answer = _asked(part) if answer is None else answer
        ply, numbers, names, table = export_files(path)
        for file, wanted in ((ply, True), (numbers, True), (names, answer is not None), (table, objects is not None)):
            if wanted and file.exists() and not overwrite:
                raise FileExistsError(f"{file} exists; give another name, or overwrite=True")
        instances = None if answer is None else instances_of(answer, reach=reach, min_size=min_size)
        keep = torch.ones(len(self.field), dtype=torch.bool) if part is None else self._mask(part)
        return write_splats(
            path,
            self.scene.parameters,
            self.field,
            answer,
            keep=keep,
            spherical_harmonics=self.scene.has_harmonics,
            rasterize_mode=self.scene.rasterize_mode,
            instances=instances,
            objects=objects,
            overwrite=overwrite,
        )

    def masks(
        self,
        folder: str | Path,
        part: Answer | Finding | Bool[Tensor, " n"],
        *,
        rest: bool = False,
        overwrite: bool = False,
    ) -> list[Path]:
        """Writes a PNG per training photograph, of its size, 255 where a selection makes more than half of a pixel,
        else 0. What stands before hides it. Lens distortion is taken out, as the scene was trained. Returns the paths.

        Args:
            part: what an answer, or one of its findings, selects; or a mask of Gaussians.
            rest: 255 where the photograph shows anything else, or nothing.
            overwrite: replace files of these names.
        Raises:
            FileExistsError: a file is there and `overwrite` is False.
            ValueError: a mask of another type or length.

        >>> from normlift_ns import open_run
        >>> run = open_run(config)
        >>> files = run.masks(folder / "masks", run.ask("red")["red"])
        >>> len(files) == len(run.scene.train), files[0].suffix
        (True, '.png')
        """
        settings, folder = RasterSettings.recorded(self.field.manifest), check_path("folder", folder)
        return write_masks(self.scene, self._mask(part), folder, rest=rest, settings=settings, overwrite=overwrite)

    def transfer(
        self,
        cloud: str | Path,
        path: str | Path,
        part: Answer | Finding,
        *,
        transfer_distance: float = TRANSFER_DISTANCE,
        coordinates: Literal["capture", "scene"] = "capture",
        overwrite: bool = False,
    ) -> Labelled:
        """Writes a point cloud or mesh again, with relevancies, class_id and instance_id of the nearest Gaussian.

        Args:
            cloud: a PLY file.
            path: the PLY file to write.
            part: an answer, or one of its findings, whose answer is taken.
            transfer_distance: how far a point may be from the centre of its Gaussian, in units of their median spacing.
            coordinates: those of the cloud. capture: of the cameras before nerfstudio turned and scaled them. scene: of
                the Gaussians.
            overwrite: replace a file of that name.
        Raises:
            FileNotFoundError: no such cloud.
            FileExistsError: a file is there and `overwrite` is False.
            ValueError: no answer, no PLY file, one that has such labels already; a distance that is not positive.

        >>> from normlift_ns import open_run
        >>> run = open_run(config)
        >>> rows = run.export(folder / "cloud.ply")
        >>> labelled = run.transfer(folder / "cloud.ply", folder / "red.ply", run.ask("red"), coordinates="scene")
        >>> labelled.points == len(rows), labelled.share  # every point is a Gaussian
        (True, 1.0)
        """
        answer, path = _asked(part), check_path("path", path)
        if answer is None:
            raise InputError(
                f"part must be an answer of this run, or what it says of a text; got {type(part).__name__}"
            )
        check_number("transfer_distance", transfer_distance)
        how: dict[str, Any] = {"distance": transfer_distance, "coordinates": coordinates, "overwrite": overwrite}
        return self.transfer_to(read_cloud(check_path("cloud", cloud)), path, answer, instances_of(answer), **how)

    def transfer_to(
        self,
        cloud: Any,
        path: Path,
        answer: Answer,
        instances: Instances,
        *,
        distance: float,
        coordinates: Literal["capture", "scene"],
        overwrite: bool,
    ) -> Labelled:
        """`transfer`, of a cloud that is read and with objects that are found."""
        rows = drawn_rows(self.scene.parameters, spherical_harmonics=self.scene.has_harmonics)
        means = self.scene.gaussians.means[torch.from_numpy(rows)].double().cpu().numpy()
        means = self.to_capture.points(means) if coordinates == "capture" else means
        columns = semantic_columns(self.field, answer, instances)
        columns = {name: x[rows] for name, x in columns.items() if name not in ("reliability", "n_eff")}
        return label_cloud(cloud, path, means, columns, distance, overwrite=overwrite)

    @cached_property
    def votes(self) -> Votes:
        """What photographs said in the lift; `votes.pictures(why.views[:3])` draws what the heaviest three did."""
        return Votes(self.scene, self.field, cache_folder(self.folder))

    def why(self, part: Answer | Finding | Bool[Tensor, " n"]) -> Why:
        """Which photographs and regions voted for a selection, and how far they agree.

        Args:
            part: what an answer, or one of its findings, selects; or a mask of Gaussians, taken with refined features.
        Raises:
            ValueError: nothing is selected; a mask of another type or length; the run stores directions only, and its
                cache no longer holds the evidence or the features.
            FileNotFoundError: the run stores directions only, and a photograph is gone.

        >>> from normlift_ns import open_run
        >>> run = open_run(config)
        >>> why = run.why(run.ask("red")["red"])
        >>> why.words.startswith("The images agree"), 0.9 < sum(vote.share for vote in why.views) < 1.1
        (True, True)
        >>> [picture.image.shape for picture in run.votes.pictures(why.views[:1])]
        [torch.Size([120, 160, 3])]
        """
        asked = _asked(part)
        return self.votes.explain(self._mask(part), refined=asked is None or asked.question.refined)

    def catalogue(
        self, part: Answer | Finding | Bool[Tensor, " n"], *, metres_per_unit: float | None = None
    ) -> Catalogue:
        """The objects of a selection: number, size, oriented box, centroid, extent, R, and the photographs that show
        each, in the coordinates of the capture and in those of the scene. docs/objects.md explains every number.

        Args:
            part: what an answer, or one of its findings, selects; or a mask of Gaussians, whose objects have no text.
                A Gaussian that several texts select belongs to the one of largest relevancy.
            metres_per_unit: length of one unit of the capture; places in the capture are in metres then.
        Raises:
            ValueError: a mask of another type or length, a length that is not positive, a damaged
                dataparser_transforms.json.
            FileNotFoundError: the run has no dataparser_transforms.json.

        >>> from normlift_ns import open_run
        >>> run = open_run(config)
        >>> ball = run.catalogue(run.ask("red", "yellow"), metres_per_unit=2.0).objects[0]
        >>> ball.id, ball.text, ball.gaussians > 20, ball.views, len(ball.best_views)
        (1, 'red', True, 10, 3)
        >>> bool(max(ball.capture.box.size) < 1.5 * min(ball.capture.box.size))  # about as wide as high
        True
        """
        if metres_per_unit is not None:
            check_number("metres_per_unit", metres_per_unit)
        how: dict[str, Any] = {"metres_per_unit": metres_per_unit, "device": self.device}
        return make_catalogue(self.scene, self.field, self._instances(part), self.to_capture, **how)

    @property
    def to_capture(self) -> Similarity:
        """From the coordinates of the Gaussians to those of the capture, the transform of its training undone.

        Raises:
            FileNotFoundError, ValueError: as `catalogue`.
        """
        found = Similarity.identity()
        for world in capture_worlds(self.folder, self.scene.identity):
            found = Similarity.undoing(world.transform, world.scale).then(found)
        return found

    def _instances(self, part: Answer | Finding | Bool[Tensor, " n"]) -> Instances:
        """Classes and objects of a part."""
        if isinstance(part, Answer):
            return instances_of(part)
        text, mask = part.text if isinstance(part, Finding) else "", self._mask(part)[:, None]
        return find_instances((text,), self.scene.gaussians.means, mask.float(), mask)

    def floaters(self, limit: float = FLOATER_LIMIT) -> Floaters:
        """Gaussians that likely belong to no surface, see `insight.floaters`. `run.export(path, ~found.mask)` writes
        the scene without them.

        Args:
            limit: score above which a Gaussian is a likely floater.
        Raises:
            ValueError: a limit that is not finite.

        >>> from normlift_ns import open_run
        >>> found = open_run(config).floaters()
        >>> 0 < int(found.mask.sum()) < 0.1 * len(found.mask)
        True
        """
        return find_floaters(self.scene.gaussians, self.field.scalars, limit=limit)

    def _mask(self, part: Any) -> Bool[Tensor, " n"]:
        """The Gaussians of a part.

        Raises:
            ValueError: it is none.
        """
        mask = part.mask if isinstance(part, Answer | Finding) else _tensor(part)
        if mask is None or mask.dtype != torch.bool or mask.shape != (len(self.field),):
            found = type(part).__name__ if mask is None else f"{mask.dtype} {tuple(mask.shape)}"
            raise InputError(
                f"part must be an answer of this run, what it says of one text, or a mask of {len(self.field)} "
                f"booleans; got {found}"
            )
        return mask

    def camera(self, view: str | Path | int) -> Camera:
        """The camera of a training image, by its number or its name; folder and suffix may be left out.

        Raises:
            KeyError, IndexError: no such image.
            ValueError: a name that several images have; give it with its folder.
        """
        cameras, names = self.scene.train.cameras, self.scene.train.names
        if not isinstance(view, str | Path):
            return cameras[operator.index(view)]
        name = Path(view).as_posix()
        found = [i for i, known in enumerate(names) if known == name] or [
            i
            for i, known in enumerate(names)
            if name in (str(Path(known).with_suffix("")), Path(known).name, Path(known).stem)
        ]
        if len(found) > 1:
            raise InputError(f"{len(found)} training images are called {name!r}: {', '.join(names[i] for i in found)}")
        if len(found) == 0:
            raise KeyError(f"there is no training image {name!r}; there are {len(names)}, {names[0]} to {names[-1]}")
        return cameras[found[0]]

    def render(self, view: str | Path | int | Camera, found: Answer | Finding | None = None) -> UInt8[Tensor, "h w 3"]:
        """The scene as a camera sees it; with an answer, in grey where nothing is selected, coloured by relevancy.

        Args:
            view: a training image, as `camera` takes it, or any camera.
            found: an answer, or what it says of one text.
        """
        camera = view if isinstance(view, Camera) else self.camera(view)
        settings = RasterSettings.recorded(self.field.manifest)
        picture = render_picture(self.scene, camera, settings=settings)
        if found is None:
            return picture
        if not isinstance(found, Answer | Finding):
            raise TypeError(f"render draws an answer, or what it says of one text; got {type(found).__name__}")
        shown, answered = (found.index, found.answer) if isinstance(found, Finding) else (None, found)
        display = make_display(self.field, answered, shown=shown)
        how = {"rasterize_mode": self.scene.rasterize_mode, "settings": settings}
        values, alpha = render(self.scene.gaussians, camera, display.values, **how)
        overlay = draw(display, picture.float() / 255, values, alpha)["overlay"]
        return (overlay.clamp(0, 1) * 255).round().to(torch.uint8)


def _asked(part: Any) -> Answer | None:
    """The answer that a part is of."""
    return part if isinstance(part, Answer) else part.answer if isinstance(part, Finding) else None


def _tensor(values: Any) -> Tensor | None:
    """As a tensor, where it can be one."""
    try:
        return torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return None
