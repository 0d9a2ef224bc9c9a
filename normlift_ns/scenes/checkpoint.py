"""Safe reading of nerfstudio checkpoints, which runs no code from the file."""

from __future__ import annotations

import pickle
import re
import warnings
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.scenes.splat import from_parameters
from normlift_ns.scenes.unpickling import numbers_allowed

GAUSSIAN_PARAMETERS = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")
_PREFIX = "gauss_params."
_MAX_STEP = 10**9


class Checkpoint(NamedTuple):
    """Step and model state of a trained run."""

    path: Path
    step: int
    model: dict[str, Tensor]
    """State of the model on the CPU: gauss_params.* in float32, camera_optimizer.*, …, without optimizers and LPIPS."""


def find_checkpoint(folder: Path, step: int | None = None) -> Path:
    """Return the checkpoint of a step; None: of the last step.

    Raises:
        FileNotFoundError: if there is no checkpoint, or none of that step; the message lists the steps that exist.
    """
    steps = {path: _step_of(path) for path in sorted(folder.glob("step-*.ckpt"))}
    checkpoints = {number: path for path, number in steps.items() if number is not None}
    if not checkpoints:
        raise FileNotFoundError(
            f"No checkpoint in {folder}. Expected a file such as step-000029999.ckpt, which ns-train writes every "
            "--steps-per-save steps and at the end; copy it there, or finish the training."
        )
    if step is None:
        return checkpoints[max(checkpoints)]
    if step not in checkpoints:
        raise FileNotFoundError(
            f"No checkpoint of step {step} in {folder}; it has the steps {', '.join(map(str, sorted(checkpoints)))}. "
            "Give one of them with --load-step, or omit it for the last step."
        )
    return checkpoints[step]


def _step_of(path: Path) -> int | None:
    """Return the step in a file name of nerfstudio's form; None for other names, and for anything but a file."""
    number = path.name.removeprefix("step-").removesuffix(".ckpt")
    return int(number) if path.name == f"step-{number}.ckpt" and number.isdecimal() and path.is_file() else None


def read_checkpoint(path: Path) -> Checkpoint:
    """Read step and model of a splatfacto checkpoint, full or slim; optimizer states stay on disk.

    Gaussians in float16, bfloat16 or float64 become float32, as in nerfstudio. Gaussians that are not finite stay, and
    are never drawn.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is truncated, damaged, not a splatfacto checkpoint or without Gaussians, or its step is
            invalid or differs from its name.
    """
    advice = "give another checkpoint with --load-step"
    loaded = read_tensors(path, "as ns-train splatfacto writes them", advice)
    state = loaded.get("pipeline") if isinstance(loaded, dict) else None
    if not isinstance(state, dict) or "step" not in loaded:
        keys = sorted(map(str, loaded)) if isinstance(loaded, dict) else type(loaded).__name__
        raise InputError(f"{path} is not a nerfstudio checkpoint: expected `step` and `pipeline` in it, found {keys}.")
    step = checked_step(loaded["step"], path)
    model = _model_state(state, path)
    missing = [_PREFIX + name for name in GAUSSIAN_PARAMETERS if _PREFIX + name not in model]
    if missing:
        raise InputError(
            f"{path} does not hold splatfacto Gaussians: {', '.join(missing)} missing. "
            "Train the capture with: ns-train splatfacto --data ..."
        )
    splat = from_parameters({name: model[_PREFIX + name] for name in GAUSSIAN_PARAMETERS}, path)
    return Checkpoint(path, step, model | {_PREFIX + name: value for name, value in splat.parameters.items()})


def checked_step(step: Any, path: Path) -> int:
    """Validate and return a training step.

    Raises:
        ValueError: if the step is not a whole number in range, or not the step in the file name.
    """
    if type(step) is not int or not 0 <= step < _MAX_STEP:  # a bool is not a step
        raise InputError(
            f"{path}: its step is {str(step)[:40]} ({type(step).__name__}), expected a whole number from 0 to "
            f"{_MAX_STEP:,}. Copy it again, or give another checkpoint with --load-step."
        )
    expected = _step_of(path)
    if expected is not None and expected != step:
        raise InputError(
            f"{path} was saved at step {step}, which is not the step in its name. Rename it to step-{step:09d}.ckpt, "
            "or give another checkpoint with --load-step."
        )
    return step


def read_tensors(path: Path, writer: str, advice: str) -> Any:
    """Load a file written by torch.save, memory-mapped on the CPU.

    Only tensors, plain containers and NumPy scalars are unpickled (`weights_only=True` plus the allow-list of
    `unpickling`), so a file from a stranger runs no code.

    Args:
        path: the file.
        writer: clause for error messages that names the writer of such files.
        advice: for error messages, an alternative to copying the file again.
    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is truncated or damaged, or holds other Python objects.
    """
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}. Expected a file written by torch.save; {advice}.")
    _check_archive(path, advice)
    try:
        with numbers_allowed(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "TypedStorage is deprecated")  # torch 2.1 itself uses TypedStorage
            return torch.load(str(path), map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        match = re.search(r"(?:GLOBAL|Unsupported class) (\S+)", str(error))
        raise InputError(
            f"{path} is rejected because it holds Python objects{f' ({match[1]})' if match else ''}: expected only "
            f"tensors and numbers, {writer}. {advice[0].upper()}{advice[1:]}."
        ) from error
    except Exception as error:  # torch does not document its exceptions for files that torch.save did not write
        raise InputError(
            f"{path} is damaged ({str(error).strip().split('. ')[0]}). Copy it again, or {advice}."
        ) from error


def _check_archive(path: Path, advice: str) -> None:
    """Check the sizes and the CRC-32 of every tensor, which torch.load ignores; torch.save never compresses."""
    size = path.stat().st_size
    try:
        if not zipfile.is_zipfile(path):
            raise InputError(
                f"{path} is truncated or not a checkpoint: its {size:,} bytes are not a ZIP archive as torch.save "
                f"writes it. Copy it again, or {advice}."
            )
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            is_compressed = any(entry.compress_type != zipfile.ZIP_STORED for entry in entries)
            if is_compressed or sum(entry.file_size for entry in entries) > size:
                raise InputError(
                    f"{path} declares more content than its {size:,} bytes, or holds compressed entries, which "
                    f"torch.save never writes. Copy it again, or {advice}."
                )
            damage = archive.testzip()
    except InputError:
        raise
    except Exception as error:  # zipfile raises any kind of exception on a damaged file
        damage = str(error)
    if damage is not None:
        raise InputError(
            f"{path} is damaged ({damage}): a checksum does not match its content. Copy it again, or {advice}."
        )


def _model_state(pipeline: dict[Any, Any], path: Path) -> dict[str, Tensor]:
    """Return the model's tensors by their names on one GPU; training on several GPUs prefixes names with `module.`."""
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
            raise InputError(f"{path} holds {rest} twice. Expected every tensor once; copy it again.")
        check_plain(value, rest, path)
        state[rest] = value.detach().clone()
    return state


def check_plain(value: Tensor, name: str, path: Path) -> None:
    """Raise if a tensor would take more memory than it has storage, or is not a plain array of real numbers.

    Raises:
        ValueError: if the tensor is sparse, quantized, complex, nested, not on the CPU or larger than its storage, for
            example because it repeats its content.
    """
    if (
        value.layout != torch.strided
        or value.device.type != "cpu"
        or value.is_quantized
        or value.is_complex()
        or value.is_nested
        or value.numel() * value.element_size() > value.untyped_storage().nbytes()
    ):
        raise InputError(
            f"{path}: {name} is a tensor of {value.dtype}, {value.layout}, {tuple(value.shape)} on {value.device} that "
            "is not stored as a dense array. Expected plain tensors, as trainers save them; save the file again."
        )
