"""Finding the weights of OpenCLIP models: a local file, the local cache, or a download; else one clear message."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
import warnings
from pathlib import Path
from typing import Any

from normlift_ns.encoders.clip.architectures import model_config, model_names, open_clip_part
from normlift_ns.encoders.weights import first_line, hub_file, probe
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_MODEL

REMEDY = (
    "give a local weight file with --encoder-pretrained FILE (.safetensors, .bin or .pt of that architecture), or use "
    "the encoder that needs no weights: --encoder colour"
)
_SUFFIXES = (".safetensors", ".bin", ".pt", ".pth", ".ckpt")


def import_open_clip() -> Any:
    """open_clip, imported at the first use because that takes seconds, without the warnings of the old timm that
    nerfstudio pins, and without wandb, with which timm would log its trainings: a quarter of those seconds."""
    absent = "wandb" not in sys.modules
    if absent:
        sys.modules["wandb"] = None  # type: ignore[assignment]  # importing it is an ImportError, which timm expects
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return importlib.import_module("open_clip")
    finally:
        if absent:
            sys.modules.pop("wandb", None)


def check_names(model: str, pretrained: str) -> None:
    """Checks an architecture and its weights by name, without loading or downloading anything.

    Raises:
        ValueError: a model or a tag of weights that open_clip does not know, or a model that the installed timm does
            not know.
        FileNotFoundError: what looks like a weight file does not exist.
    """
    config, tags = model_config(model), open_clip_part("pretrained")
    if config is None:
        near = ", ".join(difflib.get_close_matches(model, model_names()) or [DEFAULT_MODEL])
        raise InputError(
            f"unknown OpenCLIP model {model!r} (--encoder-model); near names: {near}. All of them: "
            'python -c "import open_clip; print(open_clip.list_models())"'
        )
    tower = config["vision_cfg"].get("timm_model_name")
    if tower is not None and not (timm := importlib.import_module("timm")).is_model(tower):
        raise InputError(
            f"OpenCLIP model {model} (--encoder-model) needs {tower} of timm, which the installed timm "
            f"{timm.__version__} does not have (nerfstudio pins an old one); take a model that open_clip builds "
            f"itself, such as {DEFAULT_MODEL} or ViT-L-14, or another timm at your own risk"
        )
    path = Path(pretrained)
    if os.path.isfile(path) or tags.is_pretrained_cfg(model, pretrained):
        return
    if os.path.lexists(path):
        raise InputError(f"{pretrained} is no weight file of an OpenCLIP model (--encoder-pretrained); {REMEDY}")
    if path.suffix in _SUFFIXES or len(path.parts) > 1:
        raise FileNotFoundError(f"weight file {pretrained} does not exist; check the path, or {REMEDY}")
    known = ", ".join(tags.list_pretrained_tags_by_model(model)) or "none"
    raise InputError(f"unknown weights {pretrained!r} of OpenCLIP model {model}; known: {known}. Otherwise {REMEDY}")


def find_weights(model: str, pretrained: str) -> tuple[Path, dict[str, Any]]:
    """The weight file, downloaded if need be, and what open_clip knows of its training: "mean" and "std" of the images,
    "quick_gelu".

    A local file tells nothing of that; it gets the mean and standard deviation of the architecture's published weights,
    if there are any, and the activation that the architecture names.

    Raises:
        FileNotFoundError: the weights are not in the local cache and cannot be downloaded.
    """
    known, local = open_clip_part("pretrained"), Path(pretrained)
    if os.path.isfile(local):
        tags = known.list_pretrained_tags_by_model(model)
        published = known.get_pretrained_cfg(model, tags[0]) if len(tags) > 0 else {}
        return local.resolve(), {key: published[key] for key in ("mean", "std") if key in published}
    published = known.get_pretrained_cfg(model, pretrained)
    try:
        return hub_file(published, open_clip_part("constants")) or _download(published), published
    except Exception as error:  # a download's client raises types of its own, which have nothing in common
        origin = published.get("hf_hub", "").rstrip("/") or published.get("url", "")
        raise FileNotFoundError(
            f"weights {pretrained!r} of OpenCLIP model {model} ({origin}) are neither in the local cache nor can they "
            f"be downloaded ({first_line(error)}); go online once, {REMEDY}"
        ) from None


def _download(published: dict[str, Any]) -> Path:
    if published.get("hf_hub"):
        probe(importlib.import_module("huggingface_hub").constants.ENDPOINT)
    return Path(open_clip_part("pretrained").download_pretrained(published))
