"""A joint space of image regions and texts without learned weights: colours, as they look under changing light.

A region is its mean CIELAB colour, a text the colours that it names (the 949 names of the XKCD colour survey, in
`xkcd.json`). Shade multiplies the light of a surface by a factor, under which L* + 16, a* and b* all change by
one factor too. Colours are therefore compared in coordinates that discount it, close to those of CIELAB at L* = 50::

    p = 66 a* / (L* + 16),    q = 66 b* / (L* + 16),    x = (L* (1 + exp(-(p^2 + q^2) / 40^2)) / 2, p, q)

Lightness counts in full among whites, greys and blacks, which differ in nothing else, and half among strong colours,
of which photographs vary it most. A colour becomes the unit vector phi(x), such that the cosine falls with the
distance of coordinates::

    <phi(x), phi(y)> = exp(-|x - y|^2 / (2 sigma^2)),    sigma = 30

which is 0.95 at a distance of 10 (neighbouring shades), 0.61 at 30, 0.14 at 60 and 0.004 at 100. No finite number of
dimensions does that exactly. Here phi is the Nystroem approximation on 343 anchors, a lattice of 7 levels per channel
of sRGB: with L L^T the kernel matrix of the anchors, phi(x) = L^-1 k(anchors, x), normalised. The cosine is right to
4e-3 in random pairs of sRGB colours, and to 1e-3 in 99 % of them. It understands nothing but colour.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32, Float64

from normlift_ns.encoders.texts.prompts import check_prompts
from normlift_ns.errors import InputError, shortened

if TYPE_CHECKING:
    from torch import Tensor

SIGMA = 30.0
"""Width of the kernel, in units of `shading_coordinates`."""
_STRONG = 40.0
"""Relative chroma at which a colour is a strong one."""
_LEVELS = 7
_LEVEL_POWER = 1.5
"""Above 1, the lattice is denser among dark colours, whose coordinates change fast."""
_JITTER = 1e-10
_COARSE = frozenset({"barf", "booger", "diarrhea", "piss", "poo", "poop", "puke", "shit", "snot", "vomit"})
"""Words of the survey that are understood, but not offered."""


@dataclass(frozen=True)
class ColourTexts:
    """Names of colours as vectors; formulas at the top of this file."""

    @property
    def identity(self) -> dict[str, Any]:
        return {"kind": "colour", "sigma": SIGMA}

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        """As `rows`, for torch."""
        import torch  # noqa: PLC0415 (a question that needs no more is asked without)

        return torch.from_numpy(self.rows(prompts))

    def rows(self, prompts: Sequence[str]) -> Float32[np.ndarray, "q d"]:
        """One unit row per prompt: the mean of the vectors of the colours it names, so that each of them answers.

        Raises:
            ValueError: no prompt, an empty one, or one without a colour name.
        """
        check_prompts(prompts)
        rows = []
        for prompt in prompts:
            found = colour_names(prompt)
            if len(found) == 0:
                raise InputError(_unknown(prompt))
            rows.append(embed(np.stack([_names()[name] for name in found])).mean(axis=0))
        return _normalized(np.stack(rows)).astype(np.float32)


def refuse_template(template: str) -> None:
    """Raises ValueError for a template: colour names are read as they are."""
    if template != "{}":
        raise InputError(f"--text-template {template!r} is for --encoder open_clip; leave it out")


def embed(lab: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 343"]:
    """phi of CIELAB colours (D65, L* in 0..100): unit rows."""
    from scipy.linalg import solve_triangular  # noqa: PLC0415 (as in `_names`)

    anchors, cholesky = _anchors()
    kernel = _kernel(anchors, shading_coordinates(lab))
    return _normalized(solve_triangular(cholesky, kernel, lower=True).T)


def shading_coordinates(lab: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """x of CIELAB colours, formula at the top of this file.

    >>> shading_coordinates(np.array([[50.0, 0.0, 0.0], [50.0, 160.0, -120.0], [17.0, 80.0, -60.0]])).round(4)
    array([[  50. ,    0. ,    0. ],
           [  25. ,  160. , -120. ],
           [   8.5,  160. , -120. ]])
    """
    lightness, chroma = lab[:, :1], lab[:, 1:]
    chroma = 66 * chroma / (lightness + 16)
    strength = (chroma**2).sum(axis=1, keepdims=True) / _STRONG**2
    return np.concatenate([lightness * (1 + np.exp(-strength)) / 2, chroma], axis=1)


def _normalized(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def colour_names(prompt: str) -> list[str]:
    """The colour names in a prompt, read from left to right, each as long as possible; other words are passed over.

    >>> colour_names("dark red shoes on a grey-green floor")
    ['dark red', 'grey green']
    """
    words = _words(prompt)
    found = []
    i = 0
    while i < len(words):
        for length in range(min(len(words) - i, _longest_name()), 0, -1):
            name = " ".join(words[i : i + length])
            if name in _names():
                found.append(name)
                i += length
                break
        else:
            i += 1
    return found


def _words(text: str) -> list[str]:
    """Lower-case words; the survey spells grey with an e."""
    return re.findall(r"[a-z]+(?:'[a-z]+)?", text.lower().replace("gray", "grey"))


@cache
def survey() -> dict[str, str]:
    """#rrggbb of every name as the XKCD colour survey spells it."""
    return json.loads(Path(__file__).with_name("xkcd.json").read_text(encoding="utf8"))


@cache
def _names() -> dict[str, np.ndarray]:
    """CIELAB colour of every name. The survey has eleven names twice, as "blue green" and "blue/green": the former
    counts."""
    from skimage.color import rgb2lab  # noqa: PLC0415 (what other encoders do without is not loaded)

    colours = sorted(survey().items(), key=lambda item: "/" in item[0], reverse=True)
    names = [" ".join(_words(name)) for name, _ in colours]
    lab = rgb2lab(np.array([list(bytes.fromhex(colour[1:])) for _, colour in colours]) / 255)
    return dict(zip(names, lab))


@cache
def _longest_name() -> int:
    return max(len(name.split()) for name in _names())


@cache
def _anchors() -> tuple[np.ndarray, np.ndarray]:
    from skimage.color import rgb2lab  # noqa: PLC0415 (as in `_names`)

    level = np.linspace(0, 1, _LEVELS) ** _LEVEL_POWER
    lattice = np.stack(np.meshgrid(level, level, level, indexing="ij"), axis=-1).reshape(-1, 3)
    anchors = shading_coordinates(rgb2lab(lattice))
    return anchors, np.linalg.cholesky(_kernel(anchors, anchors) + _JITTER * np.eye(len(anchors)))


def _kernel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.exp(-((x[:, None] - y) ** 2).sum(axis=2) / (2 * SIGMA**2))


def _unknown(prompt: str) -> str:
    names = list(_names())
    near = [name for word in [prompt.lower(), *_words(prompt)] for name in difflib.get_close_matches(word, names)]
    near = [name for name in near if _COARSE.isdisjoint(name.split())]
    shown = ", ".join(list(dict.fromkeys(near))[:6] or ["red", "dark green", "sky blue"])
    return (
        f"text {shortened(prompt)!r} contains no colour name; the colour encoder knows the names of the XKCD colour "
        f"survey only, such as {shown}: use one of them, or lift with --encoder open_clip for other words"
    )
