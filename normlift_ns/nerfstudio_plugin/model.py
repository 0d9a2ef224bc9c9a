"""splatfacto model with a semantic field, and an LPIPS metric that loads its weights on first use."""

from __future__ import annotations

import inspect
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.data.images import to_camera
from normlift_ns.data.nerfstudio.load import active_sh_degree
from normlift_ns.data.open_scene import resolve_field_paths
from normlift_ns.errors import InputError
from normlift_ns.exports import TrainedSplat
from normlift_ns.io.run_dir import FIELD_FOLDER, check_run
from normlift_ns.nerfstudio_plugin.panel import SearchPanel
from normlift_ns.query.question import Query, load_query
from normlift_ns.rasterization.rasterize import ray_weights, render, view_colors
from normlift_ns.rasterization.settings import RasterSettings
from normlift_ns.rendering.figures import Display, render_outputs


class LazyLpips(torch.nn.Module):
    """Replacement for torchmetrics' LearnedPerceptualImagePatchSimilarity that downloads weights on first use.

    Args:
        options: Keyword arguments of the metric.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__()
        self.options = options
        self.available = True
        """False if the metric or its weights could not be loaded."""
        self._metric: list[torch.nn.Module] = []  # a list keeps the network out of checkpoints

    def forward(self, image: Tensor, reference: Tensor) -> Tensor:
        """Return the LPIPS of images [B, 3, H, W] in 0..1. If the metric cannot be loaded, warn once and return NaN."""
        if self.available and not self._metric:
            from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity  # noqa: PLC0415 (slow)

            try:
                self._metric.append(LearnedPerceptualImagePatchSimilarity(**self.options))
            except (ImportError, OSError) as error:
                self.available = False
                warnings.warn(f"LPIPS is skipped, because it cannot be loaded ({error})", stacklevel=2)
        return self._metric[0].to(image.device)(image, reference) if self.available else image.new_tensor(torch.nan)


# splatfacto model with a semantic field, for ns-viewer, ns-render, ns-eval and ns-export.


_MIN_FOCAL = 1e-3
"""Minimum focal length of a camera that replaces an invalid one, as a multiple of the longer side of the image. The
maximum multiple is the inverse, 1,000."""


@dataclass
class NormLiftModelConfig(SplatfactoModelConfig):
    """Config of splatfacto with a semantic field."""

    _target: type = field(default_factory=lambda: NormLiftModel)
    semantics: Path | None = None
    """Folder of the semantic field, normlift/ in a lifted run, relative to config.yml. None means no field."""


class NormLiftModel(SplatfactoModel):
    """splatfacto model that loads without LPIPS weights and without CUDA, and also renders semantic outputs.

    On CUDA, stock splatfacto renders all other outputs. On the CPU, splatfacto cannot render, and normlift_ns renders
    all outputs.
    """

    config: NormLiftModelConfig  # type: ignore[assignment]  (narrower than in the base class, as everywhere in nerfstudio)

    def populate_modules(self) -> None:
        """Set up splatfacto's modules without CUDA and without downloads, and add the viewer panel."""
        if not torch.cuda.is_available():  # splatfacto moves the colors of seed points to CUDA
            # without seed points, splatfacto would search for neighbors of 50,000 random points, so pass four points
            seeds = torch.arange(12.0).view(4, 3), torch.zeros(0, 3)
            self.seed_points = None if self.config.semantics is None else seeds  # until the checkpoint is loaded
        # the stock metric downloads AlexNet
        with patch("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", LazyLpips):
            super().populate_modules()
        self._field: SemanticField | None = None
        self._display: Display | None = None
        self.normlift = SearchPanel(self)
        self.viewer_control = self.normlift.control  # nerfstudio searches for it in the attributes of modules

    @property
    def renders_on_cpu(self) -> bool:
        """True if normlift_ns renders, because stock splatfacto needs CUDA."""
        return self.device.type == "cpu"

    @property
    def field(self) -> SemanticField | None:
        """Semantic field on the device of the model, or None if no field is attached."""
        return self._field

    def load_state_dict(self, dict: Mapping[str, Any], **kwargs: Any) -> None:  # type: ignore[override]
        """Load a splatfacto or normlift checkpoint, and then the semantic field of the config.

        Raises:
            FileNotFoundError, ValueError: The field is missing, is damaged, or belongs to other Gaussians.
        """
        super().load_state_dict({k: v for k, v in dict.items() if not k.startswith("lpips.")}, **kwargs)
        if self.config.semantics is not None:
            folder = self.config.semantics = find_field_folder(self.config.semantics)
            check_run(folder.parent)
            self.attach(resolve_field_paths(SemanticField.load(folder, self.means), folder), load_query(folder))
        if self.renders_on_cpu:
            compile_renderer()

    def attach(self, semantic_field: SemanticField, question: Query | None = None) -> None:
        """Attach a field to the model and enable the panel. If a query is given, also show its answer."""
        self._field = semantic_field.to(self.device)
        self.normlift.open(self._field, self.means.detach(), self.config.semantics, question)

    def detach(self) -> None:
        """Remove the field. Call this method before the Gaussians change."""
        self.config.semantics = self._field = self._display = None
        self.normlift.close()

    def show(self, display: Display | None) -> None:
        """Set the display that is rendered in addition to the colors. Other threads may render during the call."""
        self._display = display

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Return rgb, depth, accumulation and background, and the outputs of `render_outputs` if there is a display.

        Args:
            camera: One camera. An invalid camera from nerfstudio's viewer is replaced by a similar valid one.
            obb_box: Crop box. Gaussians outside it are not drawn.
        """
        display, (camera, view) = self._display, _valid_camera(camera.to(self.device))
        rows = self.drawn_mask(obb_box, display)
        values = self.means.new_zeros(self.num_points, 0) if display is None else display.values
        if self.renders_on_cpu:
            with without_tracer():
                outputs, scalars = self._render_on_cpu(view, values, rows)
        else:
            outputs = super().get_outputs_for_camera(camera, None if rows is None else _Rows(rows))  # type: ignore[arg-type]
            # if all Gaussians are cropped, splatfacto returns outputs on the CPU and a background of shape [3]
            outputs = {name: value.to(self.device) for name, value in outputs.items()}
            outputs["background"] = outputs["background"].expand(view.height, view.width, 3)
            scalars = self._composited(view, values, rows)
        self.set_crop(obb_box)
        if display is None:
            return outputs
        alpha = outputs["accumulation"][:, :, 0]
        with without_tracer():
            return {
                **outputs,
                **render_outputs(display, outputs["rgb"], scalars, alpha, named_by_text=self.normlift.has_viewer),
            }

    def drawn_mask(self, obb_box: OrientedBox | None, display: Display | None) -> Bool[Tensor, " n"] | None:
        """Return the mask of the Gaussians that are in the box and not hidden, or None if all are drawn."""
        drawn = None if display is None else display.drawn
        if obb_box is None:
            return drawn
        inside = obb_box.within(self.means.detach()).reshape(-1)
        return inside if drawn is None else inside & drawn

    def ray_weights(self, origin: Float[Tensor, " 3"], direction: Float[Tensor, " 3"]) -> Float[Tensor, " n"]:
        """Return the `ray_weights` of the Gaussians that the last render drew, and 0 for all others."""
        rows = self.drawn_mask(self.crop_box, self._display)
        weights = ray_weights(self._scene(rows), origin, direction)
        return weights if rows is None else weights.new_zeros(self.num_points).masked_scatter(rows, weights)

    def scene(self) -> GaussianScene:
        """Return all Gaussians with activated parameters."""
        return self._scene(None)

    def splat_parameters(self) -> TrainedSplat:
        """Return the trained parameters, as input of `write_splat`."""
        return TrainedSplat(dict(self.gauss_params), self.config.sh_degree > 0, self.config.rasterize_mode)

    def _scene(self, rows: Tensor | None) -> GaussianScene:
        parts = (self.means, self.quats, self.scales.exp(), self.opacities.sigmoid().squeeze(-1))
        return GaussianScene(*(part.detach() if rows is None else part.detach()[rows] for part in parts))

    def _render_on_cpu(self, view: Camera, values: Tensor, rows: Tensor | None) -> tuple[dict[str, Tensor], Tensor]:
        """Render the outputs of `SplatfactoModel.get_outputs` in eval mode, and the values [N, C], in one pass."""
        scene = self._scene(rows)
        coefficients = torch.cat([self.features_dc[:, None], self.features_rest], dim=1).detach()
        if rows is not None:
            coefficients, values = coefficients[rows], values[rows]
        rgb = view_colors(scene.means, coefficients, view, active_sh_degree(self.config, self.step))
        depth = scene.means @ view.world_to_camera[2, :3, None] + view.world_to_camera[2, 3]
        options = {"rasterize_mode": self.config.rasterize_mode, "settings": self._settings}
        image, alpha = render(scene, view, torch.cat([rgb, depth, values], dim=1), **options)
        alpha = alpha[:, :, None]
        background = self._get_background_color()
        expected_depth = image[:, :, 3:4] / alpha.clamp(min=1e-10)
        outputs = {
            "rgb": (image[:, :, :3] + (1 - alpha) * background).clamp(0, 1),
            "depth": torch.where(alpha > 0, expected_depth, expected_depth.max()),
            "accumulation": alpha,
            "background": background.expand(view.height, view.width, 3),
        }
        return outputs, image[:, :, 4:]

    def _composited(self, view: Camera, values: Tensor, rows: Tensor | None) -> Tensor:
        """Composite values [N, C] with the rasterizer settings of the lift, and return them as [H, W, C]."""
        values, mode = values if rows is None else values[rows], self.config.rasterize_mode
        return render(self._scene(rows), view, values, rasterize_mode=mode, settings=self._settings)[0]

    @property
    def _settings(self) -> RasterSettings:
        """Rasterizer settings of the lift, or those of gsplat 1.4 if no field is attached."""
        return RasterSettings.recorded({} if self._field is None else self._field.manifest)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Return the stock metrics and images, without LPIPS if its weights are not available."""
        metrics, images = super().get_image_metrics_and_images(outputs, batch)
        if not self.lpips.available:
            metrics = {name: value for name, value in metrics.items() if "lpips" not in name}
        return metrics, images


def find_field_folder(semantics: Path) -> Path:
    """Return the folder of the semantic field next to the config.yml that nerfstudio's `eval_setup` reads.

    The config of a copied run contains the path of the original run, and nerfstudio does not pass the path of the
    config to models. This function therefore finds that path in the call stack.

    Args:
        semantics: Folder in the config, which is returned if `eval_setup` is not running, or if there is no such folder
            next to config.yml.
    """
    frame = inspect.currentframe()
    while frame is not None:
        if frame.f_code.co_name == "eval_setup" and "config_path" in frame.f_locals:
            folder = Path(frame.f_locals["config_path"]).absolute().parent / FIELD_FOLDER
            return folder if folder.is_dir() else semantics
        frame = frame.f_back
    return semantics


class _Rows(NamedTuple):
    """Mask of Gaussians with the interface of the crop box that splatfacto expects."""

    mask: Bool[Tensor, " n"]

    def within(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        return self.mask


def compile_renderer() -> None:
    """Compile the CPU rasterizer before the viewer renders under a tracer that would slow the compiler down."""
    scene = GaussianScene(torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1))
    pose = torch.eye(4)
    pose[2, 3] = 3
    K = torch.tensor([[4.0, 0, 2], [0, 4, 2], [0, 0, 1]])
    render(scene, Camera(K, pose, 4, 4), torch.ones(1, 4))


def _opencv(camera: Cameras) -> Camera:
    pose, intrinsics = camera.camera_to_worlds.reshape(3, 4), camera.get_intrinsics_matrices().reshape(3, 3)
    return to_camera(pose, intrinsics, int(camera.width.item()), int(camera.height.item()))


def _valid_camera(camera: Cameras) -> tuple[Cameras, Camera]:
    """Return the camera if it is valid, else a similar valid camera.

    nerfstudio's viewer accepts any number as resolution and field of view. A resolution of 0, or a field of view of at
    least 180 degrees, gives a camera that would terminate the render thread.
    """
    with suppress(InputError):
        return camera, _opencv(camera)
    width, height = int(camera.width.item()), int(camera.height.item())
    if min(width, height) < 1:
        width = height = 1
    size, pose = max(width, height), camera.camera_to_worlds.reshape(3, 4)
    if not bool(pose.isfinite().all()):
        pose = torch.eye(4, device=pose.device)[:3]
    low, high = size * _MIN_FOCAL, size / _MIN_FOCAL
    focal = torch.stack([camera.fx, camera.fy]).nan_to_num(size, posinf=high, neginf=low).clamp(low, high)
    fx, fy = focal.reshape(2, 1, 1)
    near = Cameras(pose[None], fx=fx, fy=fy, cx=width / 2, cy=height / 2, width=width, height=height)
    near = near.to(camera.device)
    return near, _opencv(near)


@contextmanager
def without_tracer() -> Iterator[None]:
    """Suspend the tracer of nerfstudio's viewer, which can interrupt a render at any line of Python.

    An exception from the tracer inside numba's dispatcher or during an import would terminate the render thread.
    """
    tracer = sys.gettrace()
    sys.settrace(None)
    try:
        yield
    finally:
        sys.settrace(tracer)
