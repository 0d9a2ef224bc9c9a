"""Images and cameras of a run, read and undistorted by nerfstudio itself. This module imports nerfstudio."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from jaxtyping import Bool, Float, UInt8
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from nerfstudio.data.datasets.base_dataset import InputDataset
from torch import Tensor

from normlift_ns.data.images import SplitViews, camera_type_error
from normlift_ns.data.nerfstudio.config import dump_config
from normlift_ns.data.transforms import relative_name
from normlift_ns.errors import InputError

_SUPPORTED_CAMERAS = {CameraType.PERSPECTIVE.value, CameraType.FISHEYE.value, CameraType.FISHEYE624.value}


class DatasetViews(SplitViews):
    """Views of a split of a dataset, read and undistorted by nerfstudio.

    Args:
        dataset: Split from nerfstudio's data manager. The views do not change it.
        folder: Folder of the dataset, the base of the relative `names`.
        poses, background: As in `SplitViews`.
    """

    def __init__(
        self,
        dataset: InputDataset,
        folder: Path,
        poses: Float[Tensor, "v 3 4"],
        background: Float[Tensor, " 3"],
    ) -> None:
        files, masks = dataset.image_filenames, dataset._dataparser_outputs.mask_filenames
        sides = torch.stack([dataset.cameras.width, dataset.cameras.height])
        sizes = sides.reshape(2, -1).T.tolist() if len(files) > 0 else []
        names = [relative_name(file, folder) for file in files]
        super().__init__(files, names, masks, sizes, poses, background, dataset.scale_factor)
        self._dataset = dataset
        self._pinholes: dict[tuple[float, ...], tuple[Tensor, int, int]] = {}
        """Cache of undistorted cameras by their parameters, because most images share a camera."""

    def _pinhole(self, index: int) -> tuple[Float[Tensor, "3 3"], int, int]:
        camera = self._dataset.cameras[index].reshape(())
        parameters = (camera.camera_type, camera.width, camera.height, camera.get_intrinsics_matrices())
        key = tuple(
            float(x) for part in (*parameters, camera.distortion_params) if part is not None for x in part.flatten()
        )
        if key not in self._pinholes:
            if int(camera.camera_type) not in _SUPPORTED_CAMERAS:
                raise InputError(camera_type_error(self.files[index], CameraType(int(camera.camera_type)).name))
            blank = torch.zeros(int(camera.height), int(camera.width), 3, dtype=torch.uint8)
            image, intrinsics, _ = _undistort(self._dataset.cameras, index, {"image": blank})
            self._pinholes[key] = intrinsics, image.shape[1], image.shape[0]
        return self._pinholes[key]

    def _load(self, index: int) -> tuple[UInt8[Tensor, "h w c"], Bool[Tensor, "h w 1"] | None]:
        data = self._dataset.get_data(index, image_type="uint8")
        return data["image"], data.get("mask")

    def _undistort(self, index: int, image: Any, mask: Any) -> tuple[Tensor, Bool[Tensor, "h w"] | None, bool]:
        data = {"image": image} if mask is None else {"image": image, "mask": mask}
        pixels, _, values = _undistort(self._dataset.cameras, index, data)
        return pixels, None if values is None else values[:, :, 0], pixels is not image


def _undistort(
    cameras: Cameras, index: int, data: dict[str, Any]
) -> tuple[UInt8[Tensor, "h w c"], Float[Tensor, "3 3"], Bool[Tensor, "h w 1"] | None]:
    """Return the image, camera matrix and mask after the undistortion of nerfstudio's `FullImageDatamanager`."""
    camera = cameras[index].reshape(())
    intrinsics = camera.get_intrinsics_matrices()
    if camera.distortion_params is None or bool((camera.distortion_params == 0).all()):
        return data["image"], intrinsics, data.get("mask")
    distortion = camera.distortion_params.numpy()
    if int(camera.camera_type) == CameraType.FISHEYE624.value:
        _check_aria(camera, masked="mask" in data)
    try:
        matrix, image, mask = _undistort_image(camera, distortion, data, data["image"].numpy(), intrinsics.numpy())
    except Exception as error:  # OpenCV and nerfstudio raise different exceptions for invalid coefficients
        raise InputError(f"the distortion {distortion.tolist()} cannot be removed ({error})") from error
    if 0 in image.shape:
        raise InputError(f"the image has no pixels after its distortion {distortion.tolist()} is removed")
    pinhole = np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
    return torch.from_numpy(np.ascontiguousarray(image)), torch.from_numpy(pinhole).float(), mask


def _check_aria(camera: Cameras, *, masked: bool) -> None:
    """Raise InputError if nerfstudio cannot undistort the images of an Aria camera, or if they would become huge."""
    if masked:
        raise InputError("nerfstudio cannot undistort FISHEYE624 images with masks; remove the masks from the dataset")
    radius = (camera.metadata or {}).get("fisheye_crop_radius")
    width, height = int(camera.width), int(camera.height)
    if not isinstance(radius, float) or not 0.5 <= radius <= width + height:
        raise InputError(
            f"the fisheye_crop_radius is {radius!r}. Expected the radius in pixels of the image circle of a FISHEYE624 "
            f"camera, a number with a decimal point in 0.5..{width + height}"
        )


def nerfstudio_views(
    config: Any, folder: Path, poses: Float[Tensor, "v 3 4"], background: Float[Tensor, " 3"]
) -> tuple[DatasetViews, DatasetViews]:
    """Open the dataset of a run with nerfstudio, and return its training views and its held-out views.

    Args:
        config: Config of the run with absolute paths.
        folder: Folder of the dataset.
        poses: Camera-to-world poses of the training views.
        background: Color behind images with an alpha channel, RGB in 0..1.
    """
    # Loader is safe here: dump_config wrote the text, which contains allowed classes only
    datamanager = yaml.load(dump_config(config.pipeline.datamanager), Loader=yaml.Loader)
    manager = datamanager.setup(device="cpu", test_mode="test", world_size=1, local_rank=0)
    held_out = manager.eval_dataset
    return (
        DatasetViews(manager.train_dataset, folder, poses, background),
        DatasetViews(held_out, folder, held_out.cameras.camera_to_worlds, background),
    )
