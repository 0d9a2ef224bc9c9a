"""Encoder that compares the colors of regions with color names. It has no learned weights and is robust to lighting.

A region is represented by its mean CIELAB color, and a prompt by the colors that it names. `xkcd.json` has the 949
names of the XKCD color survey. Shading scales the light from a surface, and thereby L* + 16, a* and b*, by a common
factor. Colors are therefore compared in coordinates that discount this factor and resemble CIELAB at L* = 50::

    p = 66 a* / (L* + 16),    q = 66 b* / (L* + 16),    x = (L* (1 + exp(-(p^2 + q^2) / 40^2)) / 2, p, q)

Lightness counts fully for whites, grays and blacks, which differ only in lightness. It counts half as much for strong
colors, whose lightness varies most in images. Each color is mapped to a unit vector phi(x). The cosine of two such
vectors decreases with the distance between their coordinates::

    <phi(x), phi(y)> = exp(-|x - y|^2 / (2 sigma^2)),    sigma = 30

The cosine is 0.95 at a distance of 10 (neighboring shades), 0.61 at 30, 0.14 at 60 and 0.004 at 100. An exact phi would
need infinitely many dimensions. This module uses the Nystroem approximation on 343 anchors, a lattice of 7 levels per
sRGB channel. Let L L^T be the kernel matrix of the anchors, and let k contain the kernel values of x and each anchor.
Then phi(x) is the normalized vector L^-1 k. For random pairs of sRGB colors, cosines are accurate to 4e-3, and for 99 %
of the pairs to 1e-3.
"""

from __future__ import annotations

import difflib
import json
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt8

from normlift_ns.encoders.text_files import LazyTextEncoder, check_prompts
from normlift_ns.errors import InputError, truncate_text

if TYPE_CHECKING:
    from torch import Tensor


KERNEL_SIGMA = 30.0
"""Width of the kernel, in units of `shading_coordinates`."""
_STRONG_CHROMA = 40.0
"""Divisor of the chroma in the exponential of the module docstring, in units of `shading_coordinates`."""
_LEVELS = 7
_LEVEL_POWER = 1.5
"""Exponent of the sRGB levels of the anchors. Values above 1 make the lattice denser for dark colors, whose coordinates
change fastest with the sRGB values."""
_OWN_SHARE = 0.2
"""Weight of a name's own color in `_family_vector`. Without this weight, the survey's blue would have a larger cosine
with "purple" than with "blue"."""
_JITTER = 1e-10
_THREADS = min(8, os.cpu_count() or 1)
"""Number of images whose mean colors are computed concurrently."""
_NOT_SUGGESTED = frozenset({"barf", "booger", "diarrhea", "piss", "poo", "poop", "puke", "shit", "snot", "vomit"})
"""Words of the survey that are accepted in prompts but not suggested in messages."""


@dataclass(frozen=True)
class ColorEncoder(LazyTextEncoder):
    """An encoder that compares mean CIELAB colors with color names. It uses no weights and no GPU; see the module
    docstring."""

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "colour", "sigma": KERNEL_SIGMA}

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """Return one unit vector per prompt, the normalized mean of the vectors of all color names in the prompt.

        A name stands for all colors of the survey whose names end in it: "red" includes brick red and dull red.

        Raises:
            ValueError: If `prompts` or a prompt is empty, or a prompt contains no color name.
        """
        check_prompts(prompts)
        rows = []
        for prompt in prompts:
            names = find_color_names(prompt)
            if len(names) == 0:
                raise InputError(_no_color_message(prompt))
            rows.append(np.mean([_family_vector(name) for name in names], axis=0))
        return _normalized(np.stack(rows)).astype(np.float32)

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        return next(self.encode_each([(image, labels)]))

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        import torch  # noqa: PLC0415 (queries do not need torch)

        from normlift_ns.core.device import prefetch_map  # noqa: PLC0415 (as above)

        # One thread computes the vectors: the factorization in `_anchors` once failed when 16 threads ran it at a time.
        means = prefetch_map(_mean_lab, views, _THREADS)
        return (torch.from_numpy(embed_colors(mean)).float() for mean in means)


def _mean_lab(view: tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]) -> Float64[np.ndarray, "r 3"]:
    """Return the mean CIELAB color of every region."""
    image, labels = view
    region = labels.cpu().numpy().reshape(len(labels), -1)
    lab, number = _unique_lab(image.numpy())
    color, labeled = np.broadcast_to(number, region.shape), region >= 0
    if not labeled.all():
        region, color = region[labeled], color[labeled]
    region, color = region.ravel(), color.ravel()
    total = np.stack([np.bincount(region, channel[color]) for channel in lab.T], axis=1)
    return total / np.bincount(region)[:, None]


def _unique_lab(image: UInt8[np.ndarray, "h w 3"]) -> tuple[Float64[np.ndarray, "colors 3"], Int64[np.ndarray, " p"]]:
    """Return the CIELAB values of the distinct colors of an image, and the row of each pixel's color.

    Pixels are in row-major order. Each color is converted once, because conversions take most of the encoder's time.
    """
    from skimage.color import rgb2lab  # noqa: PLC0415 (other encoders do not need it)

    red, green, blue = image.reshape(-1, 3).T.astype(np.int32)
    code = red << 16 | green << 8 | blue
    present = np.zeros(2**24, bool)  # a table of all colors is faster than a sort
    present[code] = True
    codes, row_of = np.flatnonzero(present), np.empty(2**24, np.int32)
    row_of[codes] = np.arange(len(codes))
    return rgb2lab(np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=1).astype(np.uint8)), row_of[code]


@cache
def _family_vector(name: str) -> Float64[np.ndarray, " 343"]:
    """Return the unit vector of a color name, a weighted mean of its own color and all colors whose names end in it."""
    shades = [lab for other, lab in _names().items() if f" {other}".endswith(f" {name}")]
    family = _normalized(embed_colors(np.stack(shades)).mean(axis=0, keepdims=True))
    (row,) = _normalized(_OWN_SHARE * embed_colors(_names()[name][None]) + (1 - _OWN_SHARE) * family)
    return row


def embed_colors(lab: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 343"]:
    """Return the unit vectors phi of CIELAB colors (D65, L* in 0..100)."""
    from scipy.linalg import solve_triangular  # noqa: PLC0415 (as in `_names`)

    anchors, cholesky = _anchors()
    kernel = _kernel(anchors, shading_coordinates(lab))
    return _normalized(np.asarray(solve_triangular(cholesky, kernel, lower=True)).T)


def shading_coordinates(lab: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return the coordinates x of CIELAB colors; see the formula in the module docstring.

    >>> shading_coordinates(np.array([[50.0, 0.0, 0.0], [50.0, 160.0, -120.0], [17.0, 80.0, -60.0]])).round(4)
    array([[  50. ,    0. ,    0. ],
           [  25. ,  160. , -120. ],
           [   8.5,  160. , -120. ]])
    """
    lightness, chroma = lab[:, :1], lab[:, 1:]
    chroma = 66 * chroma / (lightness + 16)
    strength = (chroma**2).sum(axis=1, keepdims=True) / _STRONG_CHROMA**2
    return np.concatenate([lightness * (1 + np.exp(-strength)) / 2, chroma], axis=1)


def _normalized(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def find_color_names(prompt: str) -> list[str]:
    """Return the longest color names in a prompt, from left to right; other words are ignored.

    >>> find_color_names("dark red shoes on a grey-green floor")
    ['dark red', 'grey green']
    """
    return _name_pattern().findall(" ".join(_words(prompt)))


def _words(text: str) -> list[str]:
    """Return the words of a text in lower case, with gray spelled "grey" as in the survey."""
    return re.findall(r"[a-z]+(?:'[a-z]+)?", text.lower().replace("gray", "grey"))


@cache
def xkcd_colors() -> dict[str, str]:
    """Return the colors of the XKCD color survey as "#rrggbb", by name."""
    return json.loads(Path(__file__).with_name("xkcd.json").read_text(encoding="utf8"))


@cache
def _names() -> dict[str, np.ndarray]:
    """Return the CIELAB color of each name.

    The survey has eleven names in two spellings, such as "blue green" and "blue/green". The color of the spelling
    without a slash is used.
    """
    from skimage.color import rgb2lab  # noqa: PLC0415 (other encoders do not need it)

    colors = sorted(xkcd_colors().items(), key=lambda item: "/" in item[0], reverse=True)
    names = [" ".join(_words(name)) for name, _ in colors]
    lab = rgb2lab(np.array([list(bytes.fromhex(color[1:])) for _, color in colors]) / 255)
    return dict(zip(names, lab))


@cache
def _name_pattern() -> re.Pattern[str]:
    """Return a pattern that matches all names as whole words, and prefers longer names."""
    names = sorted(_names(), key=len, reverse=True)
    return re.compile(rf"(?<!\S)(?:{'|'.join(map(re.escape, names))})(?!\S)")


@cache
def _anchors() -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates of the anchors, and the Cholesky factor L of their kernel matrix."""
    from skimage.color import rgb2lab  # noqa: PLC0415 (as in `_names`)

    level = np.linspace(0, 1, _LEVELS) ** _LEVEL_POWER
    lattice = np.stack(np.meshgrid(level, level, level, indexing="ij"), axis=-1).reshape(-1, 3)
    anchors = shading_coordinates(rgb2lab(lattice))
    return anchors, np.linalg.cholesky(_kernel(anchors, anchors) + _JITTER * np.eye(len(anchors)))


def _kernel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.exp(-((x[:, None] - y) ** 2).sum(axis=2) / (2 * KERNEL_SIGMA**2))


def _no_color_message(prompt: str) -> str:
    """Return the error message for a prompt without a color name."""
    names = list(_names())
    near = [name for word in [prompt.lower(), *_words(prompt)] for name in difflib.get_close_matches(word, names)]
    near = [name for name in near if _NOT_SUGGESTED.isdisjoint(name.split())]
    suggestions = ", ".join(list(dict.fromkeys(near))[:6] or ["red", "dark green", "sky blue"])
    return (
        f"prompt {truncate_text(prompt)!r} contains no color name; use a name of the XKCD color survey, such as "
        f"{suggestions}. For other words, lift with --encoder open_clip or --encoder imagenet (ns-normlift-weights "
        "lists their weights)"
    )
