"""nerfstudio's checkpoints: reading them without running what they contain."""

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
_GAUSSIANS = "gauss_params."
_MOST_STEPS = 10**9


class Checkpoint(NamedTuple):
    """What a trained run has learned."""

    path: Path
    step: int
    model: dict[str, Tensor]
    """State of the model on the CPU: gauss_params.* in float32, camera_optimizer.*, …, without optimizers and LPIPS."""


def find_checkpoint(folder: Path, step: int | None = None) -> Path:
    """The checkpoint of one step, or of the last one.

    Raises:
        FileNotFoundError: no checkpoint there, or none of that step; the message lists the steps there are.
    """
    steps = {path: _step_of(path) for path in sorted(folder.glob("step-*.ckpt"))}
    found = {number: path for path, number in steps.items() if number is not None}
    if not found:
        raise FileNotFoundError(
            f"No checkpoint in {folder}. Expected step-000029999.ckpt or the like, which ns-train writes every "
            "--steps-per-save steps and at the end; copy it there or train the capture to its end."
        )
    if step is None:
        return found[max(found)]
    if step not in found:
        raise FileNotFoundError(
            f"No checkpoint of step {step} in {folder}; it has the steps {', '.join(map(str, sorted(found)))}. "
            "Give one of them with --load-step, or none for the last."
        )
    return found[step]


def _step_of(path: Path) -> int | None:
    """As nerfstudio names its checkpoints; None for files of other names, and for what is no file."""
    number = path.name.removeprefix("step-").removesuffix(".ckpt")
    return int(number) if path.name == f"step-{number}.ckpt" and number.isdecimal() and path.is_file() else None


def read_checkpoint(path: Path) -> Checkpoint:
    """Reads step and model of a splatfacto checkpoint, full or slim; the optimizers' state stays on disk.

    Gaussians in half precision, bfloat16 or float64 become float32, as where nerfstudio loads them. Those that are not
    finite stay, and are never drawn.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a truncated or damaged file, other content, a step that is no step or another than the name of the
            file says, not the Gaussians of splatfacto, or none at all.
    """
    advice = "give another checkpoint with --load-step"
    loaded = read_tensors(path, "as ns-train splatfacto writes them", advice)
    state = loaded.get("pipeline") if isinstance(loaded, dict) else None
    if not isinstance(state, dict) or "step" not in loaded:
        keys = sorted(map(str, loaded)) if isinstance(loaded, dict) else type(loaded).__name__
        raise InputError(f"{path} is no nerfstudio checkpoint: expected `step` and `pipeline` in it, found {keys}.")
    step = checked_step(loaded["step"], path)
    model = _model_state(state, path)
    missing = [name for name in GAUSSIAN_PARAMETERS if _GAUSSIANS + name not in model]
    if missing:
        raise InputError(
            f"{path} has no Gaussians of splatfacto: {_GAUSSIANS}{f', {_GAUSSIANS}'.join(missing)} missing. "
            "Train the capture with: ns-train splatfacto --data ..."
        )
    splat = from_parameters({name: model[_GAUSSIANS + name] for name in GAUSSIAN_PARAMETERS}, path)
    return Checkpoint(path, step, model | {_GAUSSIANS + name: value for name, value in splat.parameters.items()})


def checked_step(step: Any, path: Path) -> int:
    """The step of a training.

    Raises:
        ValueError: no whole number, a negative or an absurd one, or not that of the file's name.
    """
    if type(step) is not int or not 0 <= step < _MOST_STEPS:  # a bool is no number of steps
        raise InputError(
            f"{path}: its step is {str(step)[:40]} ({type(step).__name__}), expected a whole number from 0 to "
            f"{_MOST_STEPS:,}. Copy it again, or give another checkpoint with --load-step."
        )
    named = _step_of(path)
    if named is not None and named != step:
        raise InputError(
            f"{path} was saved at step {step}, which is not the one in its name. Rename it to step-{step:09d}.ckpt, or "
            "give another checkpoint with --load-step."
        )
    return step


def read_tensors(path: Path, writer: str, advice: str) -> Any:
    """What torch.save wrote, memory-mapped on the CPU.

    Only tensors, plain containers and numpy's numbers are unpickled (`weights_only=True` plus the allow-list below), so
    that a file from a stranger runs no code.

    Args:
        writer, advice: parts of messages: who writes such files, and what to do besides copying the file again.
    Raises:
        FileNotFoundError: no such file.
        ValueError: a truncated or damaged file, or one that holds other Python objects.
    """
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}. Expected what torch.save writes; {advice}.")
    _check_sums(path, advice)
    try:
        with numbers_allowed(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "TypedStorage is deprecated")  # torch 2.1 warns of what it does itself
            return torch.load(str(path), map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        found = re.search(r"(?:GLOBAL|Unsupported class) (\S+)", str(error))
        raise InputError(
            f"{path} is not read, because it holds Python objects{f' ({found[1]})' if found else ''}: only tensors and "
            f"numbers are expected, {writer}. {advice[0].upper()}{advice[1:]}."
        ) from error
    except Exception as error:  # what torch makes of numbers and names that no torch.save wrote is not documented
        raise InputError(
            f"{path} is damaged ({str(error).strip().split('. ')[0]}). Copy it again, or {advice}."
        ) from error


def _check_sums(path: Path, advice: str) -> None:
    """The archive has a CRC-32 of every tensor, which torch.load does not look at; torch.save compresses nothing."""
    size = path.stat().st_size
    try:
        if not zipfile.is_zipfile(path):
            raise InputError(
                f"{path} is truncated or no checkpoint: its {size:,} bytes are not the zip archive that torch.save "
                f"writes. Copy it again, or {advice}."
            )
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            packed = any(entry.compress_type != zipfile.ZIP_STORED for entry in entries)
            if packed or sum(entry.file_size for entry in entries) > size:
                raise InputError(
                    f"{path} says that it holds more than its {size:,} bytes, or holds compressed entries, which "
                    f"torch.save never writes. Copy it again, or {advice}."
                )
            damaged = archive.testzip()
    except InputError:
        raise
    except Exception as error:  # whatever a damaged file makes zipfile raise
        damaged = str(error)
    if damaged is not None:
        raise InputError(
            f"{path} is damaged ({damaged}): a checksum in it is not that of its content. Copy it again, or {advice}."
        )


def _model_state(pipeline: dict[Any, Any], path: Path) -> dict[str, Tensor]:
    """The tensors of the model, named as on one GPU: training on several puts `module.` before the names."""
    found: dict[str, Tensor] = {}
    for name, value in pipeline.items():
        if not isinstance(name, str):
            raise InputError(
                f"{path}: `pipeline` has the key {str(name)[:40]} ({type(name).__name__}), expected names of tensors. "
                "Copy it again, or give another checkpoint with --load-step."
            )
        _, model, rest = name.removeprefix("module.").partition("_model.")
        rest = rest.removeprefix("module.")
        if not model or not isinstance(value, Tensor) or rest.startswith("lpips."):
            continue
        if rest in found:
            raise InputError(f"{path} holds {rest} twice. Expected every tensor once; copy it again.")
        check_plain(value, rest, path)
        found[rest] = value.detach().clone()
    return found


def check_plain(value: Tensor, name: str, path: Path) -> None:
    """Refuses tensors that would take more memory than their file has, or that are no array of numbers.

    Raises:
        ValueError: a sparse, quantized or complex tensor, one without content, or one that repeats its content.
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
            "is not stored number by number. Expected plain tensors, as trainers save them; save it again with those."
        )
