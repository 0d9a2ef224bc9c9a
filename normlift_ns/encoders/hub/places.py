"""Location of a network: a local folder, the Hugging Face hub cache, or a download. Needs no torch."""

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

_MIN_VERSIONS = {"torch": (2, 6), "transformers": (4, 56)}


def model_of(options: SourceOptions, family: Family) -> str:
    """Return the hub name or folder that the options select. The default of `--encoder-model` is an OpenCLIP model and
    stands for the family's own default."""
    return family.default if options.encoder_model == DEFAULT_MODEL else options.encoder_model


def check_packages(family: Family) -> None:
    """Raise InputError if installed packages are missing or too old."""
    for package, minimum in _MIN_VERSIONS.items():
        required = ".".join(map(str, minimum))
        try:
            installed = version(package)
        except PackageNotFoundError:
            installed = "none"
        numbers = tuple(int(part) for part in installed.split(".")[:2] if part.isdigit())
        if numbers < minimum:
            raise InputError(
                f"--encoder {family.name} needs {package} {required} or later, found {installed} (pip install -U "
                f'"{package}>={required}"); --encoder open_clip does not'
            )


def check_options(options: SourceOptions, family: Family) -> None:
    """Check the options as far as possible without torch.

    Raises:
        InputError: If packages are missing or too old, an option belongs to another encoder, or the folder has another
            architecture.
        FileNotFoundError: If the folder does not exist, or the network cannot be downloaded.
    """
    check_packages(family)
    if options.encoder_pretrained != DEFAULT_PRETRAINED:
        raise InputError(
            f"--encoder-pretrained {options.encoder_pretrained} is for --encoder open_clip; give the folder of a "
            f"{family.title} network with --encoder-model"
        )
    model = model_of(options, family)
    check_name(model, family)
    folder = local_folder(model)
    if folder is not None:
        read_folder(folder, family)
        return
    try:
        weights.reach_hub()
    except OSError as error:
        raise _unreachable(model, family, error) from None


def check_name(model: str, family: Family) -> None:
    """Check that a name is a folder or can be a hub name.

    Raises:
        InputError, FileNotFoundError: If it cannot.
    """
    example = f"give a folder with {CONFIG}, {WEIGHTS} and tokenizer.json, or a name such as {family.default}"
    if os.path.isdir(model):
        return
    if os.path.lexists(model):
        raise InputError(f"{model}, given with --encoder-model, is not a folder; {example}")
    if weights.is_path(model, 2):
        raise FileNotFoundError(f"{model}, given with --encoder-model, does not exist; {example}")
    if len(Path(model).parts) != 2:
        raise InputError(f"--encoder-model {model!r} is neither a folder nor a hub name; {example}")


def local_folder(model: str) -> Path | None:
    """Return the folder of a network on this machine, which may be in the hub cache; None if it is missing or
    incomplete."""
    if os.path.isdir(model):
        return Path(model).resolve()
    if not weights.is_cached(model, CONFIG):
        return None
    hub = importlib.import_module("huggingface_hub")
    config, *weight_files = (hub.try_to_load_from_cache(model, name) for name in (CONFIG, WEIGHTS, INDEX))
    complete = isinstance(config, str) and any(isinstance(file, str) for file in weight_files)
    return Path(config).parent if complete else None


def fetch_folder(model: str, family: Family) -> Path:
    """Return the folder of a network. If necessary, download it: only JSON and safetensors files.

    Raises:
        FileNotFoundError: If the network is not on this machine and cannot be downloaded.
        InputError: If it has another architecture.
    """
    check_name(model, family)
    local = local_folder(model)
    if local is not None:
        return local
    hub = importlib.import_module("huggingface_hub")
    try:
        weights.reach_hub()
        folder = Path(hub.snapshot_download(model, allow_patterns=[CONFIG]))
    except Exception as error:  # download clients raise exceptions without a common base class
        raise _unreachable(model, family, error) from None
    kind = read_json(folder / CONFIG).get("model_type")
    if kind not in family.model_types:
        raise InputError(
            f"{model} has the architecture {kind!r:.60}, expected that of {family.title}, "
            f"{' or '.join(map(repr, family.model_types))}; give --encoder-model a name such as {family.default}"
        )
    try:
        return Path(hub.snapshot_download(model, allow_patterns=[*SMALL_FILES, WEIGHTS, "model-*.safetensors"]))
    except Exception as error:  # likewise
        raise _unreachable(model, family, error) from None


def _unreachable(model: str, family: Family, error: Exception) -> FileNotFoundError:
    return FileNotFoundError(
        f"the {family.title} network {model} is not on this machine and cannot be downloaded "
        f"({weights.first_line(error)}); go online once, give a folder with --encoder-model, or use the encoder that "
        "needs no weights: --encoder colour"
    )
