"""Lifted runs: opening, queries, exports, renders, and writing after a lift."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from numpy import ndarray
from PIL import Image
from torch import Tensor

from normlift_ns import exports
from normlift_ns.analysis.explain import RecordedVotes, Why
from normlift_ns.analysis.inventory import Inventory, Vocabulary, list_inventory
from normlift_ns.analysis.objects import (
    Catalogue,
    Floaters,
    Instances,
    SimilarityTransform,
    find_floaters,
    find_instances,
    make_catalogue,
    similarity_to_capture,
)
from normlift_ns.core.arguments import check_arguments
from normlift_ns.core.device import choose_device
from normlift_ns.core.field import SemanticField, fingerprint
from normlift_ns.core.gaussians import Camera
from normlift_ns.core.lift import Scalars
from normlift_ns.core.scene import Scene
from normlift_ns.data.nerfstudio import config_classes
from normlift_ns.data.nerfstudio.config import dump_config, set_dataset, skip_seed_points
from normlift_ns.data.nerfstudio.load import NerfstudioScene
from normlift_ns.data.open_scene import (
    CHECKPOINT_DIR,
    EXTRA_IMAGES_FILE,
    TRANSFORMS_FILE,
    SplatScene,
    open_stored_run,
    save_splat,
    splatfacto_checkpoint,
)
from normlift_ns.data.transforms import write_transforms
from normlift_ns.encoders.text_files import LazyTextEncoder, check_template, write_text_embeddings
from normlift_ns.errors import InputError, MissingImageError
from normlift_ns.io.atomic import atomic_file, commit_directory, draft_directory, numbered_paths, write_text_file
from normlift_ns.io.guard import refuse_inputs
from normlift_ns.io.run_dir import (
    FIELD_FOLDER,
    TEXT_EMBEDDINGS_FILE,
    add_digest_comment,
    cache_folder,
    complete_interrupted_lifts,
    refuse_existing_run,
    run_file_digests,
    text_cache_folder,
    written_files,
)
from normlift_ns.options import (
    FLOATER_THRESHOLD,
    MAX_TRANSFER_DISTANCE,
    OBJECT_MAX_GAP,
    OBJECT_MIN_GAUSSIANS,
    RelevancyRule,
    check_number,
    check_path,
    renamed,
)
from normlift_ns.query.engine import Answer, Finding, run_query
from normlift_ns.query.question import Query, load_query, make_query, save_query
from normlift_ns.query.text_encoder import encoder_name, own_words, text_encoder_for, with_text_source
from normlift_ns.rasterization.rasterize import render, render_image
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.rendering.figures import make_display, render_outputs, write_masks


@check_arguments
@dataclass(frozen=True, eq=False, repr=False)
class LiftedRun:
    """Trained scene with its lifted semantics, on disk and in memory.

    >>> from normlift_ns import open_run
    >>> run = open_run(config)
    >>> red = run.ask("red")["red"]
    >>> red.mask.shape == red.relevancy.shape == (len(run.scene.gaussians),)
    True
    >>> run.render("0001", red).shape
    torch.Size([120, 160, 3])
    """

    folder: Path
    """Run directory, which contains config.yml."""
    scene: Scene
    field: SemanticField
    device: str = "cpu"
    """Device of the text encoder, and of the rendering for catalogs and inventories."""
    seconds: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Duration of each stage of the lift, in seconds; empty for a run that was opened from disk."""

    def __repr__(self) -> str:
        return f"LiftedRun {self.folder}: {len(self.field):,} Gaussians"

    @property
    def features(self) -> Float[Tensor, "n d"]:
        """Unit direction of every Gaussian after the vote, or zeros if it has none; computed on every access."""
        return self.field.directions()

    @property
    def scalars(self) -> Scalars:
        """Reliability, norm, weight and other statistics of every Gaussian; see `normlift_ns.Scalars`."""
        return self.field.scalars

    @property
    def reliability(self) -> Float[Tensor, " n"]:
        """Reliability R of every Gaussian, in 0..1."""
        return self.field.scalars.reliability

    @property
    def config(self) -> Path:
        """Path of config.yml, for ns-viewer and the other commands."""
        return self.folder / "config.yml"

    @cached_property
    def texts(self) -> LazyTextEncoder:
        """Text encoder that matches the field. It loads its network on first use.

        Raises:
            ValueError, FileNotFoundError: As in `text_encoder_for`.
        """
        return text_encoder_for(self.field, self.device, text_cache_folder(self.folder))

    @renamed(rule="relevancy")
    @check_arguments
    def ask(
        self,
        *texts: str,
        vectors: Mapping[str, Float[Tensor, " d"]] | None = None,
        negatives: Sequence[str] | None = None,
        relevancy: RelevancyRule | Literal["auto"] = "auto",
        threshold: float | Literal["auto"] | None = None,
        min_reliability: float = 0.0,
        refined: bool = True,
    ) -> Answer:
        """Compute the relevancy and the selection of every Gaussian for each prompt.

        Args:
            texts: Prompts for the text encoder of the run.
            vectors: Vectors [D] of further prompts by name, in the space of the features. They may have any norm > 0.
                A query without texts and negatives needs no text encoder.
            negatives: Negative prompts for the rules lerf and margin. If None, these rules use `CANONICAL_NEGATIVES`,
                or the default negatives of the encoder if the lift did not compare the scene with unrelated words.
            relevancy: Formula that computes relevancy from cosines; see `normlift_ns.relevancy`. "auto" is lerf if
                `negatives` has prompts, and cosine if `negatives` is empty. If `negatives` is None, "auto" is contrast
                if the lift compared the scene with unrelated words, else the default rule of the encoder.
            threshold: Relevancy above which a Gaussian is selected. "auto" derives it from the histogram of
                relevancies. None means 0.5 for contrast and lerf, 0.02 for margin, and "auto" for cosine. An
                encoder may set another threshold for its default rule, such as 0.7 for "color".
            min_reliability: Minimum reliability R of selected Gaussians, in 0..1.
            refined: Use the directions after the vote.
        Raises:
            ValueError: No prompt is given, a prompt is empty, the encoder cannot encode a prompt, or an option is
                invalid. Also if a vector differs in length from the features, is zero or is not finite.

        >>> from normlift_ns import open_run
        >>> run = open_run(config)
        >>> vector = run.features[run.reliability.argmax()]
        >>> bool(run.ask("red", vectors={"like this": vector})["like this"].mask.any())
        True
        """
        known = {name: self._checked(name, vector) for name, vector in (vectors or {}).items()}

        def encode(names: Sequence[str]) -> Float64[np.ndarray, "q d"]:
            rows = dict(known)
            new = [name for name in names if name not in known]
            rows |= zip(new, np.asarray(self.texts.rows(new), np.float64)) if len(new) > 0 else ()
            return np.stack([rows[name] for name in names])

        question = make_query(
            self.field,
            encode if len(known) > 0 else self.texts.rows,
            tuple(dict.fromkeys((*texts, *known))),
            negatives=negatives,
            relevancy=relevancy,
            threshold=threshold,
            min_reliability=min_reliability,
            refined=refined,
        )
        return run_query(self.field, self.scene.gaussians.means, question)

    def _checked(self, name: str, vector: Float[Tensor, " d"]) -> Float64[np.ndarray, " d"]:
        """Check the vector of a prompt, and return it as a NumPy array."""
        row = vector.detach().double().cpu().numpy()
        if row.shape != (self.field.dimension,):
            raise InputError(
                f"vectors[{name!r}] must have shape ({self.field.dimension},), like the features of the run, got "
                f"{row.shape}"
            )
        if not np.isfinite(row).all() or not row.any():
            raise InputError(f"vectors[{name!r}] must be finite and not zero, got length {np.linalg.norm(row):g}")
        return row

    def ask_stored(self) -> Answer | None:
        """Answer the query that is stored in the run; return None if the run stores no query."""
        question = load_query(self.folder / FIELD_FOLDER)
        return None if question is None else run_query(self.field, self.scene.gaussians.means, question)

    @check_arguments
    def save(self, question: Query | Answer) -> Path:
        """Store a query in the run in place of an earlier one, and return the path of the query file.

        ns-render and ns-viewer then show the relevancy of its prompts.

        Raises:
            ValueError: The query is not valid, or its vectors differ in length from the features.
            FileNotFoundError: The run was moved or deleted.
        """
        question = question.question if isinstance(question, Answer) else question
        if question.embeddings.shape[1] != self.field.dimension:
            raise InputError(
                f"the query has vectors of {question.embeddings.shape[1]} numbers, but the features of {self.folder} "
                f"have {self.field.dimension}; query this run again, and save the new answer"
            )
        return save_query(self.folder / FIELD_FOLDER, question)

    @renamed(reach="object_max_gap", min_size="object_min_gaussians")
    @check_arguments
    def export(
        self,
        path: str | Path,
        part: Answer | Finding | Bool[Tensor, " n"] | None = None,
        *,
        answer: Answer | None = None,
        objects: Mapping[str, Any] | None = None,
        object_max_gap: float = OBJECT_MAX_GAP,
        object_min_gaussians: int = OBJECT_MIN_GAUSSIANS,
        overwrite: bool = False,
    ) -> Int64[ndarray, " m"]:
        """Write Gaussians to a file, and their row indices in the scene to <stem>_rows.npy next to it.

        PLY and GLB files also contain reliabilities. If there is an answer, they also contain its relevancies and
        labels, and the names of its classes and objects are written to <stem>_names.json.

        Args:
            path: File to write. The endings .glb, .spz and .compressed.ply select the format. Other endings select PLY,
                except .splat, .sog, .ksplat and .gltf, which are not supported.
            part: Answer or finding that selects the Gaussians, or a mask of Gaussians. If None, write the whole scene.
            answer: Answer that provides relevancies, class_id and instance_id. If None, use the answer of `part`, if
                there is one.
            objects: Table to write to <stem>_objects.json, with JSON types only.
            object_max_gap: Maximum gap between Gaussians of one object, as in `find_objects`.
            object_min_gaussians: Minimum number of Gaussians in an object, as in `find_objects`.
            overwrite: Replace existing files, and remove an earlier <stem>_names.json or <stem>_objects.json that this
                export does not write.
        Returns:
            The row indices of the written Gaussians, in the order of the file.
        Raises:
            FileExistsError: A file exists and `overwrite` is False.
            ValueError: No Gaussian of `part` is visible, or the mask has the wrong type or length. Also if the export
                would replace an input or a file of a run, or the options of objects are given without an answer.
        """
        path = check_path("path", path)
        if path.name in ("", ".."):
            raise InputError(f"{path} is not a valid file name; give one such as splat.ply")
        refuse_inputs(exports.export_paths(path), instead="name")
        answer = _answer_of(part) if answer is None else answer
        limits = (
            check_number("object_max_gap", object_max_gap),
            check_number("object_min_gaussians", object_min_gaussians, int),
        )
        if answer is None and limits != (OBJECT_MAX_GAP, OBJECT_MIN_GAUSSIANS):
            raise InputError(
                "object_max_gap and object_min_gaussians have no effect without an answer; pass an answer, or omit them"
            )
        for file, written in zip(exports.export_paths(path), (True, True, answer is not None, objects is not None)):
            if written and file.exists() and not overwrite:
                raise FileExistsError(f"{file} exists; give another name, or pass overwrite=True")
        instances = None if answer is None else exports.answer_instances(answer, *limits)
        keep = torch.ones(len(self.field), dtype=torch.bool) if part is None else self._mask(part)
        labels = exports.SplatLabels(self.field, answer, instances, objects)
        splat = exports.TrainedSplat.of(self.scene)
        return exports.write_splat(path, splat, labels, keep=keep, overwrite=overwrite).rows

    @check_arguments
    def masks(
        self,
        folder: str | Path,
        part: Answer | Finding | Bool[Tensor, " n"],
        *,
        rest: bool = False,
        overwrite: bool = False,
    ) -> list[Path]:
        """Write a PNG mask for each training image, with the size of the image, and return the paths.

        A pixel is 255 if the selection contributes more than half of its opacity, else 0. Gaussians in front occlude
        the selection. Pixels with an opacity of at most 0.05 count as empty.
        The masks fit the undistorted images that the scene was trained with.

        Args:
            folder: Folder to write to.
            part: Answer or finding that selects the Gaussians, or a mask of Gaussians.
            rest: Invert the masks. Empty pixels are then 255.
            overwrite: Replace existing files of the same names.
        Raises:
            FileExistsError: A file exists and `overwrite` is False.
            ValueError: The mask has the wrong type or length.

        >>> from normlift_ns import open_run
        >>> run = open_run(config)
        >>> paths = run.masks(folder / "masks", run.ask("red")["red"])
        >>> len(paths) == len(run.scene.train), paths[0].suffix
        (True, '.png')
        """
        settings, folder = RasterSettings.recorded(self.field.manifest), check_path("folder", folder)
        return write_masks(self.scene, self._mask(part), folder, invert=rest, settings=settings, overwrite=overwrite)

    @check_arguments
    def transfer(
        self,
        cloud: str | Path,
        path: str | Path,
        part: Answer | Finding,
        *,
        transfer_distance: float = MAX_TRANSFER_DISTANCE,
        coordinates: Literal["capture", "scene"] = "capture",
        overwrite: bool = False,
    ) -> exports.LabelTransfer:
        """Label a point cloud or mesh with the semantics of the nearest Gaussians, and write it to a new PLY file.

        Each point gets the relevancies, class_id and instance_id of its nearest visible Gaussian, or 0 if it is too far
        away.

        Args:
            cloud: PLY file to read.
            path: PLY file to write.
            part: Answer that provides the labels, or a finding of that answer.
            transfer_distance: Maximum distance from a point to the center of its Gaussian, in units of the median
                spacing of the Gaussians.
            coordinates: Coordinate system of the cloud. "capture" is that of the original cameras, before the training
                rotated and scaled them, and "scene" is that of the Gaussians.
            overwrite: Replace an existing file.
        Raises:
            FileNotFoundError: The cloud does not exist, or the run has no dataparser_transforms.json for "capture".
            FileExistsError: A file exists and `overwrite` is False.
            ValueError: `part` has no answer, the cloud is not a PLY file or already has properties with the names of
                labels, or the distance is not positive.

        >>> from normlift_ns import open_run
        >>> run = open_run(config)
        >>> rows = run.export(folder / "cloud.ply")
        >>> labeled = run.transfer(folder / "cloud.ply", folder / "red.ply", run.ask("red"), coordinates="scene")
        >>> labeled.points == len(rows), labeled.share  # every point is a Gaussian
        (True, 1.0)
        """
        answer, path = _answer_of(part), check_path("path", path)
        if answer is None:
            raise InputError(
                f"part must be an Answer of this run or a Finding of such an answer, got {type(part).__name__}"
            )
        check_number("transfer_distance", transfer_distance)
        cloud = check_path("cloud", cloud)
        if path.exists() and path.samefile(cloud):
            raise InputError(f"{path} is the cloud to read; give another path for the labeled cloud")
        points = exports.read_cloud(cloud)
        rule = exports.CloudTransfer(points, transfer_distance, self.to_capture if coordinates == "capture" else None)
        return exports.transfer_labels(
            self.scene, self.field, answer, exports.answer_instances(answer), rule, path, overwrite=overwrite
        )

    @cached_property
    def votes(self) -> RecordedVotes:
        """Votes of the images that were lifted.

        `votes.pictures(why.views[:3])` yields the three images with the largest weight, with outlines of the regions
        that voted.
        """
        return RecordedVotes(self.scene, self.field, cache_folder(self.folder))

    @check_arguments
    def why(self, part: Answer | Finding | Bool[Tensor, " n"]) -> Why:
        """Explain a selection by the images and regions that voted for it, and by their agreement.

        Args:
            part: Answer or finding that selects the Gaussians, or a mask of Gaussians. A mask is explained with the
                refined directions.
        Raises:
            ValueError: The selection is empty, or the mask has the wrong type or length. Also if the run stores only
                directions, and its cache no longer has the evidence or the features.
            FileNotFoundError: The run stores only directions, and an image is missing.

        >>> from normlift_ns import open_run
        >>> run = open_run(config)
        >>> why = run.why(run.ask("red")["red"])
        >>> why.words.startswith("The images agree"), 0.9 < sum(vote.share for vote in why.views) < 1.1
        (True, True)
        >>> [picture.image.shape for picture in run.votes.pictures(why.views[:1])]
        [torch.Size([120, 160, 3])]
        """
        answer = _answer_of(part)
        return self.votes.explain(self._mask(part), refined=answer is None or answer.question.refined)

    @renamed(metres_per_unit="meters_per_unit")
    @check_arguments
    def catalogue(
        self, part: Answer | Finding | Bool[Tensor, " n"], *, meters_per_unit: float | None = None
    ) -> Catalogue:
        """List the objects of a selection, in the coordinates of the capture and in those of the scene.

        Each object has a number, a size, an oriented box, a centroid, an extent, a reliability R, the number of images
        that show it, and the names of up to three of them. docs/objects.md explains every value.

        Args:
            part: Answer or finding that selects the Gaussians, or a mask of Gaussians. Objects of a mask have no text.
                A Gaussian that several prompts select belongs to the prompt with the largest relevancy.
            meters_per_unit: Length of one unit of the capture in meters. If given, positions and sizes in the capture
                are in meters.
        Raises:
            ValueError: The mask has the wrong type or length, `meters_per_unit` is not positive, or
                dataparser_transforms.json is damaged.
            FileNotFoundError: The run has no dataparser_transforms.json.

        >>> from normlift_ns import open_run
        >>> run = open_run(config)
        >>> ball = run.catalogue(run.ask("red", "yellow"), meters_per_unit=2.0).objects[0]
        >>> ball.id, ball.text, ball.gaussians > 20, ball.views, len(ball.best_views)
        (1, 'red', True, 10, 3)
        >>> bool(max(ball.capture.box.size) < 1.5 * min(ball.capture.box.size))  # about as wide as high
        True
        """
        if meters_per_unit is not None:
            check_number("meters_per_unit", meters_per_unit)
        instances, transform = self._instances(part), self.to_capture
        return make_catalogue(
            self.scene, self.field, instances, transform, meters_per_unit=meters_per_unit, device=self.device
        )

    @check_arguments
    def inventory(self, vocabulary: Sequence[str] | None = None, *, meters_per_unit: float | None = None) -> Inventory:
        """List at most 20 objects of the scene without prompts; see `analysis.inventory`.

        An object is named after the best word of the vocabulary. The word must have the verdict "found" and select more
        than half of the object. It must also match better than chance. Chance is estimated from the 200 unrelated words
        of the encoder, or from a vocabulary of at least 100 words. Without either, and for the color encoder, this test
        is skipped. Other objects are called "object 1", "object 2" and so on.

        Args:
            vocabulary: Candidate names of objects. If None, use the texts of the run's file of text embeddings, or else
                the words of the encoder: the 1,000 classes of imagenet, or the names of colors. With other encoders,
                objects are only numbered.
            meters_per_unit: As in `catalogue`.
        Raises:
            ValueError: The encoder cannot encode a word, or as in `why` and `catalogue`.
            FileNotFoundError: As in `why` and `catalogue`.

        >>> from normlift_ns import open_run
        >>> inventory = open_run(config).inventory()
        >>> [item.id for item in inventory.catalog.objects[:2]], inventory.mask(1).shape == inventory.instance_id.shape
        ([1, 2], True)
        """
        if meters_per_unit is not None:
            check_number("meters_per_unit", meters_per_unit)
        words = own_words(self.field) if vocabulary is None else vocabulary
        encode = lambda texts: self.texts.rows(texts)  # noqa: E731, PLW0108 (loads the encoder only if needed)
        known = Vocabulary.of(words, encoder_name(self.field), encode, lambda texts: self.ask(*texts))
        return list_inventory(self.votes, known, self.to_capture, meters_per_unit=meters_per_unit, device=self.device)

    @property
    def to_capture(self) -> SimilarityTransform:
        """Transform from the coordinates of the Gaussians to those of the capture.

        It is the inverse of the transform that the training applied to the cameras.

        Raises:
            FileNotFoundError, ValueError: As in `catalogue`.
        """
        return similarity_to_capture(self.folder, self.scene.identity)

    def _instances(self, part: Answer | Finding | Bool[Tensor, " n"]) -> Instances:
        """Return the classes and objects of an answer, a finding or a mask."""
        if isinstance(part, Answer):
            return exports.answer_instances(part)
        text, mask = part.text if isinstance(part, Finding) else "", self._mask(part)[:, None]
        return find_instances((text,), self.scene.gaussians.means, mask.float(), mask)

    @check_arguments
    def floaters(self, limit: float = FLOATER_THRESHOLD) -> Floaters:
        """Find Gaussians that are probably not part of a surface; see `analysis.objects`.

        `run.export(path, ~floaters.mask)` writes the scene without them.

        Args:
            limit: Floater score above which a Gaussian is a likely floater.
        Raises:
            ValueError: The limit is not finite.

        >>> from normlift_ns import open_run
        >>> floaters = open_run(config).floaters()
        >>> 0 < int(floaters.mask.sum()) < 0.1 * len(floaters.mask)
        True
        """
        return find_floaters(self.scene.gaussians, self.field.scalars, limit=limit)

    def _mask(self, part: Any) -> Bool[Tensor, " n"]:
        """Return an answer, finding or mask as a mask [N] of Gaussians.

        Raises:
            ValueError: `part` has the wrong type or length.
        """
        mask = part.mask if isinstance(part, Answer | Finding) else None
        if mask is None:
            with suppress(TypeError, ValueError, RuntimeError, OverflowError):
                mask = torch.as_tensor(part)
        if mask is None or mask.dtype != torch.bool or mask.shape != (len(self.field),):
            actual = type(part).__name__ if mask is None else f"{mask.dtype} {tuple(mask.shape)}"
            raise InputError(
                f"part must be an Answer of this run, a Finding of such an answer, or a mask of "
                f"{len(self.field)} booleans, got {actual}"
            )
        return mask

    @check_arguments
    def camera(self, view: str | Path | int) -> Camera:
        """Return the camera of a training image.

        Args:
            view: Index or name of the image. The folder and the suffix may be omitted.
        Raises:
            ValueError: Several images have this name, or no image has this name or index. The error for a missing image
                is also a KeyError and an IndexError.
        """
        cameras, names = self.scene.train.cameras, self.scene.train.names
        if not isinstance(view, str | Path):
            if not -len(names) <= view < len(names):
                raise _no_image(str(view), names)
            return cameras[view]
        name = Path(view).as_posix()
        matches = [i for i, image in enumerate(names) if image == name] or [
            i
            for i, image in enumerate(names)
            if name in (str(Path(image).with_suffix("")), Path(image).name, Path(image).stem)
        ]
        if len(matches) > 1:
            options = ", ".join(names[i] for i in matches)
            raise InputError(f"{len(matches)} training images are called {name!r}; give one of these names: {options}")
        if len(matches) == 0:
            raise _no_image(repr(name), names)
        return cameras[matches[0]]

    @check_arguments
    def render(self, view: str | Path | int | Camera, found: Answer | Finding | None = None) -> UInt8[Tensor, "h w 3"]:
        """Render the scene from a camera.

        With an answer, selected Gaussians are colored by relevancy and the others are gray.

        Args:
            view: Training image as in `camera`, or any camera.
            found: Answer, or its finding for one prompt. If None, render the colors of the scene.
        """
        camera = view if isinstance(view, Camera) else self.camera(view)
        settings = RasterSettings.recorded(self.field.manifest)
        image = render_image(self.scene, camera, settings=settings)
        if found is None:
            return image
        shown, answer = (found.index, found.answer) if isinstance(found, Finding) else (None, found)
        display = make_display(self.field, answer, shown=shown)
        mode = self.scene.rasterize_mode
        values, alpha = render(self.scene.gaussians, camera, display.values, rasterize_mode=mode, settings=settings)
        overlay = render_outputs(display, image.float() / 255, values, alpha)["overlay"]
        return (overlay.clamp(0, 1) * 255).round().to(torch.uint8)

    @check_arguments
    def image(self, view: str | Path | int | Camera, found: Answer | Finding | None = None) -> Image.Image:
        """Render the scene as `render` does, and return a PIL image.

        Args:
            view, found: As in `render`.

        >>> from normlift_ns import open_run
        >>> open_run(config).image("0001").size
        (160, 120)
        """
        return Image.fromarray(self.render(view, found).cpu().numpy())


def _no_image(name: str, names: Sequence[str]) -> MissingImageError:
    return MissingImageError(
        f"view must be the name of a training image ({names[0]} to {names[-1]}) or an index in 0..{len(names) - 1}, "
        f"got {name}"
    )


def _answer_of(part: Any) -> Answer | None:
    """Return an answer itself, the answer of a finding, or None for a mask."""
    return part if isinstance(part, Answer) else part.answer if isinstance(part, Finding) else None


@renamed(text_vectors="text_embeddings", text_template="prompt_template")
@check_arguments
def open_run(
    load_config: str | Path,
    *,
    data: str | Path | None = None,
    device: str = "auto",
    text_embeddings: str | Path | None = None,
    prompt_template: str | None = None,
) -> LiftedRun:
    """Open a lifted run from any working directory.

    Args:
        load_config: config.yml of the run, or its folder.
        data: Current path of the dataset, if it was moved.
        device: Device of the text encoder (auto, cpu or cuda).
        text_embeddings: NPZ file with a vector for each prompt, which replaces the text encoder of the lift.
        prompt_template: Template for prompts, such as "a photo of {}". If None, use the template of the lift.
    Raises:
        FileNotFoundError, ValueError: As in `open_scene`; also if the run has no semantics, or the semantics belong to
            other Gaussians.

    >>> run = open_run(config)
    >>> answer = run.ask("red", "yellow", min_reliability=0.3)
    >>> answer["yellow"].objects[0].size > 20
    True
    """
    vectors = None if text_embeddings is None else check_path("text_embeddings", text_embeddings)
    if prompt_template is not None:
        check_template(prompt_template)
    device, path = choose_device(device), check_path("load_config", load_config)
    folder, scene, stored = open_stored_run(path / "config.yml" if path.is_dir() else path, data)
    return LiftedRun(folder, scene, with_text_source(stored, text_embeddings=vectors, template=prompt_template), device)


def write_run(
    source: NerfstudioScene | SplatScene,
    field: SemanticField,
    run_dir: Path,
    *,
    question: Query | None = None,
    text_embeddings: Mapping[str, Tensor] | None = None,
    overwrite: bool = False,
    exact_name: bool = True,
) -> Path:
    """Write a lifted run, completely or not at all, and return its directory.

    The directory contains config.yml (method normlift), nerfstudio_models/step-*.ckpt (step and tensors of the model,
    without optimizers), dataparser_transforms.json, and the field in normlift/. For a splat without a nerfstudio
    run, it also contains the cameras in transforms.json, and the other settings needed to open the run in splat.json.

    Relative paths in the config of the source run stay relative, so nerfstudio's own commands must run in the directory
    in which the source run was trained. The path of the dataset becomes absolute if the dataset was moved or the new
    run is outside that directory. The ns-normlift commands run in any directory.

    Args:
        run_dir: Directory from `run_directory`, output_dir/experiment/normlift/timestamp.
        question: Query to store, which nerfstudio renders as relevancy_0, relevancy_1, …
        text_embeddings: The user's own text embeddings, by prompt.
        overwrite: Replace an existing directory.
        exact_name: If False and `run_dir` exists, write to <name>_2, <name>_3, … instead.
    Raises:
        FileExistsError: The directory exists, `exact_name` is True and `overwrite` is False.
        ValueError: The field was lifted from other Gaussians.
        OSError: A file cannot be written, for instance because the disk is full. No files remain in that case.
    """
    complete_interrupted_lifts(run_dir)
    if exact_name:
        refuse_existing_run(run_dir, overwrite, source.checkpoint_path)
    if field.manifest["means_fingerprint"] != fingerprint(source.gaussians.means):
        raise InputError(
            f"The semantic field of {len(field)} Gaussians was not lifted from the {len(source.gaussians)} Gaussians "
            f"of {source.checkpoint_path}; lift that checkpoint again."
        )
    with draft_directory(run_dir) as folder:
        if isinstance(source, SplatScene):
            save_splat(folder, source)
            transform, scale, checkpoint = torch.eye(4)[:3], 1.0, splatfacto_checkpoint(source)
            config_in: Callable[[Path], config_classes.TrainerConfig] = partial(splat_config, source)
        else:
            if len(source.extra_frames) > 0:
                write_transforms(folder / EXTRA_IMAGES_FILE, source.extra_frames, ())
            transform, scale = source.dataparser_transform, source.dataparser_scale
            model = {f"_model.{name}": tensor for name, tensor in source.checkpoint.model.items()}
            checkpoint = {"step": source.checkpoint.step, "pipeline": model}
            config_in = partial(_lifted_config, source)
        facts = {"transform": transform.tolist(), "scale": scale}
        write_text_file(folder / "dataparser_transforms.json", json.dumps(facts, indent=4))
        stored = folder / CHECKPOINT_DIR / f"step-{checkpoint['step']:09d}.ckpt"
        with atomic_file(stored) as draft:
            torch.save(checkpoint, draft)
        field_dir = folder / FIELD_FOLDER
        if text_embeddings:
            write_text_embeddings(field_dir / TEXT_EMBEDDINGS_FILE, text_embeddings)
        files = [stored, field_dir / TEXT_EMBEDDINGS_FILE, *folder.glob("*.json")]
        field.save(field_dir, beside=run_file_digests(field_dir, files), own=True)
        if question is not None:
            save_query(field_dir, question)
        for path in (run_dir,) if exact_name else numbered_paths(run_dir):
            write_text_file(
                folder / "config.yml", add_digest_comment(dump_config(config_in(path))), overwrite=True, own=True
            )
            if commit_directory(folder, path, replaced=written_files if overwrite and exact_name else None):
                return path
    refuse_existing_run(run_dir, overwrite=False)  # another process created it meanwhile
    raise FileExistsError(f"another process created and removed {run_dir} during the lift; run the lift again")


def _lifted_config(source: NerfstudioScene, run_dir: Path) -> config_classes.TrainerConfig:
    config, location = deepcopy(source.config), source.location
    config.method_name = "normlift"
    config.output_dir = location.relative_to_root(run_dir.parents[2])
    config.timestamp = run_dir.name
    config.relative_model_dir = Path(CHECKPOINT_DIR)
    config.load_dir = config.load_step = config.load_config = config.load_checkpoint = None
    options: dict[str, Any] = {**vars(source.model_config), "semantics": Path(FIELD_FOLDER)}
    config.pipeline.model = config_classes.NormLiftModelConfig(**options)
    if location.data_moved or config.output_dir.is_absolute():
        set_dataset(config, location.data)  # relative paths would not resolve to the dataset
    skip_seed_points(config)
    # "gpu" means the pipeline's device; "cpu" would pin memory, which needs CUDA
    config.pipeline.datamanager.cache_images = "gpu"
    return config


def splat_config(scene: SplatScene, run_dir: Path) -> config_classes.TrainerConfig:
    """Return a nerfstudio config for a lift of a splat file or gsplat checkpoint, which has no config of its own.

    With this config, nerfstudio loads the cameras in the run directory without transforming them. All paths
    outside the run directory are absolute, because the run has no training directory as a base for relative paths.
    """
    cameras = run_dir / TRANSFORMS_FILE
    dataparser = config_classes.NerfstudioDataParserConfig(
        data=cameras,
        downscale_factor=1,
        orientation_method="none",
        center_method="none",
        auto_scale_poses=False,
        eval_mode="all",
        load_3D_points=False,
    )
    model = config_classes.NormLiftModelConfig(
        sh_degree=max(1, scene.splat.degree),
        background_color=scene.background_name,
        rasterize_mode=scene.rasterize_mode,
        semantics=Path(FIELD_FOLDER),
    )
    datamanager = config_classes.FullImageDatamanagerConfig(
        data=cameras,
        dataparser=dataparser,
        cache_images="gpu",  # means the pipeline's device; "cpu" would pin memory, which needs CUDA
        cache_images_type="uint8",
    )
    return config_classes.TrainerConfig(
        method_name="normlift",
        experiment_name=scene.name,
        output_dir=run_dir.parents[2],
        timestamp=run_dir.name,
        relative_model_dir=Path(CHECKPOINT_DIR),
        data=cameras,
        pipeline=config_classes.VanillaPipelineConfig(datamanager=datamanager, model=model),
        vis="viewer",
    )
