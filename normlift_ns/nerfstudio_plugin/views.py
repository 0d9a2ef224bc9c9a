"""Configs and training views of a run as nerfstudio makes them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from jaxtyping import Bool, Float, UInt8
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.engine.trainer import TrainerConfig
from torch import Tensor

from normlift_ns.core.gaussians import Camera
from normlift_ns.core.scene import View
from normlift_ns.data.frames import check_mask, image_warnings, read_image_header
from normlift_ns.data.images import to_camera
from normlift_ns.data.nerfstudio import config as plain
from normlift_ns.data.nerfstudio.config import dump_config
from normlift_ns.data.nerfstudio.load import image_name
from normlift_ns.errors import InputError
from normlift_ns.io.run_dir import FIELD_FOLDER
from normlift_ns.nerfstudio_plugin.model import NormLiftModelConfig


def read_nerfstudio_config(path: Path) -> TrainerConfig:
    """Read a config.yml into nerfstudio's classes.

    Raises:
        FileNotFoundError, ValueError: as `normlift_ns.data.nerfstudio.config.read_trainer_config`.
    """
    return to_nerfstudio_config(plain.read_trainer_config(path))


def to_nerfstudio_config(config: Any) -> TrainerConfig:
    """Convert a config that normlift_ns has read and checked to nerfstudio's classes."""
    # Loader is safe here: dump_config wrote the text, and it names allowed classes only
    return yaml.load(dump_config(config), Loader=yaml.Loader)


def relocate_config(config: TrainerConfig, config_path: Path, data: Path | None = None) -> TrainerConfig:
    """Return a copy of the config with absolute paths, valid from any directory, and without seed points.

    It also works with stock nerfstudio:
    `eval_setup(path, update_config_callback=lambda config: rerooted(config, path))`.

    Raises:
        FileNotFoundError: as `locate`.
    """
    location = plain.locate_run(config, config_path, data)
    config = plain.with_absolute_paths(config, location)
    model: Any = config.pipeline.model
    if isinstance(model, NormLiftModelConfig) and model.semantics is not None:
        model.semantics = location.run_dir / FIELD_FOLDER
    return config


# Images and cameras of a run as splatfacto trained on them, without lens distortion.


_SUPPORTED_MODES = {"RGB", "RGBA", "L", "CMYK"}
"""Pillow image modes that nerfstudio can train on; CMYK images get wrong colors."""
_SUPPORTED_CAMERAS = {CameraType.PERSPECTIVE.value, CameraType.FISHEYE.value, CameraType.FISHEYE624.value}


class DatasetViews:
    """`Views` of one split of a dataset, in its order. Each image is read and undistorted on access.

    Images, masks and intrinsics equal those of `FullImageDatamanager.cached_train`, which holds all of them in memory
    (and pins that memory, which needs CUDA).

    Args:
        dataset: a split as made by nerfstudio's datamanager; it is not changed.
        folder: folder of the dataset, to which `names` are relative.
        poses: camera-to-world poses [V, 3, 4] in OpenGL convention, of the dataset or as optimized in training.
        background: RGB in 0..1 behind images with an alpha channel.
    """

    def __init__(
        self,
        dataset: InputDataset,
        folder: Path,
        poses: Float[Tensor, "v 3 4"],
        background: Float[Tensor, " 3"],
    ) -> None:
        self._dataset = dataset
        self._poses = poses
        self._background = background
        self.files = list(dataset.image_filenames)
        """Absolute paths of the images."""
        self.names = [image_name(file, folder) for file in self.files]
        """Paths of the images relative to the dataset, with forward slashes."""

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[View]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> View:
        """Read one image with its mask and camera.

        Raises:
            FileNotFoundError, ValueError: a file is missing, cannot be read, or differs in size from its camera; the
                message names it.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        index %= len(self)
        data = self._read(index)
        distorted = data["image"]
        image, _, mask = _undistort(self._dataset.cameras, index, data)
        original = None if image is distorted else (distorted.shape[1], distorted.shape[0])
        if image.shape[2] == 4:
            alpha = image[:, :, 3:].float() / 255
            image = (alpha * image[:, :, :3] + (1 - alpha) * 255 * self._background).round().to(torch.uint8)
        return View(self.cameras[index], image, None if mask is None else mask[:, :, 0], self.names[index], original)

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of all undistorted images; no image is read."""
        return self._cameras

    @cached_property
    def _cameras(self) -> list[Camera]:
        pinholes: dict[tuple[float, ...], tuple[Tensor, int, int]] = {}  # images of one camera share an entry
        return [self._camera(i, pinholes) for i in range(len(self))]

    def _camera(self, index: int, pinholes: dict[tuple[float, ...], tuple[Tensor, int, int]]) -> Camera:
        camera = self._dataset.cameras[index].reshape(())
        parameters = (camera.camera_type, camera.width, camera.height, camera.get_intrinsics_matrices())
        key = tuple(
            float(x) for part in (*parameters, camera.distortion_params) if part is not None for x in part.flatten()
        )
        try:
            if key not in pinholes:
                pinholes[key] = self._pinhole(index)
            return to_camera(self._poses[index], *pinholes[key])
        except InputError as error:
            raise InputError(f"The camera of {self.files[index]} cannot be used: {error}") from error

    def _pinhole(self, index: int) -> tuple[Tensor, int, int]:
        """Return intrinsics, width and height of an image without distortion."""
        camera = self._dataset.cameras[index].reshape(())
        if int(camera.camera_type) not in _SUPPORTED_CAMERAS:
            raise InputError(
                f"{self.files[index]} was taken with a {CameraType(int(camera.camera_type)).name} camera; splatfacto "
                "supports only perspective and fisheye cameras."
            )
        blank = torch.zeros(int(camera.height), int(camera.width), 3, dtype=torch.uint8)
        image, intrinsics, _ = _undistort(self._dataset.cameras, index, {"image": blank})
        return intrinsics, image.shape[1], image.shape[0]

    def check_files(self) -> tuple[str, ...]:
        """Check the file headers of all images and masks; return warnings as whole sentences.

        Raises:
            FileNotFoundError, ValueError: an image or mask is missing, is not a valid image, has pixel values that
                nerfstudio misreads, or differs in size from its camera or image; the message names it.
        """
        heads = [read_image_header(file) for file in self.files]
        masks, scale = self._dataset._dataparser_outputs.mask_filenames, self._dataset.scale_factor
        cameras = self._dataset.cameras
        sizes = torch.stack([cameras.width, cameras.height]).reshape(2, -1).T.tolist() if len(self) > 0 else []
        for index, (file, head) in enumerate(zip(self.files, heads)):
            if head.mode not in _SUPPORTED_MODES:
                raise InputError(
                    f"{file} has the pixel format {head.mode}, whose values nerfstudio misreads. Expected 8-bit RGB, "
                    "RGBA or grayscale; convert the images, and train again."
                )
            size = head.size if scale == 1 else tuple(int(side * scale) for side in head.size)
            self._check_size(index, size, sizes[index])
            if masks is not None:
                check_mask(masks[index], file, head.size)
        return image_warnings(self.files, heads)

    def _check_size(self, index: int, size: Sequence[int], expected: Sequence[int]) -> None:
        if tuple(size) != tuple(expected):
            raise InputError(
                f"{self.files[index]} is {size[0]} x {size[1]} pixels, but its camera has {expected[0]} x "
                f"{expected[1]} (width x height). Use the images that the run was trained with."
            )

    def _read(self, index: int) -> dict[str, Any]:
        file, camera = self.files[index], self._dataset.cameras[index]
        try:
            data = self._dataset.get_data(index, image_type="uint8")
        except FileNotFoundError as error:
            raise FileNotFoundError(
                f"{error.filename} is missing, but the dataset lists it. Put it back, or give the path of the dataset "
                "with --data."
            ) from error
        except Exception as error:  # Pillow's readers and nerfstudio's checks may raise anything
            raise InputError(
                f"{file} or its mask cannot be read ({error}). Expected an 8-bit image; copy it again from the capture."
            ) from error
        self._check_size(index, data["image"].shape[1::-1], (int(camera.width), int(camera.height)))
        return data


def _undistort(
    cameras: Cameras, index: int, data: dict[str, Any]
) -> tuple[UInt8[Tensor, "h w c"], Float[Tensor, "3 3"], Bool[Tensor, "h w 1"] | None]:
    """Return image, intrinsics and mask after nerfstudio's undistortion, as in `FullImageDatamanager`."""
    camera = cameras[index].reshape(())
    intrinsics = camera.get_intrinsics_matrices()
    if camera.distortion_params is None or bool((camera.distortion_params == 0).all()):
        return data["image"], intrinsics, data.get("mask")
    distortion = camera.distortion_params.numpy()
    if int(camera.camera_type) == CameraType.FISHEYE624.value:
        _check_aria(camera, masked="mask" in data)
    try:
        matrix, image, mask = _undistort_image(camera, distortion, data, data["image"].numpy(), intrinsics.numpy())
    except Exception as error:  # OpenCV's errors, and any that nerfstudio raises for invalid coefficients
        raise InputError(f"its distortion {distortion.tolist()} cannot be removed ({error})") from error
    if 0 in image.shape:
        raise InputError(f"removing its distortion {distortion.tolist()} leaves no pixel of the image")
    pinhole = np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
    return torch.from_numpy(np.ascontiguousarray(image)), torch.from_numpy(pinhole).float(), mask


def _check_aria(camera: Cameras, *, masked: bool) -> None:
    """Raise if nerfstudio cannot undistort images of an Aria camera, or would make enormous images of them."""
    if masked:
        raise InputError("nerfstudio cannot undistort images of FISHEYE624 cameras that have masks")
    radius = (camera.metadata or {}).get("fisheye_crop_radius")
    width, height = int(camera.width), int(camera.height)
    if not isinstance(radius, float) or not 0.5 <= radius <= width + height:
        raise InputError(
            f"its fisheye_crop_radius is {radius!r}. Expected the radius, in pixels, of the circle that a FISHEYE624 "
            f"camera sees: a number with a decimal point, from 0.5 to {width + height}"
        )


def nerfstudio_views(
    config: Any, folder: Path, poses: Float[Tensor, "v 3 4"], background: Float[Tensor, " 3"]
) -> tuple[DatasetViews, DatasetViews]:
    """Return the training views and the held-out views of a run that was read without nerfstudio.

    Args:
        config: the run's config with absolute paths.
        folder: folder of the dataset.
        poses: camera-to-world poses of the training views.
        background: RGB in 0..1 behind images with an alpha channel.
    """
    manager: Any = to_nerfstudio_config(config).pipeline.datamanager.setup(
        device="cpu", test_mode="test", world_size=1, local_rank=0
    )
    held_out = manager.eval_dataset
    return (
        DatasetViews(manager.train_dataset, folder, poses, background),
        DatasetViews(held_out, folder, held_out.cameras.camera_to_worlds, background),
    )
