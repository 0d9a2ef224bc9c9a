"""nerfstudio's checkpoints: reading them without running what they contain."""

from __future__ import annotations

import codecs
import pickle
import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from normlift_ns.errors import InputError

GAUSSIAN_PARAMETERS = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")


class Checkpoint(NamedTuple):
    """What a trained run has learned."""

    path: Path
    step: int
    model: dict[str, Tensor]
    """State of the model on the CPU: gauss_params.*, camera_optimizer.*, ...; neither optimizers nor LPIPS."""


def find_checkpoint(folder: Path, step: int | None = None) -> Path:
    """The checkpoint of one step, or of the last one.

    Raises:
        FileNotFoundError: no checkpoint there, or none of that step; the message lists the steps there are.
    """
    found = {int(path.stem.removeprefix("step-")): path for path in folder.glob("step-*.ckpt") if _is_step(path)}
    if not found:
        raise FileNotFoundError(
            f"No checkpoint in {folder}. Expected step-000029999.ckpt or the like, which ns-train writes every "
            "--steps-per-save steps and at the end; copy it there or train the capture to its end."
        )
    if step is None:
        return found[max(found)]
    if step not in found:
        raise FileNotFoundError(
            f"No checkpoint of step {step} in {folder}; there are {', '.join(map(str, sorted(found)))}. "
            "Give one of them with --load-step, or none for the last."
        )
    return found[step]


def _is_step(path: Path) -> bool:
    return path.stem.removeprefix("step-").isdecimal()


def read_checkpoint(path: Path) -> Checkpoint:
    """Reads step and model of a splatfacto checkpoint, full or slim; the optimizers' state stays on disk.

    Raises:
        ValueError: a truncated or damaged file, other content, or not the Gaussians of splatfacto.
    """
    advice = "give another checkpoint with --load-step"
    loaded = read_tensors(path, "as ns-train splatfacto writes them", advice)
    state = loaded.get("pipeline") if isinstance(loaded, dict) else None
    if not isinstance(state, dict) or not isinstance(loaded.get("step"), int):
        keys = sorted(map(str, loaded)) if isinstance(loaded, dict) else type(loaded).__name__
        raise InputError(f"{path} is no nerfstudio checkpoint: expected `step` and `pipeline` in it, found {keys}.")
    model = dict(_model_state(state))
    missing = [name for name in GAUSSIAN_PARAMETERS if f"gauss_params.{name}" not in model]
    if missing:
        raise InputError(
            f"{path} has no Gaussians of splatfacto: gauss_params.{', gauss_params.'.join(missing)} missing. "
            "Train the capture with: ns-train splatfacto --data ..."
        )
    return Checkpoint(path, loaded["step"], model)


def read_tensors(path: Path, writer: str, advice: str) -> Any:
    """What torch.save wrote, memory-mapped on the CPU.

    Only tensors, plain containers and numpy's numbers are unpickled (`weights_only=True` plus the allow-list below), so
    that a file from a stranger runs no code.

    Args:
        writer, advice: parts of messages: who writes such files, and what to do besides copying the file again.
    Raises:
        ValueError: a truncated or damaged file, or one that holds other Python objects.
    """
    if not zipfile.is_zipfile(path):
        raise InputError(
            f"{path} is truncated or no checkpoint: its {path.stat().st_size:,} bytes are not the zip archive that "
            f"torch.save writes. Copy it again, or {advice}."
        )
    _check_sums(path, advice)
    try:
        with torch.serialization.safe_globals(numpy_numbers()):
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        found = re.search(r"GLOBAL (\S+)", str(error))
        raise InputError(
            f"{path} is not read, because it holds Python objects{f' ({found[1]})' if found else ''}: only tensors and "
            f"numbers are expected, {writer}. {advice[0].upper()}{advice[1:]}."
        ) from error
    except (RuntimeError, EOFError, OSError) as error:
        raise InputError(
            f"{path} is damaged ({str(error).strip().split('. ')[0]}). Copy it again, or {advice}."
        ) from error


def _check_sums(path: Path, advice: str) -> None:
    """The archive has a CRC-32 of every tensor, which torch.load does not look at."""
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except Exception as error:  # whatever a damaged file makes zipfile raise
        damaged = str(error)
    if damaged is not None:
        raise InputError(
            f"{path} is damaged ({damaged}): a checksum in it is not that of its content. Copy it again, or {advice}."
        )


def _model_state(pipeline: dict[str, Any]) -> Iterator[tuple[str, Tensor]]:
    """The tensors of the model, named as on one GPU: training on several puts `module.` before the names."""
    for name, value in pipeline.items():
        _, model, rest = name.removeprefix("module.").partition("_model.")
        rest = rest.removeprefix("module.")
        if model and isinstance(value, Tensor) and not rest.startswith("lpips."):
            yield rest, value.clone()


def numpy_numbers() -> list[Any]:
    """What unpickling numpy's scalars needs: learning rates in the state of nerfstudio's schedulers are such."""
    rebuild: Any = np.float64(0).__reduce__()[0]
    modules = ("numpy.core.multiarray", "numpy._core.multiarray")  # the names in numpy 1 and in numpy 2
    dtypes = {type(np.dtype(code)) for code in "?bBhHiIlLqQefd"}
    return [np.dtype, *dtypes, codecs.encode, *(_named(rebuild, module, "scalar") for module in modules)]


def _named(function: Callable[..., Any], module: str, name: str) -> Callable[..., Any]:
    """The function under another name: torch's allow-list goes by names."""

    def alias(*args: Any) -> Any:
        return function(*args)

    alias.__module__, alias.__name__, alias.__qualname__ = module, name, name
    return alias
