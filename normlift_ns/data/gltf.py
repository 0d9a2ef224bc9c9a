"""Reader for glTF files (.gltf and .glb) with the extension KHR_gaussian_splatting, and encoder for GLB files.

https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args
from urllib.parse import unquote

import msgspec
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.core.gaussians import SH_C0
from normlift_ns.data.compressed_ply import normalize_quats, opacity_logits, to_bytes
from normlift_ns.data.frames import WorldTransform
from normlift_ns.data.splat import SplatFile, SplatParameters, splat_from_parameters, transform_splat, validate_splat
from normlift_ns.data.spz import decode_spz
from normlift_ns.data.transforms import decompose_similarity
from normlift_ns.errors import InputError
from normlift_ns.io.guard import MAX_TEXT_BYTES, open_regular, read_file
from normlift_ns.options import RasterizeMode

GLB_MAGIC = b"glTF"
_EXTENSION = "KHR_gaussian_splatting"
_SPZ_EXTENSIONS = (f"{_EXTENSION}_compression_spz_2", f"{_EXTENSION}_compression_spz")
_KNOWN = {_EXTENSION, *_SPZ_EXTENSIONS, "KHR_mesh_quantization"}
"""Extensions that a file may require."""
_INSTANCING = "EXT_mesh_gpu_instancing"
_SETTINGS = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_SIZES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_MIN_SCALE = 1e-30
_MAX_DEGREE = 3


class _Accessor(msgspec.Struct, rename="camel"):
    component_type: int
    count: int
    type: str
    buffer_view: int | None = None
    byte_offset: int = 0
    normalized: bool = False
    sparse: dict[str, Any] | None = None


class _BufferView(msgspec.Struct, rename="camel"):
    buffer: int
    byte_length: int
    byte_offset: int = 0
    byte_stride: int | None = None


class _Buffer(msgspec.Struct, rename="camel"):
    byte_length: int
    uri: str | None = None


class _Primitive(msgspec.Struct, rename="camel"):
    attributes: dict[str, int]
    extensions: dict[str, dict[str, Any]] = {}


class _Mesh(msgspec.Struct, rename="camel"):
    primitives: list[_Primitive]
    extras: Any = None


class _Node(msgspec.Struct, rename="camel"):
    mesh: int | None = None
    children: list[int] = []
    matrix: Annotated[list[float], msgspec.Meta(min_length=16, max_length=16)] | None = None
    """4 x 4 matrix in column-major order, which replaces rotation, scale and translation."""
    rotation: tuple[float, float, float, float] = (0, 0, 0, 1)
    """Quaternion (x, y, z, w)."""
    scale: tuple[float, float, float] = (1, 1, 1)
    translation: tuple[float, float, float] = (0, 0, 0)
    extensions: dict[str, Any] = {}


class _Document(msgspec.Struct, rename="camel"):
    asset: dict[str, Any]
    accessors: list[_Accessor] = []
    buffer_views: list[_BufferView] = []
    buffers: list[_Buffer] = []
    meshes: list[_Mesh] = []
    nodes: list[_Node] = []
    extensions_required: list[str] = []


class _Gltf(NamedTuple):
    """Document of a glTF file and the contents of its buffers."""

    path: Path
    document: _Document
    buffers: list[bytes]


def read_gltf(path: Path) -> SplatFile:
    """Read the splat of a glTF file, and apply the transforms of its node and of all ancestors of the node.

    The splat may be compressed as SPZ (KHR_gaussian_splatting_compression_spz_2).

    Raises:
        FileNotFoundError: The file, or the file of a buffer, does not exist.
        ValueError: The file is damaged or not a glTF file with exactly one splat. Also if it needs an unsupported
            extension or setting, places the splat several times or by a transform that is not a similarity, or has
            Gaussians that cannot be rendered.
    """
    if not path.is_file():
        raise FileNotFoundError(f"The glTF file {path} does not exist. Give an existing file with --load-ply.")
    gltf = _open_gltf(path)
    index, primitive = _find_splat(gltf)
    extension = primitive.extensions[_EXTENSION]
    for name, expected in _SETTINGS.items():
        found = extension.get(name, expected)
        if found != expected:
            raise InputError(
                f"{path} has a splat with {name} {str(found)[:40]!r}, expected {expected!r}. Export the splat with "
                "the expected setting, or as a PLY file."
            )
    compressed = next((extension["extensions"][n] for n in _SPZ_EXTENSIONS if n in _nested(extension)), None)
    if compressed is not None:
        view = compressed.get("bufferView") if isinstance(compressed, dict) else None
        return _placed(gltf, index, decode_spz(bytes(_view_bytes(gltf, view)[1]), path))
    splat, extras = _read_attributes(gltf, primitive), gltf.document.meshes[index].extras
    validate_splat(splat, path)
    mode = extras.get("rasterize_mode") if isinstance(extras, dict) else None  # as written by `encode_glb`
    return _placed(gltf, index, SplatFile(splat, mode if mode in get_args(RasterizeMode) else None))


def _placed(gltf: _Gltf, mesh: int, file: SplatFile) -> SplatFile:
    """Apply the transforms of the nodes to the splat of a mesh."""
    world = _world_transform(gltf, mesh)
    if world.scale == 1 and np.array_equal(world.transform, np.eye(3, 4)):
        return file
    remark = f"The transforms of the nodes of {gltf.path.name} are applied to the splat (scale {world.scale:.6g})."
    return file._replace(splat=transform_splat(file.splat, world), remarks=(*file.remarks, remark))


def _world_transform(gltf: _Gltf, mesh: int) -> WorldTransform:
    """Return the transform from a mesh to its scene; raise InputError for several instances, or for a transform that is
    not a similarity."""
    path, nodes, matrix = gltf.path, gltf.document.nodes, np.eye(4)
    holders = [number for number, node in enumerate(nodes) if node.mesh == mesh]
    if len(holders) > 1 or any(_INSTANCING in nodes[number].extensions for number in holders):
        raise InputError(f"{path} has several instances of its splat, expected one. Export one of them, or a PLY file.")
    parents = {child: number for number, node in enumerate(nodes) for child in node.children}
    number = holders[0] if holders else None
    for _ in nodes:
        if number is not None:
            with np.errstate(all="ignore"):  # numbers that are too large are reported below
                matrix = _local_matrix(path, nodes[number]) @ matrix
            number = parents.get(number)
    if number is not None:
        raise _damaged(path, "a node is its own parent or ancestor")
    try:
        return decompose_similarity(matrix, f"The transform of the splat in {path}")
    except InputError as error:
        raise InputError(
            f"{error} Apply the transform in the program that wrote the file, or export a PLY file."
        ) from error


def _local_matrix(path: Path, node: _Node) -> Float[np.ndarray, "4 4"]:
    """Return the matrix from a node to its parent."""
    if node.matrix is not None:
        return np.array(node.matrix, dtype=np.float64).reshape(4, 4).T
    if not any(node.rotation):
        raise _damaged(path, "the rotation of a node is zero")
    matrix = np.eye(4)
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow import)

    matrix[:3, :3] = Rotation.from_quat(node.rotation).as_matrix() * node.scale
    matrix[:3, 3] = node.translation
    return matrix


def _nested(extension: Mapping[str, Any]) -> Mapping[str, Any]:
    nested = extension.get("extensions", {})
    return nested if isinstance(nested, dict) else {}


def _open_gltf(path: Path) -> _Gltf:
    """Read the JSON document and the buffers of a glTF or GLB file."""
    with open_regular(path) as file:
        is_glb = file.read(4) == GLB_MAGIC
    text, binary = _glb_chunks(path) if is_glb else (read_file(path), b"")
    try:
        document = msgspec.json.decode(text, type=_Document)
    except msgspec.ValidationError as error:
        raise InputError(
            f"{path} is JSON that does not match the schema of glTF ({error}). Expected a glTF file with a splat; "
            "export one, or a PLY file."
        ) from error
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise _damaged(path, f"its JSON cannot be read ({error})") from error
    if not str(document.asset.get("version", "")).startswith("2."):
        raise InputError(
            f"{path} has glTF version {str(document.asset.get('version'))[:20]}, expected 2.0. Export glTF 2.0."
        )
    unknown = sorted(set(document.extensions_required) - _KNOWN)
    if len(unknown) > 0:
        raise InputError(
            f"{path} requires unsupported extensions: {', '.join(unknown)[:200]}. Export it without them, or as a PLY "
            "file."
        )
    return _Gltf(path, document, [_buffer_bytes(path, buffer, binary) for buffer in document.buffers])


def _damaged(path: Path, problem: str) -> InputError:
    return InputError(f"{path} is truncated or damaged: {problem}. Expected a glTF file; copy it again.")


def _glb_chunks(path: Path) -> tuple[bytes, bytes]:
    """Return the JSON chunk and the binary chunk of a GLB file; empty bytes for a missing chunk."""
    with open_regular(path) as file:
        size = path.stat().st_size
        header = file.read(_HEADER.size)
        if len(header) < _HEADER.size or _HEADER.unpack(header)[2] > size:
            raise _damaged(path, f"its header does not match its {size:,} bytes")
        if (version := _HEADER.unpack(header)[1]) != 2:
            raise InputError(f"{path} has GLB version {version}, expected 2. Export glTF 2.0.")
        chunks = {}
        while len(head := file.read(_CHUNK.size)) == _CHUNK.size:
            length, kind = _CHUNK.unpack(head)
            limit = MAX_TEXT_BYTES if kind == b"JSON" else size
            if length > min(limit, size - file.tell()):
                raise _damaged(path, f"a chunk declares {length:,} bytes, which is too many")
            if kind in (b"JSON", b"BIN\0") and kind not in chunks:
                chunks[kind] = file.read(length)
            else:
                file.seek(length, 1)
    return chunks.get(b"JSON", b""), chunks.get(b"BIN\0", b"")


def _find_splat(gltf: _Gltf) -> tuple[int, _Primitive]:
    """Return the mesh index and the primitive of the only splat in a file."""
    primitives = [(index, item) for index, mesh in enumerate(gltf.document.meshes) for item in mesh.primitives]
    splats = [(index, primitive) for index, primitive in primitives if _EXTENSION in primitive.extensions]
    if len(splats) != 1:
        raise InputError(
            f"{gltf.path} must have exactly one splat ({_EXTENSION}), found {len(splats)} (primitives of any kind: "
            f"{len(primitives)}). "
            f"{'Export the splat, not a mesh.' if len(splats) == 0 else 'Export each splat to a separate file.'}"
        )
    return splats[0]


def _read_attributes(gltf: _Gltf, primitive: _Primitive) -> SplatParameters:
    def read(name: str, size: int) -> Tensor:
        index = primitive.attributes.get(name)
        if index is None:
            raise InputError(f"{gltf.path}: the splat has no attribute {name}. Export the scene again.")
        return torch.from_numpy(_read_accessor(gltf, index, name, size))

    opacity, scales = read(f"{_EXTENSION}:OPACITY", 1), read(f"{_EXTENSION}:SCALE", 3)
    if bool((scales < 0).any()) or bool(((opacity < 0) | (opacity > 1)).any()):
        raise InputError(
            f"{gltf.path} has scales between {float(scales.min()):.3g} and {float(scales.max()):.3g}, and opacities "
            f"between {float(opacity.min()):.3g} and {float(opacity.max()):.3g}. Expected linear scales >= 0, and "
            f"opacities in 0..1, as the final version of {_EXTENSION} stores them. Export the scene again."
        )
    degree = max((d for d in range(1, _MAX_DEGREE + 1) if _harmonic(d, 0) in primitive.attributes), default=0)
    rest = [read(_harmonic(d, i), 3) for d in range(1, degree + 1) for i in range(2 * d + 1)]
    if any(len(x) != len(scales) for x in rest):
        raise _damaged(gltf.path, "its spherical harmonics and scales differ in their number of rows")
    parameters = {
        "means": read("POSITION", 3),
        "quats": read(f"{_EXTENSION}:ROTATION", 4).roll(1, dims=1),
        "scales": scales.clamp(min=_MIN_SCALE).log(),
        "opacities": opacity_logits(opacity),
        "features_dc": read(_harmonic(0, 0), 3),
        "features_rest": torch.stack(rest, dim=1) if degree > 0 else torch.zeros(len(scales), 0, 3),
    }
    return splat_from_parameters(parameters, gltf.path)


def _harmonic(degree: int, index: int) -> str:
    return f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"


def _read_accessor(gltf: _Gltf, index: int, name: str, size: int) -> Float[np.ndarray, "n c"]:
    """Return the numbers of an accessor as float32; normalized integers are scaled to 0..1 or -1..1."""
    accessor, kind = _find_accessor(gltf, index, name, size)
    view, data = _view_bytes(gltf, accessor.buffer_view)
    dtype = np.dtype(kind)
    stride = dtype.itemsize * size if view.byte_stride is None else view.byte_stride
    end = accessor.byte_offset + (accessor.count - 1) * stride + dtype.itemsize * size
    if accessor.count < 1 or accessor.byte_offset < 0 or stride < dtype.itemsize * size or end > len(data):
        raise _damaged(
            gltf.path, f"the number of rows of {name}, {accessor.count:,}, does not match its {len(data):,} bytes"
        )
    shape, strides = (accessor.count, size), (stride, dtype.itemsize)
    values = np.ndarray(shape, dtype, data, accessor.byte_offset, strides).astype(np.float32)
    return np.maximum(values / np.iinfo(dtype).max, -1) if accessor.normalized and dtype.kind != "f" else values


def _find_accessor(gltf: _Gltf, index: int, name: str, size: int) -> tuple[_Accessor, str]:
    """Return a dense accessor that has rows of `size` numbers, and the NumPy type of these numbers."""
    accessors = gltf.document.accessors
    accessor = accessors[index] if 0 <= index < len(accessors) else None
    if accessor is not None and (accessor.sparse is not None or accessor.buffer_view is None):
        raise InputError(
            f"{gltf.path} has {name} in an accessor that is sparse or has no data, expected a dense one. Export the "
            "splat without sparse accessors, or as a PLY file."
        )
    kind = None if accessor is None else _TYPES.get(accessor.component_type)
    if accessor is None or kind is None or _SIZES.get(accessor.type) != size:
        raise _damaged(
            gltf.path, f"the accessor of {name} is missing, or its type is not valid (expected numbers per row: {size})"
        )
    return accessor, kind


def _view_bytes(gltf: _Gltf, index: object) -> tuple[_BufferView, memoryview]:
    """Return a buffer view and its bytes."""
    views, buffers = gltf.document.buffer_views, gltf.buffers
    view = views[index] if isinstance(index, int) and 0 <= index < len(views) else None
    if view is None or not 0 <= view.buffer < len(buffers):
        raise _damaged(gltf.path, f"its buffer view {str(index)[:20]}, or the buffer of this view, is missing")
    data = memoryview(buffers[view.buffer])
    if view.byte_offset < 0 or view.byte_length < 0 or view.byte_offset + view.byte_length > len(data):
        raise _damaged(gltf.path, f"a buffer view extends beyond its buffer of {len(data):,} bytes")
    return view, data[view.byte_offset : view.byte_offset + view.byte_length]


def _buffer_bytes(path: Path, buffer: _Buffer, binary: bytes) -> bytes:
    """Return the bytes of a buffer, which come from the binary chunk, a data URI, or a file next to the glTF file."""
    if buffer.uri is None:
        return binary
    head, comma, text = buffer.uri.partition(",")
    if head.startswith("data:") and comma:
        try:
            return base64.b64decode(text, validate=True)
        except (binascii.Error, ValueError) as error:
            raise _damaged(path, f"a data URI is not base64 ({error})") from error
    name = unquote(buffer.uri)
    file = path.parent / name
    if "/" in name or "\\" in name or "\0" in name or file.name != name:
        raise InputError(
            f"{path} has the buffer {buffer.uri[:80]!r}, expected the name of a file in the same folder. Export it as "
            "a GLB file."
        )
    if not file.is_file():
        raise FileNotFoundError(f"{path.name} needs the file {file}, which does not exist. Copy it to this path.")
    return read_file(file, max_bytes=max(buffer.byte_length, 0) + 3)


def encode_glb(
    splat: SplatParameters, columns: Mapping[str, Float[np.ndarray, " n"]], extras: Mapping[str, Any]
) -> bytes:
    """Encode Gaussians as a GLB file, without changing their coordinates. Attributes are float32, except COLOR_0.

    Args:
        splat: Finite Gaussians. Spherical harmonics of degree 4 are left out.
        columns: Further attributes, with names that begin with an underscore.
        extras: `extras` of the mesh, with JSON types only. `read_gltf` reads the key "rasterize_mode".
    """
    values = {name: value.detach().cpu().double() for name, value in splat.parameters.items()}
    colors = (values["features_dc"] * SH_C0 + 0.5).clamp(0, 1)
    linear = torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)  # COLOR_0 is linear
    opacities = values["opacities"].sigmoid()
    attributes = {
        "POSITION": values["means"].float().numpy(),
        "COLOR_0": to_bytes(torch.cat([linear, opacities], dim=1) * 255),
        f"{_EXTENSION}:ROTATION": normalize_quats(values["quats"]).roll(-1, dims=1).float().numpy(),
        f"{_EXTENSION}:SCALE": values["scales"].exp().float().numpy(),
        f"{_EXTENSION}:OPACITY": opacities.float().numpy(),
        _harmonic(0, 0): values["features_dc"].float().numpy(),
    }
    names = [_harmonic(d, i) for d in range(1, min(splat.degree, _MAX_DEGREE) + 1) for i in range(2 * d + 1)]
    attributes |= {name: values["features_rest"][:, i].float().numpy() for i, name in enumerate(names)}
    attributes |= {name: column.astype(np.float32)[:, None] for name, column in columns.items()}
    arrays = [np.ascontiguousarray(value, value.dtype.newbyteorder("<")) for value in attributes.values()]
    document = _document(attributes, extras)
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(array.tobytes() for array in arrays)  # the size of every row is a multiple of 4 bytes
    total = _HEADER.size + 2 * _CHUNK.size + len(text) + len(binary)
    parts = (_HEADER.pack(GLB_MAGIC, 2, total), _CHUNK.pack(len(text), b"JSON"), text)
    return b"".join([*parts, _CHUNK.pack(len(binary), b"BIN\0"), binary])


def _document(attributes: Mapping[str, np.ndarray], extras: Mapping[str, Any]) -> dict[str, Any]:
    views, accessors, offset = [], [], 0
    kinds = {size: kind for kind, size in _SIZES.items()}
    for i, (name, value) in enumerate(attributes.items()):
        is_byte = value.dtype == np.uint8
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": value.nbytes, "target": _ARRAY_BUFFER})
        accessor = {"bufferView": i, "componentType": _BYTE if is_byte else _FLOAT, "count": len(value)}
        accessor |= {"type": kinds[value.shape[1]]} | ({"normalized": True} if is_byte else {})
        if name == "POSITION":
            accessor |= {"min": value.min(axis=0).tolist(), "max": value.max(axis=0).tolist()}
        accessors.append(accessor)
        offset += value.nbytes
    primitive = {
        "attributes": {name: i for i, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {_EXTENSION: _SETTINGS},
    }
    return {
        "asset": {"version": "2.0", "generator": "normlift_ns"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive], "extras": extras}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
