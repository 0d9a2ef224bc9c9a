"""Search for the cause of a poor alignment: a wrong focal length, principal point, distortion or primitive."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from normlift_ns.data.reduced_views import ReducedView

_SIDES = (50, 100, 200)
"""Lengths of the longer image side in pixels, from the coarsest search to the finest."""
_HALVINGS, _MAX_MOVES = 2, 8
"""Number of halvings of the step for each image size, and maximum number of moves for each step."""
_MIN_GAIN = 1.0
"""Minimum gain in PSNR, in dB, of a change that is reported as the cause. On a sharp scene, an error of 2 % in the
focal length costs about 15 dB."""
_MIN_OVERLAP = 0.25
"""Minimum share of the unmasked pixels that can still be compared after a change of the lens."""


class Lens(NamedTuple):
    """Change of the intrinsics of all cameras."""

    focal: float = 1.0
    """Factor on the focal lengths."""
    x: float = 0.0
    """Shift of the principal point to the right, in image widths."""
    y: float = 0.0
    """Shift of the principal point downward, in image widths."""
    k1: float = 0.0
    """Increase of OpenCV's radial distortion parameter k1."""


_PROBES = (
    *(Lens(focal=factor) for factor in (1 / 1.02, 1.02)),
    *(Lens(x=shift) for shift in (-0.01, 0.01)),
    *(Lens(y=shift) for shift in (-0.01, 0.01)),
    *(Lens(k1=change) for change in (-0.04, 0.04)),
)
"""Small changes of the lens. If the lens is right, none of them improves the fit by 1 dB."""


class _Pair(NamedTuple):
    """Blurred image and render of the same size. Without the blur, warping would make only the image less sharp."""

    image: Float[Tensor, "1 4 h w"]
    """RGB in 0..1, and the fraction of unmasked pixels in each pixel's blur window."""
    render: Float[Tensor, "1 3 h w"]
    focal: tuple[float, float]
    center: tuple[float, float]

    def compare(self, lens: Lens) -> tuple[float, float]:
        """Warp the image by a change of the lens, and compare it with the render and with its own mean color.

        Returns:
            The PSNR in dB of the render and the PSNR of the mean color, or -inf and 0 if the overlap is too small.
        """
        height, width = self.image.shape[2:]
        (fx, fy), (cx, cy) = self.focal, self.center
        x, y = (torch.arange(width) + 0.5 - cx) / fx, ((torch.arange(height) + 0.5 - cy) / fy)[:, None]
        stretch = lens.focal * (1 + lens.k1 * (x * x + y * y))
        u, v = cx + lens.x * width + fx * x * stretch, cy + lens.y * width + fy * y * stretch
        grid = torch.stack([2 * u / width - 1, 2 * v / height - 1], dim=2)[None]
        seen = functional.grid_sample(self.image, grid, align_corners=False)
        inside = seen[0, 3] > 0.999
        if int(inside.sum()) < _MIN_OVERLAP * int((self.image[0, 3] > 0.999).sum()):
            return -torch.inf, 0.0
        image, render = seen[0, :3, inside], self.render[0, :, inside]
        errors = (image - render, image - image.mean(dim=1, keepdim=True))
        first, second = (float(-10 * error.square().mean().clamp(min=1e-9).log10()) for error in errors)
        return first, second


class _Search(NamedTuple):
    """Search over one or two parameters of a lens, from a coarse grid to small steps."""

    make: Callable[..., Lens]
    values: Sequence[Iterable[float]]
    """Coarse grid of each parameter."""
    step: float
    """Distance between neighbors in the grid."""


_SEARCHES = (
    _Search(lambda log: Lens(focal=float(np.exp(log))), [np.arange(-18, 19) * 0.04], 0.04),
    _Search(lambda x, y: Lens(x=x, y=y), [np.arange(-6, 7) * 0.04] * 2, 0.04),
    _Search(lambda k1: Lens(k1=k1), [np.arange(-8, 9) * 0.05], 0.05),
)


def explain_misfit(
    views: Sequence[ReducedView],
    renders: Sequence[UInt8[Tensor, "h w 3"]],
    render_flat: Callable[[ReducedView], UInt8[Tensor, "h w 3"]] | None,
    min_psnr: float,
    min_margin: float,
) -> str | None:
    """Return a message about the change with which the renders fit the images best; None if no change fits well enough.

    Changes of the lens are tried by warping the images, without new renders.

    Args:
        views: Reduced views of the images.
        renders: Render of each view.
        render_flat: Function that renders a view as 2D Gaussians. If None, this primitive is not tried, and the search
            stops if no small change of the lens helps.
        min_psnr: PSNR in dB that the change must reach.
        min_margin: Lead in dB over the PSNR of the mean color that the change must reach.
    """
    levels = [[_pair(small.reduced(side), small, image) for small, image in zip(views, renders)] for side in _SIDES]
    before = _mean(levels[-1], Lens())[0]
    if render_flat is None and max(_mean(levels[-1], lens)[0] for lens in _PROBES) < before + _MIN_GAIN:
        return None
    found = [(*_mean(levels[-1], lens), _describe(lens, views)) for lens in (_fit(levels, s) for s in _SEARCHES)]
    if render_flat is not None:
        flat = [_pair(small, small, render_flat(small)) for small in views]
        found.append((*_mean(flat, Lens()), _FLAT))
    psnr, constant, text = max(found)
    if psnr < max(min_psnr, before + _MIN_GAIN, constant + min_margin):
        return None
    return text.format(gain=f"better by {psnr - before:.1f} dB")


def _pair(reduced: ReducedView, small: ReducedView, render: UInt8[Tensor, "h w 3"]) -> _Pair:
    """Return the blurred image and render of a view at a reduced size."""
    view = reduced.view
    mask = torch.ones(view.image.shape[:2], dtype=torch.bool) if view.mask is None else view.mask
    rendered = reduced._replace(view=small.view._replace(image=render)).reduced(max(view.image.shape[:2])).view.image
    (fx, _, cx), (_, fy, cy), _ = view.camera.K.tolist()
    image, rendered = (_blurred(value.permute(2, 0, 1)[None].float() / 255) for value in (view.image, rendered))
    return _Pair(torch.cat([image, _whole(mask)], dim=1), rendered, (fx, fy), (cx, cy))


def _blurred(image: Float[Tensor, "1 c h w"]) -> Float[Tensor, "1 c h w"]:
    return functional.avg_pool2d(image, 3, stride=1, padding=1, count_include_pad=False)


def _whole(mask: Bool[Tensor, "h w"]) -> Float[Tensor, "1 1 h w"]:
    """Return the fraction of unmasked pixels in each pixel's blur window."""
    return _blurred(mask[None, None].float())


def _mean(pairs: Sequence[_Pair], lens: Lens) -> tuple[float, float]:
    """Return the means of `_Pair.compare` over the views."""
    psnr, constant = zip(*(pair.compare(lens) for pair in pairs))
    return sum(psnr) / len(pairs), sum(constant) / len(pairs)


def _fit(levels: Sequence[Sequence[_Pair]], search: _Search) -> Lens:
    """Return the lens with the highest PSNR, found on the coarsest images and refined on finer ones."""
    best = max(product(*search.values), key=lambda values: _mean(levels[0], search.make(*values)))
    step = search.step
    for level in levels:
        psnr = cache(lambda values, level=level: _mean(level, search.make(*values)))
        for _ in range(_HALVINGS):
            step /= 2
            for _ in range(_MAX_MOVES):
                center = best
                best = max([center, *product(*((value - step, value, value + step) for value in center))], key=psnr)
                if best == center:
                    break
    return search.make(*best)


_FLAT = (
    "Rendered as flat Gaussians, the splat fits the images {gain}. It was probably trained by 2D Gaussian Splatting, "
    "whose primitives are flat."
)


def _describe(lens: Lens, views: Sequence[ReducedView]) -> str:
    """Return a message about a change of the lens, with the placeholder {gain} for the gain in PSNR."""
    if lens.focal != 1.0:
        side = "longer" if lens.focal > 1 else "shorter"
        return (
            f"Focal lengths that are {100 * abs(lens.focal - 1):.2g}% {side} fit the images {{gain}}. The training "
            "probably used other cameras: has the camera file changed since, or were the images resized?"
        )
    if lens.k1 != 0.0:
        return (
            f"A radial distortion k1 that is {'higher' if lens.k1 > 0 else 'lower'} by {abs(lens.k1):.2g} fits the "
            "images {gain}. Check whether the images are distorted and the cameras are those of undistorted images, or "
            "the reverse."
        )
    width = views[0].view.camera.width * views[0].divisor
    shifts = (lens.x, "right", "left"), (lens.y, "down", "up")
    pixels = [f"{abs(width * shift):.1f} pixels {more if shift > 0 else less}" for shift, more, less in shifts if shift]
    return (
        f"A principal point that is shifted by {' and '.join(pixels)} fits the images {{gain}}. Check whether the "
        "images were cropped after the training. Inria's trainer puts the principal point at the center of the image."
    )
