"""Feature sources from `SourceOptions`, and the adapter that checks encoders of other packages."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_args

import torch
from jaxtyping import Float32, Int32, UInt8
from torch import Tensor

from normlift_ns.encoders.base import Encoder, FeatureSource, PatchFeatures, RegionFeatures, Regions, TextEncoder
from normlift_ns.encoders.langsplat import LangSplat
from normlift_ns.encoders.prompts import UNIT_TOLERANCE, check_prompts
from normlift_ns.encoders.registry import absolute_paths, encoder_kind, is_built_in
from normlift_ns.encoders.text_files import TextEmbeddingFile
from normlift_ns.errors import InputError, summarize_error
from normlift_ns.options import DEFAULT_SAM, DEFAULT_SAM3, FeatureKind, RegionKind, SourceOptions
from normlift_ns.segmentation.checkpoint import find_local_sam
from normlift_ns.segmentation.regions import Grid, LabelFiles, Superpixels
from normlift_ns.segmentation.sam import SamMasks
from normlift_ns.segmentation.sam3 import Sam3Masks


@dataclass(frozen=True)
class PluginEncoder:
    """An encoder of another package. The wrapped object needs only `identity`, `encode` and `text`; if it has
    `patches`, so does the adapter. Error messages name the encoder that failed.

    Raises (from every method):
        InputError: If the encoder fails, or returns something that `Encoder` does not allow.
    """

    name: str
    encoder: Encoder

    @classmethod
    def made(cls, name: str, make: Callable[[], Encoder]) -> PluginEncoder:
        """Make an encoder, and check that it has the required attributes."""
        with _attribute_errors(name):
            encoder = make()
        missing = [x for x in ("identity", "encode", "text") if not hasattr(encoder, x)]
        if len(missing) > 0:
            raise InputError(f"encoder {name!r} of another package has no {' and no '.join(missing)}; fix that package")
        return DensePluginEncoder(name, encoder) if hasattr(encoder, "patches") else cls(name, encoder)

    @property
    def identity(self) -> dict[str, Any]:
        with _attribute_errors(self.name):
            return {"kind": self.name, **self.encoder.identity}

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        with _attribute_errors(self.name):
            rows = self.encoder.encode(image, labels)
        return self._check_rows(rows, int(labels.max()) + 1, "regions")

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        return (self.encode(image, labels) for image, labels in views)

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        check_prompts(prompts)
        with _attribute_errors(self.name):
            rows = self.encoder.text(prompts)
        return self._check_rows(rows, len(prompts), "texts")

    def _check_rows(self, rows: object, count: int, units: str) -> Float32[Tensor, "n d"]:
        """Return the rows as float32 on the CPU; raise InputError unless there are `count` of them, each of length
        1."""
        if not isinstance(rows, Tensor) or rows.ndim != 2 or len(rows) != count or not rows.is_floating_point():
            received = f"{rows.dtype} {tuple(rows.shape)}" if isinstance(rows, Tensor) else type(rows).__name__
            raise InputError(
                f"encoder {self.name!r} of another package returned {received} for {count} {units}, expected "
                f"floats [{count}, D]; fix that package"
            )
        rows = rows.detach().float().cpu()
        length = torch.linalg.vector_norm(rows, dim=1)
        if not bool(((length - 1).abs() < UNIT_TOLERANCE).all()):
            raise InputError(
                f"encoder {self.name!r} of another package returned vectors of {units} whose length is not 1 (such as "
                f"{float(length[(length - 1).abs().argmax()]):.3g}); normalize them"
            )
        return rows


@dataclass(frozen=True)
class DensePluginEncoder(PluginEncoder):
    """An encoder of another package that also has features of patches."""

    @property
    def why_not_dense(self) -> str | None:
        return getattr(self.encoder, "why_not_dense", None)

    def patches(self, image: UInt8[Tensor, "h w 3"], rows: int, columns: int) -> Float32[Tensor, "r d"]:
        with _attribute_errors(self.name):
            features = self.encoder.patches(image, rows, columns)  # type: ignore[attr-defined]
        return self._check_rows(features, rows * columns, "patches")


@contextmanager
def _attribute_errors(name: str) -> Iterator[None]:
    """Attribute exceptions to the encoder of another package."""
    try:
        yield
    except (InputError, FileNotFoundError, MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:  # a third-party module may raise anything
        raise InputError(f"encoder {name!r} of another package failed ({summarize_error(error)})") from error


# Builders of feature sources, encoders and regions from `SourceOptions`.


def make_source(options: SourceOptions, device: str = "cpu") -> FeatureSource:
    """Return the feature source of the options: regions combined with an encoder, or features read from a folder.

    Args:
        device: As in `make_encoder`.
    Raises:
        ValueError: As `make_regions` and `make_encoder`. Also if imported features have no folder, or a folder is given
            without imported features.
        FileNotFoundError: As those. Also if the folder of features does not exist.
    """
    if options.features not in get_args(FeatureKind):
        known = ", ".join(get_args(FeatureKind))
        raise InputError(f"unknown features {options.features!r}; --features is one of {known}")
    if options.features == "none":
        if options.features_dir is not None:
            raise InputError(
                f"--features-dir {options.features_dir} has no effect without --features langsplat; add that flag"
            )
        if options.text_vectors is not None:
            raise InputError(
                f"--text-vectors {options.text_vectors} is for imported features; add --features langsplat"
            )
        options = replace(options, regions=resolve_regions(options, device))
        if options.regions == "patches":
            return _make_patches(options, device)
        return RegionFeatures(make_regions(options, device), make_encoder(options, device))
    if options.features_dir is None:
        raise InputError(f"--features {options.features} needs the folder of the features; give it with --features-dir")
    if options.regions != "auto" or options.regions_dir is not None:
        raise InputError(
            "--regions and --regions-dir segment images, but --features imports its own regions; leave one of them out"
        )
    if not encoder_kind(options.encoder).learned and options.text_vectors is None:
        raise InputError(
            f"--encoder {options.encoder} did not make the features in {options.features_dir}; name the OpenCLIP model "
            "that did with --encoder-model and --encoder-pretrained, or give --text-vectors"
        )
    level: Any = options.level or "l"
    texts = make_texts(options, device)
    return LangSplat(options.features_dir, texts, level, options.features_missing, options.regions_resample)


_PATHS = ("regions_dir", "features_dir", "text_vectors")
"""Options that are paths."""


def source_settings(options: SourceOptions, device: str = "cpu") -> dict[str, Any]:
    """Return the options of a lift for its manifest, as JSON-serializable values. "auto" is resolved, and paths are
    absolute."""
    if options.features == "none":
        options = replace(options, regions=resolve_regions(options, device))
    settings = {**asdict(options), **absolute_paths(options)}
    settings["sam_model"] = None if options.sam_model is None else _absolute_if_exists(options.sam_model)
    return {name: os.path.abspath(value) if isinstance(value, Path) else value for name, value in settings.items()}


def _absolute_if_exists(name: str) -> str:
    return os.path.abspath(name) if os.path.exists(name) else name


def restore_source(manifest: Mapping[str, Any], device: str = "cpu") -> FeatureSource:
    """Recreate the feature source that a field was lifted from.

    Args:
        device: As in `make_encoder`.
    Raises:
        ValueError: If the manifest does not name the features, because they were passed in from Python or the version
            was older. Also if the recorded options give other features now.
        FileNotFoundError: If a recorded file no longer exists.
    """
    settings = manifest.get("source")
    if settings is None:
        raise InputError(
            "the run does not record how its regions and features were made: they were passed in from Python, or an "
            "earlier version lifted it; lift again with: ns-normlift"
        )
    try:
        options = SourceOptions(**_restore_settings(settings))
    except TypeError as error:
        raise InputError(
            f"the run's manifest has feature options that this version does not know ({error}); lift again "
            "with: ns-normlift"
        ) from error
    source = make_source(options, device)
    recorded, current = (json.dumps(x, sort_keys=True) for x in (manifest.get("features"), source.identity))
    if recorded != current:
        raise InputError(
            f"the options recorded in the run give other features now: {recorded} at the lift, {current} now; lift "
            "again with: ns-normlift"
        )
    return source


def _restore_settings(settings: object) -> dict[str, Any]:
    """Convert settings from a manifest back to option values."""
    if not isinstance(settings, Mapping):
        raise TypeError(f"found {type(settings).__name__}, expected an object")
    return {name: Path(x) if name in _PATHS and x is not None else x for name, x in settings.items()}


def make_texts(options: SourceOptions, device: str = "cpu") -> TextEncoder:
    """Return the text encoder of the options; arguments and errors as in `make_encoder` and `TextEmbeddingFile`."""
    return make_encoder(options, device) if options.text_vectors is None else TextEmbeddingFile(options.text_vectors)


def make_encoder(options: SourceOptions, device: str = "cpu") -> Encoder:
    """Return the encoder of the options.

    Args:
        device: Device of the network, such as "cuda"; results are always on the CPU.
    Raises:
        ValueError: If the encoder, the model, the weights tag or the fill is unknown, or an encoder of another package
            rejects the options.
        FileNotFoundError: If a weight file does not exist.
    """
    kind = encoder_kind(options.encoder)
    if is_built_in(kind):
        return kind.make(options, device)
    return PluginEncoder.made(options.encoder, lambda: kind.make(options, device))


def resolve_regions(options: SourceOptions, device: str = "cpu") -> RegionKind:
    """Return the regions of the options, with "auto" resolved.

    Raises:
        ValueError: If the regions are unknown.
    """
    if options.regions not in get_args(RegionKind):
        raise InputError(f"unknown regions {options.regions!r}; --regions is one of {', '.join(get_args(RegionKind))}")
    if options.regions != "auto":
        return options.regions
    if options.regions_dir is not None:
        return "files"
    if options.sam_model is not None:
        return "sam"
    kind = encoder_kind(options.encoder)
    if not kind.learned:
        return "superpixel"
    if device.startswith("cuda") and find_spec("transformers") is not None and find_local_sam(DEFAULT_SAM) is not None:
        return "sam"
    return "patches" if kind.has_patches(options) else "superpixel"


def make_regions(options: SourceOptions, device: str = "cpu") -> Regions:
    """Return the regions of the options. Patches are not supported, because they come with features of their own.

    Args:
        device: Device of the network, such as "cuda"; results are always on the CPU.
    Raises:
        ValueError: If the regions are unknown, "files" has no folder, or a folder or level does not apply. Also as
            `SamMasks` and `Sam3Masks`.
        FileNotFoundError: If the folder or the SAM checkpoint does not exist.
    """
    kind = resolve_regions(options, device)
    if kind not in ("sam", "sam3"):
        _reject_sam_options(options, kind)
    if kind != "sam3":
        _reject(" ".join(options.region_texts) or None, "--region-texts", kind, "sam3")
    if kind == "files":
        if options.regions_dir is None:
            raise InputError(
                'regions "files" need a folder of label maps, one PNG or NPY file per image: give it with --regions-dir'
            )
        level = _parse_level(options.level)
        return LabelFiles(options.regions_dir, options.regions_background, level, options.regions_resample)
    _reject(options.regions_dir, "--regions-dir", kind, "files")
    if kind == "sam":
        level: Any = options.level or "l"
        return SamMasks(options.sam_model or DEFAULT_SAM, level, device, options.sam_precision)
    _reject(options.level, "--level", kind, "files or sam")
    if kind == "sam3":
        return Sam3Masks(options.region_texts, options.sam_model or DEFAULT_SAM3, device, options.sam_precision)
    count = 256 if options.region_count is None else options.region_count
    if kind == "patches":
        raise InputError("patches have features already and cannot be used as regions; use make_source")
    return Superpixels(count) if kind == "superpixel" else Grid(count)


def _make_patches(options: SourceOptions, device: str) -> PatchFeatures:
    """Return the patch features of the options; raise InputError for options of other regions."""
    _reject_sam_options(options, "patches")
    _reject(" ".join(options.region_texts) or None, "--region-texts", "patches", "sam3")
    _reject(options.regions_dir, "--regions-dir", "patches", "files")
    _reject(options.level, "--level", "patches", "files or sam")
    encoder: Any = make_encoder(options, device)
    if not hasattr(encoder, "patches"):
        raise InputError(
            f"--regions patches needs an encoder with patch features; --encoder {options.encoder} has none. Use "
            "--regions superpixel or --encoder open_clip"
        )
    return PatchFeatures(encoder, 1024 if options.region_count is None else options.region_count)


def _reject_sam_options(options: SourceOptions, kind: str) -> None:
    """Raise InputError if an option of SAM is set."""
    _reject(options.sam_model, "--sam-model", kind, "sam")
    _reject(options.sam_precision if options.sam_precision != "auto" else None, "--sam-precision", kind, "sam")


def _reject(value: object, flag: str, kind: str, intended: str) -> None:
    """Raise InputError if an option is set that only applies to other regions."""
    if value is not None:
        raise InputError(f'{flag} {value} is for --regions {intended}, not for "{kind}"; leave one of them out')


def _parse_level(level: str | None) -> int | None:
    """Parse the level of label maps."""
    if level is not None and not (level.isascii() and level.isdigit()):
        raise InputError(f"--level must be the number of a map (0, 1, ...) with --regions files; got {level!r}")
    return None if level is None else int(level)
