"""Output files of the coverage study: renders of the new poses, and a camera path for ns-render."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Float64, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from normlift_ns.core.files import new_files
from normlift_ns.core.scene import Scene
from normlift_ns.evaluation.coverage.gain import Drawn, smaller
from normlift_ns.evaluation.coverage.poses import Pose
from normlift_ns.evaluation.options import pose_files
from normlift_ns.raster.rasterize import render, render_picture

_MAX_RENDER_PIXELS = 300_000
"""Maximum number of pixels in a render."""
_INCHES, _DPI = 6.0, 100


class Picture(NamedTuple):
    """Render from a pose."""

    image: UInt8[Tensor, "h w 3"]
    reliability: Float[Tensor, "h w"]
    """R in 0..1, NaN for empty pixels."""


def draw_pose(drawn: Drawn, scene: Scene, reliability: Float64[Tensor, " n"], pose: Pose) -> Picture:
    """Render the trained scene from a new pose, with the mean R at every pixel."""
    camera = smaller(pose.camera, _MAX_RENDER_PIXELS)
    kwargs = {"rasterize_mode": drawn.rasterize_mode, "settings": drawn.settings}
    image = render_picture(scene, camera, settings=drawn.settings, gaussians=drawn.gaussians)
    values, alpha = render(drawn.gaussians, camera, reliability[:, None].to(drawn.gaussians.means), **kwargs)
    return Picture(image, torch.where(alpha > 0.5, values[:, :, 0] / alpha, torch.nan).cpu())


def camera_path(poses: Sequence[Pose]) -> dict[str, Any]:
    """Return a camera path for `ns-render camera-path`, one second per pose.

    It applies to the run of the poses, because it uses the coordinates of that run.
    """
    width, height = (poses[0].camera.width, poses[0].camera.height)
    cameras = [
        {
            "camera_to_world": pose.camera_to_world().flatten().tolist(),
            "fov": pose.field_of_view,
            "aspect": width / height,
        }
        for pose in poses
    ]
    size = {"render_width": width, "render_height": height}
    return {"camera_type": "perspective", **size, "camera_path": cameras, "fps": 1, "seconds": len(poses)}


def write_poses(
    stem: Path,
    poses: Sequence[Pose],
    pictures: Sequence[Picture],
    *,
    documents: Mapping[Path, Mapping[str, Any]] | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write <stem>_camera_path.json and <stem>_pose_1.png …, either all or none; without poses, write none of them.

    Args:
        documents: more JSON files for the same folder.
        overwrite: replace files of these names, and remove those of an earlier study.
    Raises:
        FileExistsError: a file exists and `overwrite` is False.
        OSError: the files cannot be written.
    """
    path, *images = pose_files(stem)
    json_files = dict(documents or {})
    if len(poses) > 0:
        json_files[path] = camera_path(poses)
    written = [*json_files, *images[: len(poses)]]
    if len(written) == 0:
        return []
    old = [file for file in (path, *images) if overwrite and file not in written]
    with new_files(*written, overwrite=overwrite, remove=old) as drafts:
        for draft, content in zip(drafts, json_files.values()):
            draft.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", "utf8")
        for i, (draft, pose, picture) in enumerate(zip(drafts[len(json_files) :], poses, pictures), 1):
            save_picture(draft, f"pose {i}, shows region {', '.join(map(str, pose.regions))}", picture)
    return written


def save_picture(path: Path, title: str, picture: Picture) -> None:
    """Save the scene next to its reliability, with a color scale."""
    height, width = picture.reliability.shape
    figure = Figure(figsize=(2 * _INCHES, _INCHES * height / width + 0.6), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    left.imshow(picture.image.numpy())
    left.set_title(title, parse_math=False)
    right.set_facecolor("black")
    right.imshow(picture.image.float().mean(dim=2).numpy(), cmap="gray", vmin=0, vmax=255)
    heat = right.imshow(picture.reliability.numpy(), cmap="inferno", vmin=0, vmax=1, alpha=0.75)
    scale = figure.colorbar(heat, ax=right, fraction=0.05)
    scale.solids.set_alpha(1.0)  # pyright: ignore[reportOptionalMemberAccess]
    scale.set_label("R")
    right.set_title("reliability")
    for axes in (left, right):
        axes.set_xticks([])
        axes.set_yticks([])
    figure.savefig(path)
