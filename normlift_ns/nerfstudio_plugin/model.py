"""splatfacto's model with a semantic field attached: what ns-viewer, ns-render, ns-eval and ns-export load."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.errors import InputError
from normlift_ns.nerfstudio_plugin.lpips import LazyLpips
from normlift_ns.nerfstudio_plugin.panel import Panel
from normlift_ns.options import RasterizeMode
from normlift_ns.question import Question
from normlift_ns.raster.colors import view_colors
from normlift_ns.raster.picking import ray_weights
from normlift_ns.raster.rasterize import render
from normlift_ns.raster.settings import RasterSettings
from normlift_ns.runs.files import FIELD_FOLDER, check_run, with_paths
from normlift_ns.runs.question import load_question
from normlift_ns.scenes.nerfstudio.appearance import shading_degree
from normlift_ns.scenes.photographs import to_camera
from normlift_ns.viewer.display import Display, draw

_WIDEST = 1e-3
"""Least focal length of a picture that is drawn, and its inverse the greatest, in larger sides of the picture."""


@dataclass
class NormLiftModelConfig(SplatfactoModelConfig):
    """splatfacto with the semantics that ns-normlift lifted onto its Gaussians."""

    _target: type = field(default_factory=lambda: NormLiftModel)
    semantics: Path | None = None
    """Folder of the semantic field (normlift/ of a lifted run), relative to config.yml; none: plain splatfacto."""

    @staticmethod
    def upgrade(config: SplatfactoModelConfig, *, semantics: Path | None = None) -> NormLiftModelConfig:
        """The same model with a field: every field of the config is taken over."""
        values = {f.name: getattr(config, f.name) for f in fields(SplatfactoModelConfig) if f.name != "_target"}
        return NormLiftModelConfig(**values, semantics=semantics)


class NormLiftModel(SplatfactoModel):
    """splatfacto that loads without LPIPS weights and without CUDA, and renders scalars of its Gaussians.

    On CUDA all but the scalars is stock splatfacto. On the CPU, where splatfacto cannot render, normlift_ns does.
    """

    config: NormLiftModelConfig  # type: ignore[assignment]  (narrower than in the base class, as everywhere in nerfstudio)

    def populate_modules(self) -> None:
        """As splatfacto's, without what it needs CUDA or a download for; with the panel of the viewer."""
        if not torch.cuda.is_available():  # where splatfacto cannot move the colours of seed points to, nor train
            few = torch.arange(12.0).view(4, 3), torch.zeros(0, 3)  # without, it finds the neighbours of 50,000
            self.seed_points = None if self.config.semantics is None else few  # until the checkpoint brings its own
        with _lazy_lpips():
            super().populate_modules()
        self._field: SemanticField | None = None
        self._display: Display | None = None
        self.normlift = Panel(self)

    @property
    def on_cpu(self) -> bool:
        """True where normlift_ns renders; stock splatfacto needs CUDA."""
        return self.device.type == "cpu"

    @property
    def field(self) -> SemanticField | None:
        """The attached field, on the model's device."""
        return self._field

    def load_state_dict(self, dict: Mapping[str, Any], **kwargs: Any) -> None:  # type: ignore[override]
        """Loads a splatfacto or normlift checkpoint, then the field that the config names.

        Raises:
            FileNotFoundError, ValueError: no field there, a damaged one, or one of other Gaussians.
        """
        super().load_state_dict({k: v for k, v in dict.items() if not k.startswith("lpips.")}, **kwargs)
        if self.config.semantics is not None:
            folder = self.config.semantics = own_semantics(self.config.semantics)
            check_run(folder.parent)
            self.attach(with_paths(SemanticField.load(folder, self.means), folder), load_question(folder))
        if self.on_cpu:
            compile_renderer()

    def attach(self, semantic_field: SemanticField, question: Question | None = None) -> None:
        """Renders a field and the answer to a question from now on, and lets the panel ask it."""
        self._field = semantic_field.to(self.device)
        self.normlift.open(self._field, self.means.detach(), self.config.semantics, question)

    def detach(self) -> None:
        """Forgets the field, because the Gaussians are about to change."""
        self.config.semantics = self._field = self._display = None
        self.normlift.close()

    def show(self, display: Display | None) -> None:
        """Replaces what is drawn besides the colours. Safe to call while another thread renders."""
        self._display = display

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Stock outputs (rgb, depth, accumulation, background), and with a field those of `display.draw`.

        Args:
            camera: one camera. nerfstudio's viewer can ask for impossible ones; a possible one is drawn instead.
            obb_box: Gaussians outside are not drawn.
        """
        display, (camera, view) = self._display, _drawable(camera.to(self.device))
        rows = self.rows_in(obb_box, display)
        values = self.means.new_zeros(self.num_points, 0) if display is None else display.values
        if self.on_cpu:
            with untraced():
                outputs, scalars = self._render_on_cpu(view, values, rows)
        else:
            outputs = super().get_outputs_for_camera(camera, None if rows is None else _Rows(rows))  # type: ignore[arg-type]
            # where all is cropped away, splatfacto's outputs are on the CPU and its background is [3]
            outputs = {name: value.to(self.device) for name, value in outputs.items()}
            outputs["background"] = outputs["background"].expand(view.height, view.width, 3)
            scalars = self._composited(view, values, rows)
        self.set_crop(obb_box)
        if display is None:
            return outputs
        alpha = outputs["accumulation"][:, :, 0]
        with untraced():
            return {**outputs, **draw(display, outputs["rgb"], scalars, alpha, by_text=self.normlift.viewed)}

    def rows_in(self, obb_box: OrientedBox | None, display: Display | None) -> Bool[Tensor, " n"] | None:
        """The Gaussians that are drawn: inside the box, and not hidden; None: all."""
        drawn = None if display is None else display.drawn
        if obb_box is None:
            return drawn
        inside = obb_box.within(self.means.detach()).reshape(-1)
        return inside if drawn is None else inside & drawn

    def in_sight(self, origin: Float[Tensor, " 3"], direction: Float[Tensor, " 3"]) -> Float[Tensor, " n"]:
        """`ray_weights` of the Gaussians that were drawn last."""
        rows = self.rows_in(self.crop_box, self._display)
        weights = ray_weights(self._scene(rows), origin, direction)
        return weights if rows is None else weights.new_zeros(self.num_points).masked_scatter(rows, weights)

    def scene(self) -> GaussianScene:
        """All Gaussians."""
        return self._scene(None)

    def splats(self) -> tuple[Mapping[str, Tensor], bool, RasterizeMode]:
        """For `write_splats`: parameters, whether colours are spherical harmonics, and how they were rasterized."""
        return dict(self.gauss_params), self.config.sh_degree > 0, self.config.rasterize_mode

    def _scene(self, rows: Tensor | None) -> GaussianScene:
        parts = (self.means, self.quats, self.scales.exp(), self.opacities.sigmoid().squeeze(-1))
        return GaussianScene(*(part.detach() if rows is None else part.detach()[rows] for part in parts))

    def _render_on_cpu(self, view: Camera, values: Tensor, rows: Tensor | None) -> tuple[dict[str, Tensor], Tensor]:
        """As `SplatfactoModel.get_outputs` outside training, with the values [N, C] in the same pass."""
        scene = self._scene(rows)
        coefficients = torch.cat([self.features_dc[:, None], self.features_rest], dim=1).detach()
        if rows is not None:
            coefficients, values = coefficients[rows], values[rows]
        rgb = view_colors(scene.means, coefficients, view, shading_degree(self.config, self.step))
        depth = scene.means @ view.world_to_camera[2, :3, None] + view.world_to_camera[2, 3]
        how = {"rasterize_mode": self.config.rasterize_mode, "settings": self._settings}
        image, alpha = render(scene, view, torch.cat([rgb, depth, values], dim=1), **how)
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
        """sum_j A_ij value_j [H, W, C], by the rules of the lift."""
        drawn, mode = values if rows is None else values[rows], self.config.rasterize_mode
        return render(self._scene(rows), view, drawn, rasterize_mode=mode, settings=self._settings)[0]

    @property
    def _settings(self) -> RasterSettings:
        """Constants of the rasterizer, those of the lift."""
        return RasterSettings.recorded({} if self._field is None else self._field.manifest)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Stock metrics; without LPIPS where its weights cannot be had."""
        metrics, images = super().get_image_metrics_and_images(outputs, batch)
        if not self.lpips.available:
            metrics = {name: value for name, value in metrics.items() if "lpips" not in name}
        return metrics, images


def own_semantics(semantics: Path) -> Path:
    """The semantic field beside the config.yml that nerfstudio's `eval_setup` reads, or where the config says.

    A run that was copied says what the original said. nerfstudio does not tell a model where its config is.
    """
    frame = inspect.currentframe()
    while frame is not None:
        if frame.f_code.co_name == "eval_setup" and "config_path" in frame.f_locals:
            beside = Path(frame.f_locals["config_path"]).absolute().parent / FIELD_FOLDER
            return beside if beside.is_dir() else semantics
        frame = frame.f_back
    return semantics


class _Rows(NamedTuple):
    """Some Gaussians, where splatfacto expects a box that tells which points are within."""

    mask: Bool[Tensor, " n"]

    def within(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        return self.mask


def compile_renderer() -> None:
    """Compiles the CPU rasterizer now: the viewer renders under a tracer, which would slow the compiler down."""
    scene = GaussianScene(torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1))
    pose = torch.eye(4)
    pose[2, 3] = 3
    K = torch.tensor([[4.0, 0, 2], [0, 4, 2], [0, 0, 1]])
    render(scene, Camera(K, pose, 4, 4), torch.ones(1, 4))


def _opencv(camera: Cameras) -> Camera:
    pose, intrinsics = camera.camera_to_worlds.reshape(3, 4), camera.get_intrinsics_matrices().reshape(3, 3)
    return to_camera(pose, intrinsics, int(camera.width.item()), int(camera.height.item()))


def _drawable(camera: Cameras) -> tuple[Cameras, Camera]:
    """The camera, or one near it where there is none such: nerfstudio's viewer takes any number for a resolution and a
    field of view, and what it makes of 0 or of 180 degrees and more would end the thread that draws.
    """
    with suppress(InputError):
        return camera, _opencv(camera)
    width, height = int(camera.width.item()), int(camera.height.item())
    if min(width, height) < 1:
        width = height = 1
    size, pose = max(width, height), camera.camera_to_worlds.reshape(3, 4)
    if not bool(pose.isfinite().all()):
        pose = torch.eye(4, device=pose.device)[:3]
    low, high = size * _WIDEST, size / _WIDEST
    focal = torch.stack([camera.fx, camera.fy]).nan_to_num(size, posinf=high, neginf=low).clamp(low, high)
    fx, fy = focal.reshape(2, 1, 1)
    near = Cameras(pose[None], fx=fx, fy=fy, cx=width / 2, cy=height / 2, width=width, height=height)
    near = near.to(camera.device)
    return near, _opencv(near)


@contextmanager
def untraced() -> Iterator[None]:
    """Without the tracer by which nerfstudio's viewer interrupts a picture at any line of Python.

    An exception from it inside Numba's dispatcher, or in the middle of an import, ends the thread that draws.
    """
    tracer = sys.gettrace()
    sys.settrace(None)
    try:
        yield
    finally:
        sys.settrace(tracer)


@contextmanager
def _lazy_lpips() -> Iterator[None]:
    """splatfacto builds LPIPS, which downloads AlexNet, before anything else; here it gets `LazyLpips` in its place."""
    from torchmetrics.image import lpip  # noqa: PLC0415 (import-light: this module is loaded by every ns-* command)

    stock = lpip.LearnedPerceptualImagePatchSimilarity
    lpip.LearnedPerceptualImagePatchSimilarity = LazyLpips
    try:
        yield
    finally:
        lpip.LearnedPerceptualImagePatchSimilarity = stock
