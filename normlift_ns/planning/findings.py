"""Diagnostics of a capture and a machine: one row per check, with its state (ok, warning or error) and advice."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

import torch

from normlift_ns.core.scene import Scene
from normlift_ns.encoders.build import resolve_regions
from normlift_ns.encoders.hub.families import FAMILIES
from normlift_ns.encoders.hub.places import local_folder, model_of
from normlift_ns.encoders.weights import clip_weights_at_hand, sam_weights_at_hand
from normlift_ns.options import DEFAULT_SAM, DEFAULT_SAM3, SourceOptions
from normlift_ns.planning.plan import Plan
from normlift_ns.scenes.match import in_view
from normlift_ns.stages import peak_gib

State = Literal["ok", "warning", "error"]
_PROJECTED_GAUSSIANS = 100_000
"""Number of Gaussians that are projected into the cameras."""
_FEW_IN_VIEW, _NONE_IN_VIEW = 0.5, 0.001
"""Shares of Gaussians in view below which the check warns, and fails."""
_HIGH_SHARE = 0.8
"""Share of free memory or disk space above which an estimate gets a warning."""
_LIFT_LESS = "lift less: --lift-downscale 2, or --max-views 50"
_SHOWN_PACKAGES = ("torch", "numpy", "nerfstudio", "gsplat", "open_clip_torch")


@dataclass(frozen=True)
class Finding:
    """Result of one check."""

    what: str
    state: State
    found: str
    advice: str = ""
    """Advice, such as an option to add."""


def of_views(scene: Scene) -> Finding:
    """Check how many Gaussians lie in the training views."""
    means = scene.gaussians.means
    means = means[:: max(1, len(means) // _PROJECTED_GAUSSIANS)]
    visible = torch.zeros(len(means), dtype=torch.bool)
    for camera in scene.train.cameras:
        visible |= in_view(means, camera)
    share = float(visible.float().mean())
    message = f"{share:.1%} of the Gaussians are in at least one of the {len(scene.train)} training views"
    if share < _NONE_IN_VIEW:
        return Finding("in view", "error", message, "give the cameras of this splat, or --world-transform")
    if share < _FEW_IN_VIEW:
        return Finding(
            "in view", "warning", message, "the others get no semantics; are these the cameras of the splat?"
        )
    return Finding("in view", "ok", message)


def of_device(device: str) -> Finding:
    """Check which device the lift will use."""
    if torch.device(device).type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        name = torch.cuda.get_device_name(device)
        return Finding("device", "ok", f"{name}, {free / 2**30:.1f} of {total / 2**30:.1f} GiB free")
    message = f"CPU, {torch.get_num_threads()} threads; no GPU is used"
    if torch.cuda.is_available():
        return Finding("device", "warning", f"{message}, although one is available", "--device cuda")
    return Finding("device", "ok", message)


def of_versions() -> Finding:
    """Check which packages are installed."""
    required = (requires("normlift-ns") or ()) if _version("normlift-ns") is not None else ()  # none in a source tree
    specifiers = [requirement.split(";")[0].strip() for requirement in required if "extra ==" not in requirement]
    names = ["".join(c if c.isalnum() or c in "-_." else " " for c in text).split()[0] for text in specifiers]
    missing = [name for name in names if _version(name) is None]
    message = ", ".join(f"{name} {_version(name) or 'absent'}" for name in _SHOWN_PACKAGES)
    if missing == ["nerfstudio"]:
        return Finding(
            "versions", "warning", f"{message}; ns-* commands need nerfstudio", "pip install nerfstudio==1.1.5"
        )
    if len(missing) > 0:
        return Finding(
            "versions", "error", f"{message}; not installed: {', '.join(missing)}", f"pip install {missing[0]}"
        )
    return Finding("versions", "ok", f"{message}, normlift_ns {_version('normlift-ns') or 'from source'}")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def missing_weights(options: SourceOptions, device: str) -> list[str]:
    """Describe the network weights that the options need and this machine does not have."""
    missing = []
    if options.features == "none" and (kind := resolve_regions(options, device)) in ("sam", "sam3"):
        model = options.sam_model or (DEFAULT_SAM if kind == "sam" else DEFAULT_SAM3)
        if not sam_weights_at_hand(model):
            missing.append(f"those of SAM, {model}")
    family = FAMILIES.get(options.encoder)
    if options.features == "none" and family is not None and local_folder(model_of(options, family)) is None:
        missing.append(f"those of {options.encoder}, {model_of(options, family)}")
    model, weights = options.encoder_model, options.encoder_pretrained
    if options.features == "none" and options.encoder == "open_clip" and clip_weights_at_hand(model, weights) is False:
        missing.append(f"those of OpenCLIP, {model} {weights}")
    return missing


def of_weights(missing: Sequence[str]) -> Finding:
    """Check that all weights are on this machine."""
    if len(missing) == 0:
        return Finding("weights", "ok", "all required weights are on this machine")
    message = f"not on this machine: {'; '.join(missing)}. They will be downloaded"
    return Finding("weights", "warning", message, "or give local files: --encoder-pretrained FILE, --sam-model FILE")


def of_memory(plan: Plan, device: str) -> list[Finding]:
    """Check that the lift fits into memory."""
    rows = []
    free = _free_memory()
    if free is not None:
        own = int((peak_gib() or 0.0) * 2**30)
        rows.append(_check_capacity("memory", plan.host_bytes, free + own, f"free memory, {_LIFT_LESS}"))
    if plan.device_bytes is not None:
        free = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device)
        rows.append(_check_capacity("GPU memory", plan.device_bytes, free, f"{_LIFT_LESS}, or --device cpu"))
    return rows


def of_disk(plan: Plan, folder: Path) -> Finding:
    """Check that the output fits on the disk."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    advice = f"free space in {existing}, or give --output-dir"
    return _check_capacity("disk", plan.disk_bytes, shutil.disk_usage(existing).free, advice)


def _check_capacity(name: str, needed: int, free: int, advice: str) -> Finding:
    """Compare needed bytes with free bytes."""
    message = f"about {needed / 2**30:.2f} GiB are needed, {free / 2**30:.1f} GiB are free"
    state: State = "error" if needed > free else "warning" if needed > _HIGH_SHARE * free else "ok"
    return Finding(name, state, message, "" if state == "ok" else advice)


def _free_memory() -> int | None:
    """Return the bytes that this process may still allocate; None if the system does not report them."""
    limits = []
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        limits += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
        limits += [int(limit) - int(Path("/sys/fs/cgroup/memory.current").read_text())] if limit != "max" else []
    except (OSError, ValueError, IndexError):
        pass
    if len(limits) == 0 and hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
        limits.append(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min(limits) if len(limits) > 0 else None
