"""Where a network is: a folder here, the cache of the Hugging Face hub, or a download. Needs no torch."""

from __future__ import annotations

import importlib
import os
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from normlift_ns.encoders import weights
from normlift_ns.encoders.hub.families import Family
from normlift_ns.encoders.hub.folder import CONFIG, INDEX, SMALL_FILES, WEIGHTS, read_folder, read_json
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_MODEL, DEFAULT_PRETRAINED, SourceOptions

_LEAST = {"torch": (2, 6), "transformers": (4, 56)}


def model_of(options: SourceOptions, family: Family) -> str:
    """The name on the hub, or the folder, that the options ask for. The default of `--encoder-model` is one of
    OpenCLIP, and means the family's own."""
    return family.default if options.encoder_model == DEFAULT_MODEL else options.encoder_model


def check_packages(family: Family) -> None:
    """Raises InputError where the installed packages do not suffice."""
    for package, least in _LEAST.items():
        wanted = ".".join(map(str, least))
        try:
            found = version(package)
        except PackageNotFoundError:
            found = "none"
        numbers = tuple(int(part) for part in found.split(".")[:2] if part.isdigit())
        if numbers < least:
            raise InputError(
                f'--encoder {family.name} needs {package} {wanted} or later, found {found} (pip install -U "{package}>='
                f'{wanted}"); --encoder open_clip works without'
            )


def check_options(options: SourceOptions, family: Family) -> None:
    """Checks what can be told before torch is loaded.

    Raises:
        InputError: packages that do not suffice, an option of another encoder, a folder of another architecture.
        FileNotFoundError: a folder that does not exist, a network that cannot be downloaded.
    """
    check_packages(family)
    if options.encoder_pretrained != DEFAULT_PRETRAINED:
        raise InputError(
            f"--encoder-pretrained {options.encoder_pretrained} is for --encoder open_clip; name the folder of a "
            f"{family.title} network with --encoder-model"
        )
    model = model_of(options, family)
    check_name(model, family)
    place = local_folder(model)
    if place is not None:
        read_folder(place, family)
        return
    try:
        weights.reach_hub()
    except OSError as error:
        raise _unreachable(model, family, error) from None


def check_name(model: str, family: Family) -> None:
    """Checks that a name can be one of a folder or of the hub.

    Raises:
        InputError, FileNotFoundError: it cannot.
    """
    example = f"give a folder with {CONFIG}, {WEIGHTS} and tokenizer.json, or a name such as {family.default}"
    if os.path.isdir(model):
        return
    if os.path.lexists(model):
        raise InputError(f"{model}, given with --encoder-model, is no folder; {example}")
    if weights.is_path(model, 2):
        raise FileNotFoundError(f"{model}, given with --encoder-model, does not exist; {example}")
    if len(Path(model).parts) != 2:
        raise InputError(f"--encoder-model {model!r} is neither a folder nor a name of the hub; {example}")


def local_folder(model: str) -> Path | None:
    """Where a network lies on this machine, the cache of the hub included; None: nowhere, or not all of it."""
    if os.path.isdir(model):
        return Path(model).resolve()
    if not weights.is_cached(model, CONFIG):
        return None
    hub = importlib.import_module("huggingface_hub")
    found = [hub.try_to_load_from_cache(model, name) for name in (CONFIG, WEIGHTS, INDEX)]
    whole = isinstance(found[0], str) and any(isinstance(file, str) for file in found[1:])
    return Path(found[0]).parent if whole else None


def fetch_folder(model: str, family: Family) -> Path:
    """The folder of a network, downloaded if need be: nothing but JSON and safetensors.

    Raises:
        FileNotFoundError: it is not on this machine and cannot be downloaded.
        InputError: it is of another architecture.
    """
    check_name(model, family)
    place = local_folder(model)
    if place is not None:
        return place
    hub = importlib.import_module("huggingface_hub")
    try:
        weights.reach_hub()
        folder = Path(hub.snapshot_download(model, allow_patterns=[CONFIG]))
    except Exception as error:  # a download's client raises types of its own, which have nothing in common
        raise _unreachable(model, family, error) from None
    kind = read_json(folder / CONFIG).get("model_type")
    if kind not in family.model_types:
        raise InputError(
            f"{model} is of the architecture {kind!r:.60}, expected {' or '.join(map(repr, family.model_types))}, "
            f"which {family.title} has; give --encoder-model a name such as {family.default}"
        )
    try:
        return Path(hub.snapshot_download(model, allow_patterns=[*SMALL_FILES, WEIGHTS, "model-*.safetensors"]))
    except Exception as error:  # likewise
        raise _unreachable(model, family, error) from None


def _unreachable(model: str, family: Family, error: Exception) -> FileNotFoundError:
    return FileNotFoundError(
        f"the {family.title} network {model} is neither on this machine nor can it be downloaded "
        f"({weights.first_line(error)}); go online once, give a folder with --encoder-model, or use the encoder that "
        "needs no weights: --encoder colour"
    )
