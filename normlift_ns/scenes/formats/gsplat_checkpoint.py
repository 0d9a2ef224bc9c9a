"""Checkpoints of gsplat's simple_trainer."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from normlift_ns.errors import InputError
from normlift_ns.scenes.checkpoint import check_plain, checked_step, read_tensors
from normlift_ns.scenes.splat import Splat, check_splat, from_parameters

_RANK = re.compile(r"(ckpt_\d+_rank)(\d+)(\.pt)")
_ADVICE = "give another file with --load-gsplat"
_UNSUPPORTED = {
    "app_module": "an appearance network (--app_opt), without which its Gaussians have no colors",
}


class GsplatCheckpoint(NamedTuple):
    """Contents of a gsplat checkpoint."""

    files: tuple[Path, ...]
    """One file per GPU of the training."""
    step: int
    splat: Splat
    pose_adjust: Float[Tensor, "v 9"] | None
    """Pose adjustment of each training view: a translation, and a rotation in six numbers."""


def read_gsplat(path: Path) -> GsplatCheckpoint:
    """Read ckpt_<step>_rank<r>.pt; after training on several GPUs, read the files of all ranks, in order.

    Raises:
        FileNotFoundError: if there is no such file, or a rank is missing.
        ValueError: if a file is damaged, comes from another trainer or training run, or needs an appearance network, or
            if the Gaussians cannot be drawn.
    """
    files = _rank_files(path)
    loaded = [_read_rank(file) for file in files]
    steps = {step for step, _, _ in loaded}
    if len(steps) > 1:
        raise InputError(
            f"{files[0].parent} has ranks of different steps: {', '.join(map(str, sorted(steps)))}. Expected the files "
            "of one training run; put them into a separate folder."
        )
    splats = [from_parameters(tensors, file) for file, (_, tensors, _) in zip(files, loaded)]
    if len({splat.degree for splat in splats}) > 1:
        raise InputError(
            f"{files[0].parent} has ranks with different spherical harmonics. Expected the files of one training run; "
            "put them into a separate folder."
        )
    names = splats[0].parameters
    merged = Splat(**{name: torch.cat([splat.parameters[name] for splat in splats]) for name in names})
    check_splat(merged, files[0])
    return GsplatCheckpoint(files, steps.pop(), merged, loaded[0][2])


def _rank_files(path: Path) -> tuple[Path, ...]:
    if not path.is_file():
        raise FileNotFoundError(
            f"There is no checkpoint at {path}. With --load-gsplat, give a file that gsplat's simple_trainer wrote, "
            "for example results/garden/ckpts/ckpt_29999_rank0.pt."
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
            f"{path.parent} has {match[1]}* up to {max(ranks)}, but not rank {missing}. Every "
            "rank holds a part of the Gaussians; copy all files of the training run."
        )
    return tuple(ranks[rank] for rank in sorted(ranks))


def _read_rank(path: Path) -> tuple[int, dict[str, Tensor], Tensor | None]:
    """Read the step, the parameters by splatfacto's names, and the pose adjustments."""
    loaded = read_tensors(path, "as gsplat's simple_trainer writes them", _ADVICE)
    splats = loaded.get("splats") if isinstance(loaded, Mapping) else None
    if not isinstance(splats, Mapping):
        keys = sorted(map(str, loaded)) if isinstance(loaded, Mapping) else type(loaded).__name__
        hint = "; for a nerfstudio run, give its config.yml with --load-config" if "pipeline" in keys else ""
        raise InputError(f"{path} is not a gsplat checkpoint: expected `splats` in it, found {keys}{hint}.")
    for key, meaning in _UNSUPPORTED.items():
        if key in loaded:
            raise InputError(
                f"{path} holds `{key}`: {meaning}. Train it again without that option, or export a PLY file with the "
                "trainer's --save_ply and give that with --load-ply."
            )
    missing = [name for name in ("means", "quats", "scales", "opacities", "sh0", "shN") if name not in splats]
    if missing or not all(isinstance(value, Tensor) for value in splats.values()):
        raise InputError(
            f"{path} has no {', '.join(missing) or 'tensors'} in its `splats`, which holds "
            f"{', '.join(sorted(map(str, splats)))}. Expected the parameters of 3D Gaussians with spherical harmonics, "
            "as gsplat's simple_trainer writes them."
        )
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        check_plain(splats[name], name, path)
    if splats["sh0"].ndim != 3 or splats["sh0"].shape[1:] != (1, 3) or splats["opacities"].ndim != 1:
        raise InputError(
            f"{path}: sh0 has shape {tuple(splats['sh0'].shape)} and opacities {tuple(splats['opacities'].shape)}, "
            "expected (N, 1, 3) and (N,)."
        )
    parameters = {name: splats[name] for name in ("means", "quats", "scales")}
    parameters["opacities"] = splats["opacities"][:, None]
    parameters["features_dc"], parameters["features_rest"] = splats["sh0"][:, 0], splats["shN"]
    return checked_step(loaded.get("step", 0), path), parameters, _pose_adjust(path, loaded)


def _pose_adjust(path: Path, loaded: Mapping[str, Any]) -> Float[Tensor, "v 9"] | None:
    state = loaded.get("pose_adjust")
    if state is None:
        return None
    deltas = state.get("embeds.weight") if isinstance(state, Mapping) else None
    if isinstance(deltas, Tensor):
        check_plain(deltas, "pose_adjust", path)
    if not isinstance(deltas, Tensor) or deltas.ndim != 2 or deltas.shape[1] != 9 or not bool(deltas.isfinite().all()):
        raise InputError(
            f"{path}: its `pose_adjust` is not what gsplat's --pose_opt writes. Expected embeds.weight with finite "
            f"numbers of shape (views, 9); {_ADVICE}."
        )
    return deltas.double()
