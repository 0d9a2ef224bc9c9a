"""Readers for nerfstudio and gsplat checkpoints. They do not execute code from the files."""

from __future__ import annotations

import codecs
import pickle
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.data.splat import (
    GAUSSIAN_PARAMETERS,
    SplatFile,
    SplatParameters,
    check_extra_names,
    splat_from_parameters,
    validate_splat,
)
from normlift_ns.errors import InputError
from normlift_ns.io.guard import check_regular

_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray")  # names in NumPy 1 and NumPy 2


@contextmanager
def allow_numpy_scalars() -> Iterator[None]:
    """Allow `torch.load(weights_only=True)` to read NumPy scalars within a `with` block.

    With torch 2.4, NumPy scalars stay allowed after the block. Earlier versions cannot construct them, and return None
    instead.
    """
    if hasattr(torch.serialization, "safe_globals"):
        with torch.serialization.safe_globals(numpy_scalar_globals()):
            yield
        return
    if hasattr(torch.serialization, "add_safe_globals"):
        torch.serialization.add_safe_globals(numpy_scalar_globals())  # torch 2.4 cannot remove them again
        yield
        return
    allowed: dict[str, Any] = torch._weights_only_unpickler._get_allowed_globals()  # pyrefly: ignore[implicit-import]
    before = dict(allowed)
    allowed |= {"numpy.dtype": _unread_dtype, "_codecs.encode": _latin1}
    allowed |= {f"{module}.scalar": _unread for module in _MODULES}
    try:
        yield
    finally:
        allowed.clear()
        allowed.update(before)


def numpy_scalar_globals() -> list[Any]:
    """Return the types and functions that torch's allow-list needs to unpickle NumPy scalars."""
    rebuild: Any = np.float64(0).__reduce__()[0]
    dtypes = {type(np.dtype(code)) for code in "?bBhHiIlLqQefd"}
    return [
        np.dtype,
        *dtypes,
        _renamed(_latin1, "_codecs", "encode"),
        *(_renamed(rebuild, module, "scalar") for module in _MODULES),
    ]


def _latin1(text: str, encoding: str) -> bytes:
    """Encode text as Latin-1, which pickle uses for bytes; raise UnpicklingError for other encodings.

    Other encodings could expand a small file to gigabytes.
    """
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes in the encoding {encoding}, expected latin1")
    return codecs.latin_1_encode(text)[0]


def _unread(*_: object) -> None:
    """Return None in place of a NumPy scalar."""


def _unread_dtype(*_: object) -> torch.nn.Parameter:
    """Return a parameter in place of a NumPy dtype.

    Before version 2.4, torch calls `__setstate__` only on parameters.
    """
    stand_in: Any = torch.nn.Parameter(torch.empty(0))
    stand_in.__setstate__ = _unread
    return stand_in


def _renamed(function: Callable[..., Any], module: str, name: str) -> Callable[..., Any]:
    """Wrap a function under another module and name, because torch's allow-list compares names."""

    def alias(*args: Any) -> Any:
        return function(*args)

    alias.__module__, alias.__name__, alias.__qualname__ = module, name, name
    return alias


# Safe reading of nerfstudio checkpoints, without executing code from the file.


_PREFIX = "gauss_params."
_MAX_STEP = 10**9


class Checkpoint(NamedTuple):
    """Step and model state of a trained run."""

    path: Path
    step: int
    model: dict[str, Tensor]
    """State of the model on the CPU, without the LPIPS network. The parameters of the Gaussians are in float32."""
    splat: SplatParameters
    """Parameters of the Gaussians, from gauss_params.* in the state."""


def find_checkpoint(folder: Path, step: int | None = None) -> Path:
    """Return the path of the checkpoint of a step, or of the last step if `step` is None.

    Raises:
        FileNotFoundError: The folder has no such checkpoint. The message lists the existing steps, if there are any.
    """
    found = sorted(folder.glob("step-*.ckpt"))
    checkpoints = {number: path for path in found if (number := _step_of(path)) is not None}
    if not checkpoints:
        raise FileNotFoundError(
            f"{folder} has no checkpoint. Expected a file such as step-000029999.ckpt. Copy the whole run again; if "
            "its training ended before the first checkpoint, train again."
        )
    if step is None:
        return checkpoints[max(checkpoints)]
    if step not in checkpoints:
        raise FileNotFoundError(
            f"{folder} has no checkpoint of step {step}. Available steps: "
            f"{', '.join(map(str, sorted(checkpoints)))}. Give one of these steps with --load-step, or omit "
            "--load-step to use the last one."
        )
    return checkpoints[step]


def _step_of(path: Path) -> int | None:
    """Return the step in the name of a checkpoint file; None for other names and for folders."""
    number = path.name.removeprefix("step-").removesuffix(".ckpt")
    return int(number) if path.name == f"step-{number}.ckpt" and number.isdecimal() and path.is_file() else None


def read_checkpoint(path: Path) -> Checkpoint:
    """Read the step and the model of a splatfacto checkpoint, without its optimizer states.

    Parameters in float16, bfloat16 or float64 become float32, as in nerfstudio. Gaussians with values that are not
    finite are kept, but never rendered.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is damaged, contains no Gaussians or is not a splatfacto checkpoint. Also if the step is
            invalid or differs from the step in the file name.
    """
    advice = "give another checkpoint with --load-step"
    loaded = load_torch_archive(path, "as ns-train splatfacto writes them", advice)
    state = loaded.get("pipeline") if isinstance(loaded, dict) else None
    if not isinstance(state, dict) or "step" not in loaded:
        keys = sorted(map(str, loaded)) if isinstance(loaded, dict) else type(loaded).__name__
        raise InputError(
            f"{path} is not a nerfstudio checkpoint: found {keys}, expected `step` and `pipeline`. Give another "
            "checkpoint with --load-step."
        )
    step = validate_step(loaded["step"], path)
    model = _model_state(state, path)
    missing = [_PREFIX + name for name in GAUSSIAN_PARAMETERS if _PREFIX + name not in model]
    if missing:
        raise InputError(
            f"{path} does not contain splatfacto Gaussians (missing: {', '.join(missing)}). Give another checkpoint "
            "with --load-step, or lift a PLY file of the scene with --load-ply."
        )
    known = {*GAUSSIAN_PARAMETERS, "normals"}
    extra = (name.removeprefix(_PREFIX) for name in model if name.startswith(_PREFIX))
    check_extra_names((name for name in extra if name not in known), path)
    splat = splat_from_parameters({name: model[_PREFIX + name] for name in GAUSSIAN_PARAMETERS}, path)
    return Checkpoint(path, step, model | {_PREFIX + name: value for name, value in splat.parameters.items()}, splat)


def validate_step(step: Any, path: Path) -> int:
    """Validate and return the training step of a checkpoint.

    Raises:
        ValueError: The step is not a whole number from 0 to 999,999,999, or differs from the step in the file name.
    """
    step = int(step) if isinstance(step, np.integer) else step
    if type(step) is not int or not 0 <= step < _MAX_STEP:  # a bool is not a step
        raise InputError(
            f"{path}: its step is {str(step)[:40]} ({type(step).__name__}), expected a whole number from 0 to "
            f"{_MAX_STEP - 1:,}. Copy it again, or give another checkpoint."
        )
    expected = _step_of(path)
    if expected is not None and expected != step:
        raise InputError(
            f"{path} was saved at step {step}, but its name has another step. Rename it to step-{step:09d}.ckpt, or "
            "give another checkpoint with --load-step."
        )
    return step


def load_torch_archive(path: Path, writer: str, advice: str) -> Any:
    """Load a file written by torch.save, memory-mapped on the CPU.

    The function unpickles only tensors, plain containers and NumPy scalars, so an untrusted file cannot execute code.
    It uses `weights_only=True` with `allow_numpy_scalars`.

    Args:
        path: File to load.
        writer: Clause that names the program that writes such files, for error messages.
        advice: Alternative to copying the file again, for error messages.
    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is truncated or damaged, or contains other Python objects.
    """
    if not path.is_file():
        raise FileNotFoundError(f"The file {path} does not exist. Expected a file written by torch.save; {advice}.")
    check_regular(path)
    _check_archive(path, advice)
    try:
        with allow_numpy_scalars(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "TypedStorage is deprecated")  # torch 2.1 itself uses TypedStorage
            return torch.load(str(path), map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        match = re.search(r"(?:GLOBAL|Unsupported class) (\S+)", str(error))
        raise InputError(
            f"{path} is rejected because it contains Python objects{f' ({match[1]})' if match else ''}. Expected only "
            f"tensors and numbers, {writer}. {advice[0].upper()}{advice[1:]}."
        ) from error
    except Exception as error:  # torch does not document its exceptions for files that torch.save did not write
        raise InputError(
            f"{path} is damaged ({str(error).strip().split('. ')[0]}). Copy it again, or {advice}."
        ) from error


def _check_archive(path: Path, advice: str) -> None:
    """Raise InputError unless a file is a ZIP archive with valid sizes and CRC-32 checksums, as torch.save writes it.

    torch.load checks neither sizes nor checksums. Compressed entries are invalid, because torch.save never compresses.
    """
    size = path.stat().st_size
    try:
        if not zipfile.is_zipfile(path):
            raise InputError(
                f"{path} is truncated or not a checkpoint: its {size:,} bytes are not a ZIP archive of torch.save. "
                f"Copy it again, or {advice}."
            )
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            is_compressed = any(entry.compress_type != zipfile.ZIP_STORED for entry in entries)
            if is_compressed or sum(entry.file_size for entry in entries) > size:
                problem = (
                    "contains compressed entries" if is_compressed else f"declares more content than its {size:,} bytes"
                )
                raise InputError(f"{path} {problem}, unlike files of torch.save. Copy it again, or {advice}.")
            wrong = archive.testzip()
            damage = None if wrong is None else f"the checksum of {wrong} does not match its content"
    except InputError:
        raise
    except Exception as error:  # zipfile raises any kind of exception on a damaged file
        damage = str(error)
    if damage is not None:
        raise InputError(f"{path} is damaged ({damage}). Copy it again, or {advice}.")


def _model_state(pipeline: dict[Any, Any], path: Path) -> dict[str, Tensor]:
    """Return the tensors of the model, except those of the LPIPS network, by name.

    The prefixes `_model.` and `module.` are removed from the names. Training on several GPUs adds `module.`.
    """
    state: dict[str, Tensor] = {}
    for name, value in pipeline.items():
        if not isinstance(name, str):
            raise InputError(
                f"{path}: `pipeline` has the key {str(name)[:40]} ({type(name).__name__}), expected tensor names. "
                "Copy it again, or give another checkpoint with --load-step."
            )
        _, model, rest = name.removeprefix("module.").partition("_model.")
        rest = rest.removeprefix("module.")
        if not model or not isinstance(value, Tensor) or rest.startswith("lpips."):
            continue
        if rest in state:
            raise InputError(f"{path} contains {rest} twice, expected every tensor once. Give another checkpoint.")
        check_dense_tensor(value, rest, path)
        state[rest] = value.detach().clone()
    return state


def check_dense_tensor(value: Tensor, name: str, path: Path) -> None:
    """Raise unless a tensor is a dense array of real numbers on the CPU.

    Raises:
        ValueError: The tensor is sparse, quantized, complex, nested, not on the CPU or larger than its storage. An
            expanded tensor, for example, is larger than its storage.
    """
    if (
        value.layout != torch.strided
        or value.device.type != "cpu"
        or value.is_quantized
        or value.is_complex()
        or value.is_nested
        or value.numel() * value.element_size() > value.untyped_storage().nbytes()
    ):
        size = "" if value.layout != torch.strided else f", stored bytes {value.untyped_storage().nbytes():,}"
        raise InputError(
            f"{path}: the tensor {name} cannot be used (type {value.dtype}, layout {value.layout}, shape "
            f"{tuple(value.shape)}, device {value.device}{size}), expected a dense array of real numbers on the CPU "
            "with all values stored. Save the file again with tensor.cpu().contiguous()."
        )


_RANK = re.compile(r"(ckpt_\d+_rank)(\d+)(\.pt)")
_ADVICE = "give another file with --load-gsplat"
_GSPLAT_NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN")


def read_gsplat_checkpoint(path: Path) -> SplatFile:
    """Read ckpt_<step>_rank<r>.pt, and the files of all other ranks if the training used several GPUs.

    Raises:
        FileNotFoundError: The file, or the file of another rank, does not exist.
        ValueError: A file is damaged, comes from another trainer or training run, or needs an appearance network, or
            the Gaussians cannot be rendered.
    """
    files = _rank_files(path)
    loaded = [_read_rank(file) for file in files]
    splats = [splat_from_parameters(rank.parameters, file) for file, rank in zip(files, loaded)]
    steps = {rank.step for rank in loaded}
    if len(steps) > 1 or len({splat.degree for splat in splats}) > 1:
        differing = (
            f"steps: {', '.join(map(str, sorted(steps)))}" if len(steps) > 1 else "degrees of spherical harmonics"
        )
        raise InputError(
            f"{files[0].parent} has ranks with different {differing}. "
            "Expected the files of one training run. Copy these files to a separate folder."
        )
    names = splats[0].parameters
    merged = SplatParameters(**{name: torch.cat([splat.parameters[name] for splat in splats]) for name in names})
    validate_splat(merged, files[0])
    first = loaded[0]
    return SplatFile(merged, None, steps.pop(), first.pose_adjust, by_gsplat=True, remarks=first.remarks)


def _rank_files(path: Path) -> tuple[Path, ...]:
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is not a file. With --load-gsplat, give a checkpoint of gsplat's simple_trainer, for example "
            "results/garden/ckpts/ckpt_29999_rank0.pt."
        )
    match = _RANK.fullmatch(path.name)
    if match is None:
        return (path,)
    ranks = {
        int(other[2]): file
        for file in sorted(path.parent.iterdir())
        if (other := _RANK.fullmatch(file.name)) is not None and other[1] == match[1] and file.is_file()
    }
    if max(ranks) >= len(ranks):
        missing = next(rank for rank in range(len(ranks)) if rank not in ranks)
        raise FileNotFoundError(
            f"{path.parent} has {match[1]}* up to rank {max(ranks)}, but not rank {missing}. Every "
            "rank contains a part of the Gaussians. Copy all files of the training run."
        )
    return tuple(ranks[rank] for rank in sorted(ranks))


class _Rank(NamedTuple):
    """Contents of the file of one GPU."""

    step: int
    parameters: dict[str, Tensor]
    """Parameters of the Gaussians, by splatfacto's names."""
    pose_adjust: Float[Tensor, "v 9"] | None
    remarks: tuple[str, ...]
    """Messages about parameters that are ignored."""


def _read_rank(path: Path) -> _Rank:
    loaded = load_torch_archive(path, "as gsplat's simple_trainer writes them", _ADVICE)
    splats = _splats(path, loaded)
    remarks = check_extra_names((str(name) for name in splats if name not in _GSPLAT_NAMES), path)
    for name in _GSPLAT_NAMES:
        check_dense_tensor(splats[name], name, path)
    if splats["sh0"].ndim != 3 or splats["sh0"].shape[1:] != (1, 3) or splats["opacities"].ndim != 1:
        raise InputError(
            f"{path}: sh0 has shape {tuple(splats['sh0'].shape)} and opacities {tuple(splats['opacities'].shape)}, "
            "expected (N, 1, 3) and (N,). Give another file with --load-gsplat."
        )
    parameters = {name: splats[name] for name in ("means", "quats", "scales")}
    parameters["opacities"] = splats["opacities"][:, None]
    parameters["features_dc"], parameters["features_rest"] = splats["sh0"][:, 0], splats["shN"]
    return _Rank(validate_step(loaded.get("step", 0), path), parameters, _pose_adjust(path, loaded), remarks)


def _splats(path: Path, loaded: Any) -> Mapping[str, Tensor]:
    """Return the `splats` of a checkpoint; raise InputError unless they are 3D Gaussians with spherical harmonics."""
    splats = loaded.get("splats") if isinstance(loaded, Mapping) else None
    if not isinstance(splats, Mapping):
        keys = sorted(map(str, loaded)) if isinstance(loaded, Mapping) else type(loaded).__name__
        hint = "Give a file of gsplat's simple_trainer"
        if "pipeline" in keys:
            hint = "For a nerfstudio run, give its config.yml with --load-config"
        elif isinstance(loaded, tuple):
            hint = "For Inria's trainer, give point_cloud/iteration_…/point_cloud.ply with --load-ply"
        raise InputError(f"{path} is not a gsplat checkpoint: expected tensors in `splats`, found {keys}. {hint}.")
    if "app_module" in loaded:
        raise InputError(
            f"{path} contains an appearance network, `app_module` (--app_opt), which computes the colors of its "
            "Gaussians. Train the scene again without --app_opt. Or export a PLY file with the trainer's --save_ply, "
            "and give it with --load-ply."
        )
    missing = [name for name in _GSPLAT_NAMES if name not in splats]
    if missing or not all(isinstance(value, Tensor) for value in splats.values()):
        problem = f"no {', '.join(missing)}" if missing else "values that are not tensors"
        raise InputError(
            f"{path} has {problem} in `splats`, which contains "
            f"{', '.join(sorted(map(str, splats))) or 'nothing'}. Expected 3D Gaussians with spherical harmonics. Give "
            "a file of gsplat's simple_trainer with --load-gsplat."
        )
    return splats


def _pose_adjust(path: Path, loaded: Mapping[str, Any]) -> Float[Tensor, "v 9"] | None:
    state = loaded.get("pose_adjust")
    if state is None:
        return None
    deltas = state.get("embeds.weight") if isinstance(state, Mapping) else None
    if isinstance(deltas, Tensor):
        check_dense_tensor(deltas, "pose_adjust", path)
    if not isinstance(deltas, Tensor) or deltas.ndim != 2 or deltas.shape[1] != 9 or not bool(deltas.isfinite().all()):
        raise InputError(
            f"{path}: `pose_adjust` is not valid. Expected embeds.weight with finite numbers of shape (views, 9), as "
            f"written by gsplat's --pose_opt; {_ADVICE}."
        )
    return deltas.double()
