"""Photographs, cameras and Gaussians that belong together, and such that do not."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from normlift_ns import InputError, open_scene
from normlift_ns.core.scene import View
from normlift_ns.data.alignment import alignment_warning, measure_alignment
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


def shifted(view: View) -> View:
    pose = view.camera.world_to_camera.clone()
    pose[2, 3] -= 1000
    return view._replace(camera=replace(view.camera, world_to_camera=pose))


def noisy(view: View) -> View:
    noise = 25 * torch.randn(view.image.shape, generator=generator(0))
    return view._replace(image=(view.image + noise).clamp(0, 255).to(torch.uint8))


@pytest.fixture(scope="module")
def scene(trained: Path):
    return open_scene(trained)


def test_what_belongs_together_passes(scene, trained: Path) -> None:
    match = measure_alignment(scene)
    assert match.psnr > 40  # the photographs are pictures of these very Gaussians
    assert not list(trained.parent.glob("events.out.*"))  # a thread of tensorboard would write on
    assert match.visible_fraction > 0.5
    assert match.mean_color_psnr < 20
    assert alignment_warning(match, trained_cameras=True) is None


def warning_of(scene, change) -> str:
    warning = alignment_warning(measure_alignment(Changed(scene, change)), trained_cameras=True)
    assert warning is not None
    return warning


def test_another_focal_length_or_look_is_warned_of(scene) -> None:
    for factor, direction in ((1.02, "shorter"), (0.98, "longer"), (1.05, "shorter")):
        assert f"2% {direction}" in warning_of(scene, focal(factor)), factor
    assert "24 dB" in warning_of(scene, noisy)


def test_cameras_and_images_of_another_scene_are_refused(scene) -> None:
    with pytest.raises(InputError, match=r"0\.00%"):
        alignment_warning(measure_alignment(Changed(scene, shifted)), trained_cameras=True)
    upside_down = Changed(scene, lambda view: view._replace(image=255 - view.image.flip(0)))
    match = measure_alignment(upside_down)
    with pytest.raises(InputError, match="does not match"):
        alignment_warning(match, trained_cameras=False)
    assert "stopped early" in str(
        alignment_warning(match, trained_cameras=True)
    )  # a run that was hardly trained can be lifted


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
        assert warning is not None and f"{name}, one of three training images" in warning


def test_masked_pixels_do_not_count(scene) -> None:
    def hidden(view: View) -> View:
        image, mask = view.image.clone(), torch.ones(view.image.shape[:2], dtype=torch.bool)
        image[: len(image) // 2] = 0
        mask[: len(image) // 2] = False
        return view._replace(image=image, mask=mask)

    assert measure_alignment(Changed(scene, hidden)).psnr > 40


@needs_shared
@pytest.mark.slow
def test_real_captures() -> None:
    for name, factor in (("fox", 0.98), ("tabletop", 1.02)):
        scene = open_scene(SHARED / "captures" / "outputs" / name / "splatfacto" / "run" / "config.yml")
        assert alignment_warning(measure_alignment(scene), trained_cameras=True) is None
        assert "increase the PSNR" in warning_of(scene, focal(factor))
