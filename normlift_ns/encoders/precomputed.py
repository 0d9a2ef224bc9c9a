"""Precomputed features: label maps and vectors from memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor

from normlift_ns.encoders.base import ViewFeatures
from normlift_ns.encoders.text_files import check_prompts, look_up_embeddings, unit_rows
from normlift_ns.errors import InputError


@dataclass(frozen=True)
class PrecomputedFeatures:
    """A `FeatureSource` of precomputed (labels, vectors) per image, and of precomputed text embeddings.

    Raises:
        ValueError: If vectors are zero, not finite, or not [regions, D] ([D] for a text) with the same D everywhere.
            Also if labels are not an integer matrix, or name a region without a vector. Also if a text is empty, or
            cannot be a file name in an archive. The message names the image or the text.
    """

    views: Mapping[str, tuple[Int[Tensor, "h w"], Float[Tensor, "r d"]]]
    """Labels and vectors by image name. Labels are 0..R-1, -1 for none; vectors may have any length > 0."""
    texts: Mapping[str, Float[Tensor, " d"]] = field(default_factory=dict)
    """Embeddings by text."""

    def __post_init__(self) -> None:
        for name, (labels, vectors) in self.views.items():
            _check_view(name, labels, vectors)
        for text, vector in self.texts.items():
            _check_text(text, vector)
        lengths = {vectors.shape[1] for _, vectors in self.views.values()} | {len(x) for x in self.texts.values()}
        if len(lengths) > 1:
            raise InputError(f"vectors of images and texts must have the same length, found {sorted(lengths)}")

    @property
    def identity(self) -> dict[str, Any]:
        """A digest of the content of all images."""
        digest = blake2b(digest_size=16)
        for name, (labels, vectors) in self.views.items():
            digest.update(f"{name} {labels.dtype} {tuple(labels.shape)} {vectors.dtype}".encode())
            digest.update(labels.cpu().contiguous().numpy().tobytes())
            digest.update(vectors.cpu().contiguous().numpy().tobytes())
        return {"kind": "given", "content": digest.hexdigest()}

    def available(self, names: Sequence[str]) -> list[str]:
        unknown = sorted(set(self.views) - set(names))
        if len(unknown) > 0:
            raise InputError(
                f"features were given for {unknown[0]!r}, which is not a training image; there are {len(names)}, from "
                f"{names[0]!r} to {names[-1]!r}"
            )
        return [name for name in names if name in self.views]

    def view(self, image: UInt8[Tensor, "h w 3"], name: str) -> ViewFeatures:
        labels, vectors = self.views[name]
        if labels.shape != image.shape[:2]:
            raise InputError(
                f"labels of {name} are {tuple(labels.shape)}, but the image is {tuple(image.shape[:2])} (height x "
                "width, undistorted, after lift_downscale); pass labels of that size"
            )
        return ViewFeatures(labels.int().cpu(), torch.from_numpy(unit_rows(vectors.cpu())))

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        check_prompts(prompts)
        known = {text: vector.cpu() for text, vector in self.texts.items()}
        return torch.from_numpy(look_up_embeddings(prompts, known, "the given texts"))


def _check_view(name: str, labels: Tensor, vectors: Tensor) -> None:
    """Raise InputError unless the labels name regions that have a vector with a direction."""
    if vectors.ndim != 2 or not bool((vectors.isfinite().all(dim=1) & (vectors != 0).any(dim=1)).all()):
        raise InputError(f"vectors of {name} must be [regions, D], finite and not zero; got {vectors.shape}")
    low, high = (int(labels.min()), int(labels.max())) if labels.numel() > 0 else (0, 0)
    if labels.ndim != 2 or labels.numel() == 0 or low < -1 or high >= len(vectors):
        raise InputError(
            f"labels of {name} must be an integer matrix with values in -1..{len(vectors) - 1}, got "
            f"{tuple(labels.shape)} with values in {low}..{high}"
        )


def _check_text(text: str, vector: Tensor) -> None:
    """Raise InputError unless the text can be stored and its vector has a direction."""
    if vector.ndim != 1 or not bool(vector.isfinite().all()) or not bool(vector.any()):
        raise InputError(f"the vector of text {text!r} must be [D], finite and not zero; got {vector.shape}")
    if text.strip() == "" or text.endswith(".npy") or "\0" in text:
        raise InputError(f"{text!r} is not a valid text: it is empty, ends in .npy or contains NUL characters")


def precomputed_features(features: Any, texts: Mapping[str, Any] | None, names: Sequence[str]) -> PrecomputedFeatures:
    """Return a source of precomputed features from tensors, arrays or lists.

    Args:
        features: One pair of labels and vectors per training image, in order; or a mapping from image names to pairs,
            which may omit images.
        texts: Vectors by text.
        names: Names of all training images.
    Raises:
        ValueError: If `features` is empty or a list of another length, or `PrecomputedFeatures` raises.
    """
    if not isinstance(features, Mapping | Sequence) or isinstance(features, str):
        raise InputError(f"features must be a list or a dictionary of pairs, got {type(features).__name__}")
    if not isinstance(features, Mapping):
        if len(features) != len(names):
            raise InputError(
                f"{len(features)} pairs of labels and vectors were given for {len(names)} training images; pass one "
                "pair per image in the order of scene.train.names, or a dictionary with those names as keys"
            )
        features = dict(zip(names, features))
    if len(features) == 0:
        raise InputError("features are empty; pass labels and vectors of at least one training image")
    if texts is not None and not (isinstance(texts, Mapping) and all(isinstance(text, str) for text in texts)):
        raise InputError("texts must be a dictionary that maps texts to vectors")
    views = {name: _check_pair(name, pair) for name, pair in features.items()}
    return PrecomputedFeatures(views, {text: _to_floats(vector) for text, vector in (texts or {}).items()})


def _check_pair(name: str, pair: Any) -> tuple[Tensor, Tensor]:
    """Check and convert the labels and vectors of one image."""
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise InputError(f"features of {name} must be a pair of labels and vectors, got {type(pair).__name__}")
    try:
        labels = pair[0].detach().cpu().numpy() if isinstance(pair[0], Tensor) else np.asarray(pair[0])
    except ValueError as error:  # rows of different lengths
        raise InputError(f"labels of {name} must be a matrix of integers ({error})") from None
    if labels.dtype.kind not in "iub":
        raise InputError(f"labels of {name} must be integers, got {labels.dtype}")
    return torch.from_numpy(labels.astype(np.int64)), _to_floats(pair[1])


def _to_floats(values: Any) -> Tensor:
    """Return the values as a detached float32 or float64 tensor on the CPU."""
    try:
        tensor = values.detach().cpu() if isinstance(values, Tensor) else torch.from_numpy(np.array(values, order="C"))
    except (TypeError, ValueError) as error:
        raise InputError(f"vectors must be numbers ({error})") from None
    if tensor.is_complex():
        raise InputError("vectors must be real, got complex numbers")
    return tensor if tensor.dtype == torch.float64 else tensor.float()
