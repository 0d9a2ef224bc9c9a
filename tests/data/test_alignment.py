"""Photographs, cameras and Gaussians that belong together, and such that do not."""

import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from normlift_ns import InputError, open_scene
from normlift_ns.core.scene import View
from normlift_ns.data import alignment
from normlift_ns.data.alignment import Alignment, alignment_warning, cached_alignment, measure_alignment
from normlift_ns.io.arrays import save_arrays
from normlift_ns.rasterization.rasterize import render_image
from normlift_ns.rasterization.settings import RasterSettings
from tests.captures import SHARED, needs_shared
from tests.random_scenes import generator


class Changed:
    """A scene, and its training views, which are changed."""

    def __init__(self, scene, change) -> None:
        self._scene, self._change, self.train = scene, change, self

    def __getattr__(self, name: str):
        return getattr(self._scene, name)

    def __len__(self) -> int:
        return len(self._scene.train)

    def __getitem__(self, index: int) -> View:
        return self._change(self._scene.train[index])


def focal(factor: float):
    scale = torch.tensor([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])
    return lambda view: view._replace(camera=replace(view.camera, K=view.camera.K * scale))


def noisy(view: View) -> View:
    noise = 25 * torch.randn(view.image.shape, generator=generator(0))
    return view._replace(image=(view.image + noise).clamp(0, 255).to(torch.uint8))


@pytest.fixture(scope="module")
def scene(trained: Path):
    return open_scene(trained)


def test_a_comparison_is_made_once_for_the_same_scene(scene, tmp_path: Path, monkeypatch) -> None:
    waits: list[int] = []

    def compare(of) -> Alignment:
        settings = RasterSettings.recorded(of.identity)
        return cached_alignment(of, settings, tmp_path, device="cpu", wait_for_kernels=lambda: waits.append(1))

    match = compare(scene)
    assert match == measure_alignment(scene) and len(waits) == 1
    with monkeypatch.context() as patch:
        patch.setattr(alignment, "measure_alignment", lambda *_, **__: pytest.fail("rendered again"))
        assert compare(scene) == match and len(waits) == 1
    for change in (noisy, focal(1.1)):
        assert compare(Changed(scene, change)).psnr < match.psnr
    count = len(waits)
    for file in tmp_path.iterdir():
        file.write_bytes(file.read_bytes()[:-1])
    assert compare(scene) == match and len(waits) == count + 1
    for file in tmp_path.iterdir():
        save_arrays(file, {}, {"alignment": '["a", ["b", "c"], 1, 2, 3, null]'}, key=file.stem, overwrite=True)
    assert compare(scene) == match


def test_what_belongs_together_passes(scene, trained: Path) -> None:
    match = measure_alignment(scene)
    assert match.psnr > 40  # the photographs are pictures of these very Gaussians
    assert not list(trained.parent.glob("events.out.*"))  # a thread of tensorboard would write on
    assert match.visible_fraction > 0.5
    assert match.mean_color_psnr < 20
    assert alignment_warning(match, trained_cameras=True) is None

    def hidden(view: View) -> View:
        image, mask = view.image.clone(), torch.ones(view.image.shape[:2], dtype=torch.bool)
        image[: len(image) // 2] = 0
        mask[: len(image) // 2] = False
        return view._replace(image=image, mask=mask)

    assert measure_alignment(Changed(scene, hidden)).psnr > 40  # masked pixels do not count


def warning_of(scene, change) -> str:
    warning = alignment_warning(measure_alignment(Changed(scene, change)), trained_cameras=True)
    assert warning is not None
    return warning


def moved(pixels: float):
    shift = torch.tensor([[0, 0, pixels], [0, 0, 0], [0, 0, 0]])
    return lambda view: view._replace(camera=replace(view.camera, K=view.camera.K + shift))


def distorted(k1: float):
    def change(view: View) -> View:
        K = view.camera.K.double().numpy() - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        height, width = view.image.shape[:2]
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 1, 2).astype(float)
        seen = cv2.undistortPoints(pixels, K, np.array([k1, 0, 0, 0]), P=K).reshape(height, width, 2).astype(np.float32)
        return view._replace(image=torch.from_numpy(cv2.remap(view.image.numpy(), seen, None, cv2.INTER_LINEAR)))

    return change


@pytest.mark.parametrize(
    ("change", "pattern", "value"),
    [
        (focal(1.02), "Focal lengths that are (.*)% shorter", 1.96),
        (focal(0.98), "Focal lengths that are (.*)% longer", 2.04),
        (moved(8), "principal point that is shifted by (.*) pixels left", 8),
        (distorted(0.1), "k1 that is higher by (.*) fits", 0.1),
        (noisy, "([0-9]*) dB or more is usual", 24),
    ],
)
def test_the_cause_of_a_loss_is_named(scene, change, pattern: str, value: float) -> None:
    found = re.search(pattern, warning_of(scene, change))
    assert found is not None and float(found[1]) == pytest.approx(value, rel=0.1)


def test_flat_gaussians_are_told_from_others(scene) -> None:
    """gsplat's 2DGS leaves the third scale as it began."""

    class Thick(Changed):
        gaussians = replace(scene.gaussians, scales=scene.gaussians.scales[:, [0, 1, 1]])

    gaussians = replace(scene.gaussians, scales=scene.gaussians.scales * torch.tensor([1.0, 1, 0]))
    match = measure_alignment(
        Thick(scene, lambda view: view._replace(image=render_image(scene, view.camera, gaussians=gaussians)))
    )
    assert "2D Gaussian Splatting" in str(match.cause)


def test_a_render_must_beat_the_mean_color_by_three_decibels() -> None:
    def match(psnr: float) -> Alignment:
        return Alignment(psnr, ("a.png", psnr), 0.5, 26.0, psnr - 26.0)

    for psnr, refused in ((28.9, True), (29.1, False)):
        warning = alignment_warning(match(psnr), trained_cameras=True)  # the cameras of the training are believed
        assert (warning is not None) is refused
        with pytest.raises(InputError, match=r"2\.9 dB more than the mean color") if refused else nullcontext():
            assert alignment_warning(match(psnr), trained_cameras=False) is None


def test_low_contrast_has_the_margin_of_full_contrast_down_to_the_noise(scene) -> None:
    """A tenth of the contrast, and the noise of a sensor."""

    class Pale(Changed):
        def colors(self, camera):
            return 0.5 + 0.1 * (self._scene.colors(camera) - 0.5)

        background = torch.full((3,), 0.45)

    def pale(view: View) -> View:
        image = 127.5 + 0.1 * (view.image - 127.5) + 2 * torch.randn(view.image.shape, generator=generator(0))
        return view._replace(image=image.round().to(torch.uint8))

    match = measure_alignment(Pale(scene, pale))
    assert match.mean_color_psnr > 24  # so the usual PSNR alone says nothing
    assert match.margin > 4 and match.is_usual
    wrong = measure_alignment(Pale(scene, lambda view: pale(view)._replace(image=pale(view).image.flip(0))))
    assert wrong.psnr > 24 and wrong.margin < 3 and not wrong.is_usual


def test_cameras_and_images_of_another_scene_are_refused(scene) -> None:
    def shifted(view: View) -> View:
        away = torch.tensor([0, 0, -1000, 0])[:, None] * torch.tensor([0, 0, 0, 1])
        return view._replace(camera=replace(view.camera, world_to_camera=view.camera.world_to_camera + away))

    with pytest.raises(InputError, match=r"0\.00%"):
        alignment_warning(measure_alignment(Changed(scene, shifted)), trained_cameras=True)
    upside_down = Changed(scene, lambda view: view._replace(image=255 - view.image.flip(0)))
    match = measure_alignment(upside_down)
    assert match.margin < 3
    with pytest.raises(InputError, match="does not match its images"):
        alignment_warning(match, trained_cameras=False)
    warning = alignment_warning(match, trained_cameras=True)  # a run that was hardly trained can be lifted
    assert "stopped early" in str(warning)


def test_one_wrong_photograph_of_three_is_named(scene) -> None:
    last = len(scene.train) - 1
    for place, exchange in ((0, False), (last // 2, True), (last, False)):
        name = scene.train[place].name
        image = exchange * scene.train[(place + 1) % len(scene.train)].image  # or black

        def change(view: View, name: str = name, image: torch.Tensor = image) -> View:
            return view._replace(image=image) if view.name == name else view

        match = measure_alignment(Changed(scene, change))
        assert match.psnr > 24 > match.worst[1] and match.worst[0] == name
        warning = alignment_warning(match, trained_cameras=True)
        assert warning is not None and f"{name}, one of the training images" in warning


@needs_shared
@pytest.mark.slow
def test_real_captures() -> None:
    for name, factor in (("fox", 0.98), ("tabletop", 1.02)):
        scene = open_scene(SHARED / "captures" / "outputs" / name / "splatfacto" / "run" / "config.yml")
        match = measure_alignment(scene)
        assert match.margin > 4 and alignment_warning(match, trained_cameras=True) is None
        assert "fit the images better" in warning_of(scene, focal(factor))
