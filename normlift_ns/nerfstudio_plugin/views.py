"""The photographs of a run as splatfacto trained on them: undistorted, with the cameras that belong to them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from nerfstudio.data.datasets.base_dataset import InputDataset
from torch import Tensor

from normlift_ns.core.gaussians import Camera
from normlift_ns.core.scene import View
from normlift_ns.errors import InputError
from normlift_ns.nerfstudio_plugin.config import as_nerfstudios
from normlift_ns.scenes.image_files import check_mask, read_head, remarks
from normlift_ns.scenes.nerfstudio.views import image_name
from normlift_ns.scenes.photographs import to_camera

_READ_WELL = {"RGB", "RGBA", "L", "CMYK"}
"""Kinds of pixels that nerfstudio can be trained on; CMYK in strange colours."""
_DRAWN_AS_PINHOLE = {CameraType.PERSPECTIVE.value, CameraType.FISHEYE.value, CameraType.FISHEYE624.value}


class DatasetViews:
    """`Views`: photographs of one split of a dataset, in its order; each is read and undistorted when it is asked for.

    Images, masks and intrinsics are those of `FullImageDatamanager.cached_train`, which holds all of them in memory
    (and pins that memory, which needs CUDA).

    Args:
        dataset: a split as nerfstudio's datamanager made it; is not changed.
        folder: where the dataset lies, for `names`.
        poses: camera-to-world poses [V, 3, 4] in OpenGL convention; the dataset's, or as the training optimised them.
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
        """Image files, absolute."""
        self.names = [image_name(file, folder) for file in self.files]
        """Image files relative to the dataset, with forward slashes."""

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[View]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> View:
        """Reads one photograph.

        Raises:
            FileNotFoundError, ValueError: a file that is missing, cannot be read or has another size than its camera;
                the message names it.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        index %= len(self)
        data = self._read(index)
        taken = data["image"]
        image, _, mask = _undistorted(self._dataset.cameras, index, data)
        original = None if image is taken else (taken.shape[1], taken.shape[0])
        if image.shape[2] == 4:
            alpha = image[:, :, 3:].float() / 255
            image = (alpha * image[:, :, :3] + (1 - alpha) * 255 * self._background).round().to(torch.uint8)
        return View(self.cameras[index], image, None if mask is None else mask[:, :, 0], self.names[index], original)

    @property
    def cameras(self) -> list[Camera]:
        """All cameras, those of the undistorted images; reads no image."""
        return self._cameras

    @cached_property
    def _cameras(self) -> list[Camera]:
        undistorted: dict[tuple[float, ...], tuple[Tensor, int, int]] = {}  # photographs of one camera share it
        return [self._camera(i, undistorted) for i in range(len(self))]

    def _camera(self, index: int, undistorted: dict[tuple[float, ...], tuple[Tensor, int, int]]) -> Camera:
        camera = self._dataset.cameras[index].reshape(())
        numbers = (camera.camera_type, camera.width, camera.height, camera.get_intrinsics_matrices())
        key = tuple(
            float(x) for part in (*numbers, camera.distortion_params) if part is not None for x in part.flatten()
        )
        try:
            if key not in undistorted:
                undistorted[key] = self._pinhole(index)
            return to_camera(self._poses[index], *undistorted[key])
        except InputError as error:
            raise InputError(f"The camera of {self.files[index]} cannot be used: {error}") from error

    def _pinhole(self, index: int) -> tuple[Tensor, int, int]:
        """Intrinsics, width and height without distortion."""
        camera = self._dataset.cameras[index].reshape(())
        if int(camera.camera_type) not in _DRAWN_AS_PINHOLE:
            raise InputError(
                f"{self.files[index]} was taken with a {CameraType(int(camera.camera_type)).name} camera; splatfacto "
                "draws perspective and fisheye cameras only."
            )
        blank = torch.zeros(int(camera.height), int(camera.width), 3, dtype=torch.uint8)
        image, intrinsics, _ = _undistorted(self._dataset.cameras, index, {"image": blank})
        return intrinsics, image.shape[1], image.shape[0]

    def check_files(self) -> tuple[str, ...]:
        """Looks at the heads of all photographs and masks; returns what a person should know, in whole sentences.

        Raises:
            FileNotFoundError, ValueError: a photograph or mask that is no image, that nerfstudio reads into something
                else, or that has another size than its camera or image; the message names it.
        """
        heads = [read_head(file) for file in self.files]
        masks, scale = self._dataset._dataparser_outputs.mask_filenames, self._dataset.scale_factor
        cameras = self._dataset.cameras
        sizes = torch.stack([cameras.width, cameras.height]).reshape(2, -1).T.tolist() if len(self) > 0 else []
        for index, (file, head) in enumerate(zip(self.files, heads)):
            if head.mode not in _READ_WELL:
                raise InputError(
                    f"{file} has pixels of kind {head.mode}, which nerfstudio takes for other values than they are. "
                    "Expected 8-bit RGB, RGBA or grey; convert the photographs, and train again."
                )
            found = head.size if scale == 1 else tuple(int(side * scale) for side in head.size)
            self._check_size(index, found, sizes[index])
            if masks is not None:
                check_mask(masks[index], file, head.size)
        return remarks(self.files, heads)

    def _check_size(self, index: int, found: Sequence[int], expected: Sequence[int]) -> None:
        if tuple(found) != tuple(expected):
            raise InputError(
                f"{self.files[index]} is {found[0]} x {found[1]} pixels, its camera {expected[0]} x {expected[1]} "
                "(width x height). Use the images that the run was trained with."
            )

    def _read(self, index: int) -> dict[str, Any]:
        file, camera = self.files[index], self._dataset.cameras[index]
        try:
            data = self._dataset.get_data(index, image_type="uint8")
        except FileNotFoundError as error:
            raise FileNotFoundError(
                f"{error.filename} is missing, which the dataset names. Put it back, or say where the dataset is "
                "with --data."
            ) from error
        except Exception as error:  # Pillow's readers and nerfstudio's checks raise whatever a file leads them to
            raise InputError(
                f"{file} or its mask cannot be read ({error}). Expected an 8-bit image; copy it again from the capture."
            ) from error
        self._check_size(index, data["image"].shape[1::-1], (int(camera.width), int(camera.height)))
        return data


def _undistorted(
    cameras: Cameras, index: int, data: dict[str, Any]
) -> tuple[UInt8[Tensor, "h w c"], Float[Tensor, "3 3"], Bool[Tensor, "h w 1"] | None]:
    """Image, intrinsics and mask by nerfstudio's undistortion, as `FullImageDatamanager` does it for every image."""
    camera = cameras[index].reshape(())
    intrinsics = camera.get_intrinsics_matrices()
    if camera.distortion_params is None or bool((camera.distortion_params == 0).all()):
        return data["image"], intrinsics, data.get("mask")
    distortion = camera.distortion_params.numpy()
    if int(camera.camera_type) == CameraType.FISHEYE624.value:
        _check_aria(camera, masked="mask" in data)
    try:
        matrix, image, mask = _undistort_image(camera, distortion, data, data["image"].numpy(), intrinsics.numpy())
    except Exception as error:  # OpenCV's errors, and what nerfstudio makes of the numbers that it gets
        raise InputError(f"its distortion {distortion.tolist()} cannot be undone ({error})") from error
    if 0 in image.shape:
        raise InputError(f"its distortion {distortion.tolist()} leaves no pixel of the image")
    pinhole = np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
    return torch.from_numpy(np.ascontiguousarray(image)), torch.from_numpy(pinhole).float(), mask


def _check_aria(camera: Cameras, *, masked: bool) -> None:
    """Refuses what nerfstudio has no undistortion for, or would make enormous pictures of."""
    if masked:
        raise InputError("nerfstudio undistorts photographs of FISHEYE624 cameras without masks only")
    radius = (camera.metadata or {}).get("fisheye_crop_radius")
    width, height = int(camera.width), int(camera.height)
    if not isinstance(radius, float) or not 0.5 <= radius <= width + height:
        raise InputError(
            f"its fisheye_crop_radius is {radius!r}, where nerfstudio needs the radius in pixels of the circle that a "
            f"FISHEYE624 camera sees: a number with a decimal point, up to {width + height}"
        )


def by_nerfstudio(
    config: Any, folder: Path, poses: Float[Tensor, "v 3 4"], background: Float[Tensor, " 3"]
) -> tuple[DatasetViews, DatasetViews]:
    """Trained and held-out photographs of a run that was read without nerfstudio.

    Args:
        config: with absolute paths.
        poses: of the training views.
    """
    manager: Any = as_nerfstudios(config).pipeline.datamanager.setup(
        device="cpu", test_mode="test", world_size=1, local_rank=0
    )
    held_out = manager.eval_dataset
    return (
        DatasetViews(manager.train_dataset, folder, poses, background),
        DatasetViews(held_out, folder, held_out.cameras.camera_to_worlds, background),
    )
