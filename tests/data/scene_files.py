"""Files of splats and cameras, written as the tools of others write them."""

import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from normlift_ns.data.frames import Frame, Intrinsics
from normlift_ns.data.nerfstudio.load import NerfstudioScene
from normlift_ns.data.open_scene import SplatScene, save_splat, splatfacto_checkpoint
from normlift_ns.data.splat import SplatParameters
from normlift_ns.data.transforms import decompose_similarity

MODELS = {
    "SIMPLE_PINHOLE": (0, "fx cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "fx cx cy k1"),
    "RADIAL": (3, "fx cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 0.01 0 0"),
    "SIMPLE_RADIAL_FISHEYE": (8, "fx cx cy k1"),
    "RADIAL_FISHEYE": (9, "fx cx cy k1 k2"),
    "THIN_PRISM_FISHEYE": (10, "fx fy cx cy k1 k2 0 0 k3 k4 0 0"),
    "SIMPLE_FISHEYE": (14, "fx cx cy"),
    "FISHEYE": (15, "fx fy cx cy"),
}
"""Number and parameters of each camera model of COLMAP."""


def random_splat(n: int = 200, degree: int = 3, seed: int = 0) -> SplatParameters:
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=g)

    rest = normal(n, (degree + 1) ** 2 - 1, 3)
    return SplatParameters(normal(n, 3), normal(n, 4), normal(n, 3) - 4, normal(n, 1), normal(n, 3), rest)


def ply_columns(splat: SplatParameters) -> dict[str, np.ndarray]:
    columns = {name: splat.means[:, i] for i, name in enumerate("xyz")}
    columns |= {name: torch.zeros(len(splat)) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{i}": splat.features_dc[:, i] for i in range(3)}
    k = splat.features_rest.shape[1]
    columns |= {f"f_rest_{c * k + i}": splat.features_rest[:, i, c] for c in range(3) for i in range(k)}
    columns["opacity"] = splat.opacities[:, 0]
    columns |= {f"scale_{i}": splat.scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": splat.quats[:, i] for i in range(4)}
    return {name: value.numpy() for name, value in columns.items()}


def write_ply(path: Path, columns: dict, *, order=None, comments=(), text=False, byte_order="<") -> Path:
    names = list(columns) if order is None else list(order)
    table = np.empty(len(columns[names[0]]), [(name, columns[name].dtype.newbyteorder(byte_order)) for name in names])
    for name in names:
        table[name] = columns[name]
    described = PlyElement.describe(table, "vertex")
    PlyData([described], text=text, byte_order=byte_order, comments=list(comments)).write(str(path))
    return path


def write_gsplat(path: Path, splat: SplatParameters, *, step: int = 29999, **more: object) -> Path:
    splats = {"means": splat.means, "quats": splat.quats, "scales": splat.scales, "opacities": splat.opacities[:, 0]}
    splats |= {"sh0": splat.features_dc[:, None], "shN": splat.features_rest}
    torch.save({"step": step, "splats": splats, **more}, path)
    return path


def saved_run(folder: Path, scene: SplatScene) -> Path:
    content = splatfacto_checkpoint(scene)
    (folder / "nerfstudio_models").mkdir(parents=True)
    torch.save(content, folder / "nerfstudio_models" / f"step-{content['step']:09d}.ckpt")
    save_splat(folder, scene)
    return folder


def rows_of(splat: SplatParameters, rows: slice) -> SplatParameters:
    return SplatParameters(**{name: value[rows] for name, value in splat.parameters.items()})


def frames_of(scene: NerfstudioScene) -> list[Frame]:
    """The cameras of a run whose images have no distortion, in the world of its splat."""
    found = []
    for views in (scene.train, scene.held_out):
        for file, name, camera, pose in zip(views.files, views.names, views.cameras, views._poses):
            (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
            intrinsics = Intrinsics(fx, fy, cx, cy, camera.width, camera.height)
            found.append(Frame(file, name, pose.double().numpy(), intrinsics))
    return found


def in_world(splat: SplatParameters, matrix: np.ndarray) -> SplatParameters:
    """The Gaussians and their colors in another world, computed in float64."""
    from gsplat.cuda._torch_impl import _spherical_harmonics  # noqa: PLC0415 (slow)

    world, degree = decompose_similarity(matrix, "test"), splat.degree
    turn = torch.from_numpy(world.transform[:, :3])
    quats = Rotation.from_matrix(turn.numpy()) * Rotation.from_quat(splat.quats.double().numpy()[:, [1, 2, 3, 0]])
    directions = torch.from_numpy(Rotation.random(64, random_state=0).as_matrix()[:, 0])
    basis = torch.eye((degree + 1) ** 2, dtype=torch.float64)[:, None, :, None].expand(-1, 64, -1, 3)
    here, there = (
        torch.stack([_spherical_harmonics(degree, along, one)[:, 0] for one in basis[1:]], dim=1)
        if degree > 0
        else torch.zeros(64, 0, dtype=torch.float64)
        for along in (directions @ turn, directions)
    )
    change = torch.linalg.lstsq(there, here).solution
    return replace(
        splat,
        means=(world.scale * (splat.means.double() @ turn.T + torch.from_numpy(world.transform[:, 3]))).float(),
        quats=torch.from_numpy(quats.as_quat()[:, [3, 0, 1, 2]]).float(),
        scales=(splat.scales.double() + np.log(world.scale)).float(),
        features_rest=(change @ splat.features_rest.double()).float(),
    )


def camera_parameters(model: str, c: Intrinsics) -> list[float]:
    return [getattr(c, name) if name.isidentifier() else float(name) for name in MODELS[model][1].split()]


def write_colmap(folder: Path, frames: Sequence[Frame], model="OPENCV", *, binary=True, points=None) -> Path:
    """sparse/0 of a COLMAP project, images in another order than their names'; one camera per image."""
    place = folder / "sparse" / "0"
    place.mkdir(parents=True)
    rows = []
    for i, frame in list(enumerate(frames, 1))[::-1]:
        opencv = frame.pose[:, :3] * [1, -1, -1]
        x, y, z, w = Rotation.from_matrix(opencv.T).as_quat()
        rows.append((i, [w, x, y, z], (-opencv.T @ frame.pose[:, 3]).tolist(), Path(frame.name).name, frame.intrinsics))
    points = np.zeros((0, 3)) if points is None else points
    if binary:
        _write_binary(place, rows, model, points)
        return folder
    cameras = [
        f"{i} {model} {c.width} {c.height} " + " ".join(map(repr, map(float, camera_parameters(model, c))))
        for i, _, _, _, c in rows
    ]
    images = [
        line
        for i, q, t, name, _ in rows
        for line in (f"{i} " + " ".join(map(repr, map(float, [*q, *t]))) + f" {i} {name}", "1.0 2.0 -1 3.0 4.0 7")
    ]
    clouds = [f"{i} {x!r} {y!r} {z!r} 10 20 30 0.5 1 2 3 4" for i, (x, y, z) in enumerate(points.tolist(), 1)]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", clouds)):
        (place / f"{name}.txt").write_text("\n".join(["# a comment", "# another", *lines]) + "\n")
    return folder


def _write_binary(place: Path, rows: list, model: str, points: np.ndarray) -> None:
    cameras = images = struct.pack("<Q", len(rows))
    for i, q, t, name, c in rows:
        parameters = camera_parameters(model, c)
        cameras += struct.pack(f"<iiQQ{len(parameters)}d", i, MODELS[model][0], c.width, c.height, *parameters)
        images += struct.pack("<I7dI", i, *q, *t, i) + name.encode() + b"\0"
        images += struct.pack("<Q", 2) + struct.pack("<ddqddq", 1, 2, -1, 3, 4, 7)
    clouds = struct.pack("<Q", len(points))
    for i, place_of in enumerate(points.tolist(), 1):
        clouds += struct.pack("<Q3d3BdQ", i, *place_of, 1, 2, 3, 0.5, 2) + struct.pack("<4i", 1, 2, 3, 4)
    for name, data in (("cameras", cameras), ("images", images), ("points3D", clouds)):
        (place / f"{name}.bin").write_bytes(data)


def in_file_world(frames: Sequence[Frame], matrix: np.ndarray) -> list[Frame]:
    """Frames whose camera file lies in another world: matrix maps that world to theirs."""
    back = np.linalg.inv(matrix)
    scale = np.cbrt(np.linalg.det(back[:3, :3]))
    moved = []
    for frame in frames:
        centre = back[:3, :3] @ frame.pose[:, 3] + back[:3, 3]
        moved.append(replace(frame, pose=np.column_stack([back[:3, :3] / scale @ frame.pose[:, :3], centre])))
    return moved
