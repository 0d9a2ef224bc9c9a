"""Parameters of a trained splat, their validation and transformation, and the reader for PLY files."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from plyfile import PlyData, PlyElement, PlyHeaderParseError, PlyParseError
from torch import Tensor

from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.data.compressed_ply import PACKED, unpack_compressed_ply
from normlift_ns.data.frames import WorldTransform
from normlift_ns.errors import InputError
from normlift_ns.io.guard import file_kind, open_regular
from normlift_ns.options import Primitive, RasterizeMode
from normlift_ns.rasterization.rasterize import rotate_harmonics

SH_DEGREES = {0: 0, 3: 1, 8: 2, 15: 3, 24: 4}
"""Degree of the spherical harmonics, by the number of coefficients without the constant one."""
_MAX_MEDIAN_WIDTH = 0.02
"""Largest plausible median width of the Gaussians, as a fraction of the extent of the scene.

If the median is larger and no log scale is negative, the file probably contains linear scales.
"""

_COLUMNS = {
    "means": ("x", "y", "z"),
    "features_dc": tuple(f"f_dc_{i}" for i in range(3)),
    "opacities": ("opacity",),
    "scales": tuple(f"scale_{i}" for i in range(3)),
    "quats": tuple(f"rot_{i}" for i in range(4)),
}
"""PLY properties of the columns of each parameter. The higher spherical harmonics are left out."""
_DTYPES = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_SAMPLE_SIZE, _BLOCK_ROWS = 2**20, 2**18
_MIN_LOGITS = 100
"""Minimum number of Gaussians for the check that their opacities are logits, not numbers in 0..1."""


@dataclass(frozen=True)
class SplatParameters:
    """Raw parameters of Gaussians, as trainers store them."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    """Rotations as (w, x, y, z)."""
    scales: Float[Tensor, "n 3"]
    """Logarithms of the standard deviations."""
    opacities: Float[Tensor, "n 1"]
    """Logits of the opacities."""
    features_dc: Float[Tensor, "n 3"]
    """Coefficients of the constant spherical harmonic of the colors."""
    features_rest: Float[Tensor, "n k 3"]
    """Coefficients of the other spherical harmonics, with K = 0, 3, 8, 15 or 24."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Tensors of all parameters, by the names that splatfacto uses."""
        return {name: getattr(self, name) for name in GAUSSIAN_PARAMETERS}

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return SH_DEGREES[self.features_rest.shape[1]]

    @cached_property
    def activated(self) -> GaussianScene:
        """Gaussians with activated scales and opacities, as rasterizers use them."""
        return GaussianScene(self.means, self.quats, self.scales.exp(), self.opacities.sigmoid().squeeze(-1))


GAUSSIAN_PARAMETERS = tuple(item.name for item in fields(SplatParameters))


def validate_splat(splat: SplatParameters, file: Path) -> None:
    """Raise if a rasterizer cannot draw the Gaussians.

    Raises:
        ValueError: The splat has no Gaussians, values are not finite, or all rotations are zero. Also if the scales are
            probably not logarithms, or the opacities of 100 or more Gaussians are probably not logits.
    """
    if len(splat) == 0:
        raise InputError(f"{file} contains no Gaussians. Export the scene again.")
    activated = splat.activated  # logits and logarithms may be infinite
    geometry = {"means": splat.means, "rotations": splat.quats, "scales": activated.scales}
    colors = (("opacities", activated.opacities), ("colors", splat.features_dc), ("colors", splat.features_rest))
    for name, values in (*geometry.items(), *colors):
        blocks = values.reshape(len(splat), -1).split(_BLOCK_ROWS)
        invalid = torch.cat([~block.isfinite().all(dim=1) for block in blocks]).nonzero()
        if len(invalid) > 0:
            raise InputError(
                f"{file} has Gaussians with {name} that are NaN or infinite ({len(invalid):,} of {len(splat):,}, the "
                f"first is in row {int(invalid[0])}). Expected finite numbers. For a PLY file, you can remove these "
                f"Gaussians with: splat-transform {file.name} --filter-nan clean.ply"
            )
    lengths = splat.quats.abs().amax(dim=1)
    if bool((lengths == 0).all()):
        raise InputError(f"{file} has only zero quaternions, expected rotations. Export the scene again.")
    low, high = float(splat.opacities.min()), float(splat.opacities.max())
    if len(splat) >= _MIN_LOGITS and low >= 0 and high <= 1:
        raise InputError(
            f"{file} seems to contain opacities (between {low:.3g} and {high:.3g}), expected their logits. Store "
            "log(opacity / (1 - opacity)), as all splat trainers do."
        )
    sample = splat.means[:: max(1, len(splat) // _SAMPLE_SIZE)]
    left, right = sample.quantile(0.05, dim=0), sample.quantile(0.95, dim=0)
    extent, width = float((right - left).amax()), float(splat.scales.median().exp())
    if bool((splat.scales >= 0).all()) and extent > 0 and width > _MAX_MEDIAN_WIDTH * extent:
        raise InputError(
            f"{file} seems to contain linear scales, between {float(splat.scales.min()):.3g} and "
            f"{float(splat.scales.max()):.3g}. As logarithms, they make the median Gaussian {width:.3g} wide in a "
            f"scene of {extent:.3g}. Expected natural logarithms. Store log(scale), as all splat trainers do."
        )


def splat_from_parameters(parameters: Mapping[str, Tensor], file: Path) -> SplatParameters:
    """Check the types and shapes of a trainer's tensors, and return them as a float32 splat.

    Args:
        parameters: Tensors by splatfacto's names.
        file: File of the tensors, for error messages.
    Raises:
        ValueError: The splat has no Gaussians, or a tensor has the wrong shape or is not float16, bfloat16, float32 or
            float64.
    """
    n = len(parameters["means"]) if parameters["means"].ndim > 0 else 0
    if parameters["means"].ndim == 2 and n == 0:
        raise InputError(f"{file} contains no Gaussians. Give the file of another training run.")
    for name, columns in _COLUMNS.items():
        value, shape = parameters[name], (n, len(columns))
        if tuple(value.shape) != shape or value.dtype not in _DTYPES:
            raise InputError(
                f"{file}: {name} is {value.dtype} {tuple(value.shape)}, expected floating-point numbers of shape "
                f"{shape}, one row per Gaussian. Copy the file again, or give the file of another training run."
            )
    rest = parameters["features_rest"]
    is_valid = rest.ndim == 3 and rest.shape[::2] == (n, 3) and rest.shape[1] in SH_DEGREES and rest.dtype in _DTYPES
    if not is_valid:
        raise InputError(
            f"{file}: its spherical harmonics have shape {tuple(rest.shape)} and type {rest.dtype}, expected "
            f"floating-point numbers of shape ({n}, K, 3) with K = {', '.join(map(str, SH_DEGREES))} for degrees "
            f"{', '.join(map(str, SH_DEGREES.values()))}. Copy the file again, or give the file of another run."
        )
    return SplatParameters(**{name: parameters[name].detach().float() for name in GAUSSIAN_PARAMETERS})


class SplatFile(NamedTuple):
    """Contents of a splat file."""

    splat: SplatParameters
    rasterize_mode: RasterizeMode | None = None
    """Rasterize mode of the training; None if unknown."""
    step: int = 0
    """Training step; 0 if unknown."""
    pose_adjust: Float[Tensor, "v 9"] | None = None
    """Pose adjustments of the training views by gsplat's --pose_opt: 3 numbers for translation, 6 for rotation."""
    by_gsplat: bool = False
    """True if gsplat's simple_trainer wrote the file, and may have normalized the world of the cameras."""
    test_every: int | None = None
    """Interval n if the training held out every n-th image; None if unknown."""
    remarks: tuple[str, ...] = ()
    """Messages about the file, such as rounding errors of a compressed format."""
    primitive: Primitive | None = None
    """Primitive of the training, 3D or 2D Gaussians; None if unknown."""
    clip_planes: tuple[float, float] | None = None
    """Near and far planes of the training in world units; None if unknown, or the same as in splatfacto."""


_FLATNESS = math.log(1e-3)
"""Logarithm of the ratio of the thickness of a 2D Gaussian to its smaller standard deviation."""


def flatten_splat(splat: SplatParameters) -> SplatParameters:
    """Return 2D Gaussians as thin 3D ones, for viewers and file formats that support only 3D Gaussians."""
    in_plane = splat.scales[:, :2]
    return replace(splat, scales=torch.cat([in_plane, in_plane.amin(dim=1, keepdim=True) + _FLATNESS], dim=1))


_OTHER_PRIMITIVES = re.compile(
    r"(?P<betas>betas?|sb_params.*)|(?P<shapes>shapes?(_\d+)?)|(?P<moving>trbf_.*|motion_.*|omega_.*|velocit.*|"
    r"t|time|scales?_t|rot_r_\d+|t_scale)|(?P<networks>f_offset_.*|f_anchor_.*|app_.*)"
)
"""Names of parameters of unsupported primitives; the groups are the keys of `_KINDS`."""
_KINDS = {
    "betas": "Beta kernels",
    "shapes": "generalized exponentials",
    "moving": "moving Gaussians",
    "networks": "Gaussians that a network generates",
}
_UNUSED = ("nx", "ny", "nz", "red", "green", "blue")
_FILTER = "filter_3D"


def check_extra_names(names: Iterable[str], file: Path) -> tuple[str, ...]:
    """Return a tuple with a message that lists ignored parameters; an empty tuple if there are none.

    Raises:
        ValueError: A parameter belongs to a primitive other than 3D Gaussians.
    """
    names = list(names)
    for match in filter(None, map(_OTHER_PRIMITIVES.fullmatch, names)):
        raise InputError(
            f"{file} has the parameter {match[0]}, but {_KINDS[match.lastgroup or '']} are not supported. Export 3D "
            "Gaussians from the program that wrote the file, and give the new file with --load-ply."
        )
    if len(names) == 0:
        return ()
    listed = ", ".join(names)[:200]
    return (f"{file.name} has parameters that are ignored, because they should not affect renders: {listed}.",)


_MAX_HEADER_BYTES, _MAX_LINE_BYTES = 2**20, 2**16
_PLY_BLOCK_ROWS = 2**18
"""Number of Gaussians read at a time."""
_MODES: dict[str, RasterizeMode] = {
    "mip": "antialiased", "antialiased": "antialiased", "classic": "classic", "default": "classic",
}  # fmt: skip


def read_ply(path: Path) -> SplatFile:
    """Read a splat from a PLY file, which may be compressed.

    Properties may be in any order. Unknown properties are ignored, except those of other primitives. The property
    filter_3D is applied to scales and opacities, as in Mip-Splatting. For a plain file without filter_3D, peak memory
    is slightly more than one copy of the Gaussians.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is not a PLY file, is truncated, does not contain a splat, or has Gaussians that cannot be
            rendered. The number of spherical harmonics must match a degree.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"The PLY file {path} does not exist. Give the file of a trained splat with --load-ply."
        )
    check_ply_header(path)
    data = _parse_ply(path)
    vertex = next((element for element in data.elements if element.name == "vertex"), None)
    if vertex is None or vertex.count == 0:
        found = ", ".join(f"{element.count:,} {element.name}" for element in data.elements)[:200] or "none"
        raise InputError(f"{path} has no Gaussians (its elements: {found}). Give the PLY file of a trained splat.")
    mode = _mode([*data.comments, *vertex.comments])
    if any(item.name == PACKED for item in vertex.properties):
        parameters, rounding = unpack_compressed_ply(data, path)
        splat = splat_from_parameters(parameters, path)
        validate_splat(splat, path)
        return SplatFile(splat, mode, remarks=(rounding,))
    is_2d = _check_properties(path, vertex)
    rest = _rest_names(path, {item.name for item in vertex.properties})
    splat, mode = _read_columns(path, vertex.data, rest, is_2d), _mode([*data.comments, *vertex.comments])
    remarks = _remarks(path, vertex, rest, _mode_names([*data.comments, *vertex.comments]))
    if any(item.name == _FILTER for item in vertex.properties):
        widths = torch.from_numpy(np.ascontiguousarray(vertex.data[_FILTER]).astype(np.float64))
        splat, mode = _apply_filter(splat, widths, path), mode or "antialiased"
        remarks += (
            f"{path.name} has filter_3D, the 3D filter of Mip-Splatting, which is applied to scales and opacities. The "
            "2D filter of Mip-Splatting has a variance of 0.1 square pixels; the rasterize mode antialiased uses 0.3.",
        )
    validate_splat(splat, path)
    return SplatFile(splat, mode, primitive="2dgs" if is_2d else None, remarks=remarks)


def _remarks(path: Path, vertex: PlyElement, rest: list[str], modes: list[str]) -> tuple[str, ...]:
    """Return messages about unknown properties and rasterize modes, or raise the errors of `check_extra_names`."""
    known = {*(name for group in _COLUMNS.values() for name in group), *rest, *_UNUSED, _FILTER}
    remarks = check_extra_names([item.name for item in vertex.properties if item.name not in known], path)
    unknown = [name for name in modes if name.lower() not in _MODES]
    if len(unknown) > 0:
        remarks += (f"{path.name} has the unknown SplatRenderMode {unknown[0][:40]}, which is ignored.",)
    return remarks


def _apply_filter(splat: SplatParameters, widths: Float[Tensor, " n"], path: Path) -> SplatParameters:
    """Convolve Gaussians with isotropic Gaussians of standard deviations `widths`, as Mip-Splatting does.

    The opacity is divided by the factor by which the volume grows.
    """
    if not bool((widths.isfinite() & (widths >= 0)).all()):
        raise InputError(f"{path}: filter_3D has invalid values, expected finite numbers >= 0. Export the scene again.")
    before = splat.scales.double()
    scales = (before.mul(2).exp() + widths[:, None].square()).log() / 2
    growth = (before - scales).nan_to_num(nan=0.0).sum(dim=1, keepdim=True)  # NaN: a flat Gaussian without a filter
    shrunk = splat.opacities.double().sigmoid() * growth.exp()
    return replace(splat, scales=scales.float(), opacities=shrunk.logit().float())


class _PlainHeader(io.FileIO):
    """PLY file that is read with a changed header of the same length, so that plyfile can parse it.

    Bytes outside ASCII become question marks. Lines of obj_info, which some programs write after the properties, become
    comments.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        head, end, _ = super().read(_MAX_HEADER_BYTES).partition(b"end_header")
        head = bytes(byte if byte < 128 else 63 for byte in head + end)  # 63: a question mark
        self._plain = re.sub(rb"(?<=[\r\n])obj_info(?=[ \t\r\n])", b"comment ", head)
        self.seek(0)

    def read(self, size: int | None = -1, /) -> bytes:
        start, data = self.tell(), super().read(-1 if size is None else size)
        plain = self._plain[start : start + len(data)]
        return plain + data[len(plain) :]


def _parse_ply(path: Path) -> PlyData:
    """Parse the header of a PLY file, and memory-map its binary data."""
    try:
        with _PlainHeader(path) as stream:
            return PlyData.read(stream, mmap="c")
    except PlyHeaderParseError as error:
        if file_kind(path) != ".ply":
            raise _not_ply(path, error) from error
        raise InputError(
            f"{path} has a header that is damaged or not of PLY 1.0 ({' '.join(str(error).split())[:200]}). Copy it "
            "again, or export it with another program."
        ) from error
    except (PlyParseError, ValueError, OSError, EOFError, MemoryError, OverflowError) as error:
        if file_kind(path) == ".ply":
            raise InputError(
                f"{path} is truncated or damaged ({' '.join(str(error).split())}): its {path.stat().st_size:,} bytes "
                "do not match its header. Copy it again."
            ) from error
        raise _not_ply(path, error) from error


def _not_ply(path: Path, error: Exception) -> InputError:
    return InputError(
        f"{path} cannot be read as a PLY file ({' '.join(str(error).split())}). Expected a splat in PLY format; "
        "to convert other formats, run for example: splat-transform scene.sog scene.ply"
    )


def _check_properties(path: Path, vertex: PlyElement) -> bool:
    """Return True for 2D Gaussians, which have two scales; raise InputError if properties are missing or lists."""
    names = {item.name for item in vertex.properties}
    required = [name for columns in _COLUMNS.values() for name in columns]
    missing = [name for name in required if name not in names]
    is_2d = missing == ["scale_2"] and _FILTER not in names
    if missing and not is_2d:
        raise InputError(
            f"{path} is not a splat: its vertices lack {', '.join(missing)}. Expected the properties "
            f"x y z, f_dc_*, f_rest_*, opacity, scale_* and rot_*; found "
            f"{', '.join([item for item in sorted(names) if not item.startswith('f_rest_')][:16])}. {_advice(missing)}"
        )
    lists = [item.name for item in vertex.properties if item.name in required and hasattr(item, "len_dtype")]
    if lists:
        raise InputError(f"{path} is not a splat: expected one number per Gaussian, found lists ({', '.join(lists)}).")
    return is_2d


def check_ply_header(path: Path) -> None:
    """Raise if a PLY file is too small for the rows that its header declares, before memory is allocated for them.

    Raises:
        ValueError: The header is invalid, is longer than 1 MiB, has a line longer than 64 KiB, or declares more data
            than the file contains.
    """
    size = path.stat().st_size
    with open_regular(path) as file:
        header, end, _ = file.read(_MAX_HEADER_BYTES).partition(b"end_header")
    lines = header.replace(b"\r", b"\n").split(b"\n")
    if header.startswith(b"ply") and (end == b"" or max(map(len, lines)) > _MAX_LINE_BYTES):
        raise InputError(
            f"{path} is truncated or damaged: its header does not end within {_MAX_HEADER_BYTES:,} bytes, or it has "
            f"a line of more than {_MAX_LINE_BYTES:,} bytes. Expected a complete PLY file; copy it again."
        )
    lines = [line.split() for line in lines]
    starts = [i for i, words in enumerate(lines) if words[:1] == [b"element"]]
    declared = 0
    for start, end in zip(starts, [*starts[1:], len(lines)]):
        words, properties = lines[start], sum(other[:1] == [b"property"] for other in lines[start:end])
        count = words[2] if len(words) == 3 else b""
        if not count.isdigit() or len(count) > 18 or (properties == 0 and int(count) > 0):
            text = b" ".join(words)[:80].decode("latin1")
            raise InputError(
                f"{path} is truncated or damaged: its header has the line {text!r} (number of properties: "
                f"{properties}). Expected a complete PLY file; copy it again."
            )
        declared += int(count) * properties  # each property takes at least one byte
    if declared > size:
        raise InputError(
            f"{path} is truncated or damaged: its header declares {declared:,} numbers, but the file has only "
            f"{size:,} bytes. Copy it again."
        )


def _advice(missing: list[str]) -> str:
    if all(name.startswith("f_dc_") for name in missing):
        return "Its colors are not spherical harmonics. Export the splat again with f_dc_*."
    return "Give the PLY file that the trainer or ns-export gaussian-splat wrote, not the initial point cloud."


def _rest_names(path: Path, names: set[str]) -> list[str]:
    """Return the names f_rest_0, f_rest_1, …, or raise InputError if they do not match a degree."""
    count = sum(name.startswith("f_rest_") for name in names)
    expected = [f"f_rest_{i}" for i in range(count)]
    if count % 3 != 0 or count // 3 not in SH_DEGREES or not set(expected) <= names:
        counts = ", ".join(f"{3 * k} (degree {degree})" for k, degree in SH_DEGREES.items())
        raise InputError(
            f"{path} has properties f_rest_* ({count}) that do not match a degree of spherical harmonics. Expected "
            f"f_rest_0, f_rest_1, … with one of the counts {counts}. Export the scene again."
        )
    return expected


def _read_columns(path: Path, table: np.ndarray, rest: list[str], is_2d: bool) -> SplatParameters:
    n, k = len(table), len(rest) // 3
    columns = {name: torch.empty(n, len(group)) for name, group in _COLUMNS.items()}
    harmonics = torch.empty(n, k, 3)
    for start, rows in _blocks(path, table):
        for name, group in _COLUMNS.items():
            for i, column in enumerate(group[:2] if is_2d and name == "scales" else group):
                columns[name].numpy()[start : start + len(rows), i] = rows[column]
        for i, column in enumerate(rest):  # all coefficients of red, then green, then blue
            harmonics.numpy()[start : start + len(rows), i % k, i // k] = rows[column]
    splat = SplatParameters(**columns, features_rest=harmonics)
    return flatten_splat(splat) if is_2d else splat


def _blocks(path: Path, table: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Yield blocks of rows, each with the index of its first row.

    The function reads blocks instead of mapping them, because mapped pages count as memory of the process.
    """
    with open_regular(path) as file:
        is_mapped = isinstance(table, np.memmap)
        if isinstance(table, np.memmap):
            file.seek(table.offset)
        for start in range(0, len(table), _PLY_BLOCK_ROWS):
            count = min(_PLY_BLOCK_ROWS, len(table) - start)
            yield start, np.fromfile(file, table.dtype, count) if is_mapped else table[start : start + count]


def _mode(comments: list[str]) -> RasterizeMode | None:
    """Return the rasterize mode in the comment SplatRenderMode; None without this comment or for unknown values."""
    return next((_MODES.get(value.lower()) for value in _mode_names(comments)), None)


def _mode_names(comments: list[str]) -> list[str]:
    pairs = [comment.partition(":") for comment in comments]
    return [value.strip() for key, _, value in pairs if key.strip().lower() == "splatrendermode"]


def transform_splat(splat: SplatParameters, world: WorldTransform) -> SplatParameters:
    """Return the splat in another world, computed in float64. Its spherical harmonics rotate with the Gaussians."""
    rotation, translation = (torch.from_numpy(part) for part in np.split(world.transform, [3], axis=1))
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow import)

    x, y, z, w = Rotation.from_matrix(rotation.numpy()).as_quat()
    product = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64)
    return replace(
        splat,
        means=((splat.means.double() @ rotation.T + translation.T) * world.scale).float(),
        quats=(splat.quats.double() @ product.T).float(),
        scales=(splat.scales.double() + np.log(world.scale)).float(),
        features_rest=rotate_harmonics(splat.features_rest, rotation),
    )
