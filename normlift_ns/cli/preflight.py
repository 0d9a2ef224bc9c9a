"""Checks of a command line before torch is imported."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from normlift_ns.errors import InputError
from normlift_ns.io.atomic import complete_interrupted_writes, refuse_existing
from normlift_ns.io.guard import protect_inputs
from normlift_ns.io.run_dir import field_folder, read_manifest, text_cache_folder
from normlift_ns.options import (
    AskOptions,
    LiftOptions,
    SourceOptions,
    SplatOptions,
    check_prompt_list,
    option_name,
    short_repr,
)


def check_readable_file(path: Path | None, flag: str) -> None:
    """Raise an error if a path does not exist, is not a regular file, or is not readable. Ignore None."""
    _check_readable(path, flag, "a file")


def check_readable_folder(path: Path | None, flag: str) -> None:
    """Raise an error if a path does not exist, is not a folder, or is not readable. Ignore None."""
    _check_readable(path, flag, "a folder")


def _check_readable(path: Path | None, flag: str, expected: str) -> None:
    if path is None:
        return
    mode = _existing_mode(path, flag)
    kind = {stat.S_IFREG: "a file", stat.S_IFDIR: "a folder"}.get(stat.S_IFMT(mode), "a pipe or a device")
    if kind != expected:
        raise InputError(f"{path}, given with {flag}, is {kind}; give {expected}")
    if flag != "--colmap":  # a project folder may also contain outputs
        protect_inputs(path)
    _check_access(path, flag)


def _existing_mode(path: Path, flag: str) -> int:
    mode = _mode(path, flag)
    if mode is None:
        raise FileNotFoundError(f"{path}, given with {flag}, does not exist; check the path")
    return mode


def _mode(path: Path, flag: str) -> int | None:
    """Return the mode of a file or folder; None if it does not exist. Raise an error for a broken link."""
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        if path.is_symlink():
            raise FileNotFoundError(f"{path}, given with {flag}, is a broken link; check the path") from None
        return None
    except OSError as error:  # a link to itself, a name that is too long, a folder without search permission
        raise OSError(
            f"{short_repr(str(path))}, given with {flag}, cannot be opened: {error.strerror}; give another path"
        ) from None


def _check_access(path: Path, flag: str) -> None:
    if not os.access(path, os.R_OK):
        raise PermissionError(f"{path}, given with {flag}, is not readable; change its permissions")


def check_new_files(*paths: Path | None, overwrite: bool, flags: str) -> None:
    """Raise an error if a file cannot be written, or if it exists and `overwrite` is False. Ignore None."""
    files = [path for path in paths if path is not None]
    refuse_existing(*files, overwrite=overwrite, flags=flags)
    for path in files:
        check_writable_file(path, flags)


def check_writable_file(path: Path | None, flag: str) -> None:
    """Raise InputError or OSError if a file cannot be written. Its parent folder need not exist. Ignore None."""
    if path is None:
        return
    if path.name == "":
        raise InputError(f"{path}, given with {flag}, is the name of a folder; give a file name")
    check_writable_folder(path.parent, flag)


def check_writable_folder(path: Path | None, flag: str) -> None:
    """Raise InputError or OSError if a folder cannot be written. It need not exist. Ignore None."""
    for parent in () if path is None else (path, *path.absolute().parents):
        mode = _mode(parent, flag)
        if mode is None:
            continue
        if not stat.S_ISDIR(mode):
            raise InputError(f"{parent}, needed for {flag}, is not a folder; give another path")
        if not os.access(parent, os.W_OK | os.X_OK):
            raise PermissionError(f"{parent}, needed for {flag}, is not writable; give another path")
        return


def check_run_config(config: Path, data: Path | None, step: int | None = None, *, written_by: str = "ns-train") -> None:
    """Check a config.yml, its dataset and its checkpoint.

    Args:
        config: Path of the config.
        data: Current path of the dataset, if it was moved.
        step: Training step of the checkpoint. If None, any checkpoint suffices.
        written_by: Command that wrote the config, for messages.
    Raises:
        FileNotFoundError: The config, the dataset or the checkpoint is missing.
        OSError: The config cannot be read.
        InputError: The file is not a nerfstudio config.
    """
    run_dir = Path(os.path.abspath(config)).parent
    if not run_dir.exists():
        complete_interrupted_writes(run_dir.parent)  # complete an interrupted replacement of the run
    from normlift_ns.data.nerfstudio.config import check_config_exists, read_config_paths  # noqa: PLC0415 (as --help)

    check_config_exists(config, written_by)
    _check_access(config, "--load-config")
    if data is not None and not data.exists():
        raise FileNotFoundError(
            f"The dataset {data}, given with --data, does not exist. Give the current path of the dataset."
        )
    paths = read_config_paths(config)
    located = data is not None or (run_dir / "splat.json").is_file()  # a lifted splat stores its image paths
    if not located and len(paths.data) > 0 and not any(path.exists() for path in paths.data):
        raise FileNotFoundError(
            f"The dataset of {config} is not at {' or at '.join(map(str, paths.data[:2]))}. If it was moved, move "
            "it back, or give its new path with --data (not in ns-normlift-serve)."
        )
    checkpoints = run_dir / "nerfstudio_models"
    pattern = "step-*.ckpt" if step is None else f"step-{step:09d}.ckpt"
    if checkpoints.is_dir() and not any(checkpoints.glob(pattern)):
        files = ", ".join(sorted(path.name for path in checkpoints.iterdir())[:10]) or "nothing"
        others = step is not None and any(checkpoints.glob("step-*.ckpt"))
        raise FileNotFoundError(
            f"The checkpoint {pattern} is missing in {checkpoints}, which contains {files}. Copy it to this folder"
            f"{', or leave out --load-step to use the last checkpoint' if others else ''}."
        )


def check_lifted_run(config: Path, data: Path | None, ask: AskOptions | None = None) -> None:
    """Check the files of a lifted run, and its text encoder if `ask` is given."""
    check_run_config(config, data, written_by="ns-normlift")
    folder = field_folder(Path(os.path.abspath(config)).parent)
    if ask is None:
        return
    check_readable_file(ask.text_embeddings, "--text-embeddings")
    try:
        stored = SourceOptions.stored(read_manifest(folder)[0]["encoder"])
    except (KeyError, TypeError, ValueError, OSError):  # reported when the run is opened
        return
    names = text_cache_folder(folder.parent)
    cached = names.is_dir() and any(names.iterdir())  # the cache may contain the prompts
    if ask.text_embeddings is None and stored.text_embeddings is None and not cached:
        from normlift_ns.encoders.registry import find_encoder_kind  # noqa: PLC0415 (not needed for --help)

        kind = find_encoder_kind(stored.encoder)
        if kind is not None:
            kind.check(stored)


def check_splat_paths(ply: Path | None, gsplat: Path | None, splat: SplatOptions) -> None:
    """Check the paths of a splat without a nerfstudio run, of its cameras and of its images."""
    check_readable_file(ply, "--load-ply")
    check_readable_file(gsplat, "--load-gsplat")
    if (splat.colmap is None) == (splat.transforms is None):
        count = "none" if splat.colmap is None else "two"
        raise InputError(
            f"A splat needs one camera file, got {count}: give a COLMAP project folder with --colmap, or a "
            "transforms.json with --transforms."
        )
    for name in ("colmap", "images", "masks"):
        check_readable_folder(getattr(splat, name), f"--{name}")
    if splat.transforms is not None and not splat.transforms.is_dir():
        check_readable_file(splat.transforms, "--transforms")
    if isinstance(splat.world_transform, Path):
        check_readable_file(splat.world_transform, "--world-transform")


def refuse_unused(options: Any, names: Iterable[str], needed: str) -> None:
    """Raise InputError if an option in `names`, which has no effect without `needed`, differs from its default."""
    for name in names:
        if getattr(options, name) != getattr(type(options), name):
            raise InputError(f"{option_name(name)} has no effect without {needed}; add that, or leave this option out")


def check_unused_options(lift: LiftOptions) -> None:
    """Raise InputError if an option has no effect in combination with the other options."""
    if not lift.consensus:
        names = ("consensus_power", "consensus_sample", "consensus_min_agreement")
        refuse_unused(lift, names, "--consensus True")
    if lift.vote.vote != "posterior":
        refuse_unused(lift.vote, ("prior",), "--vote posterior")


def check_source_options(source: SourceOptions, queries: Iterable[str]) -> None:
    """Check the options of the 2D features, including their folders, weights and prompts."""
    from normlift_ns.encoders.registry import encoder_kind, with_encoder  # noqa: PLC0415 (not needed for --help)
    from normlift_ns.encoders.weights import is_local_path  # noqa: PLC0415
    from normlift_ns.segmentation.registry import check_mask_options, requested_regions  # noqa: PLC0415

    texts, source = tuple(queries), with_encoder(source)
    check_prompt_list("queries", texts)
    check_readable_folder(source.regions_dir, "--regions-dir")
    check_readable_folder(source.features_dir, "--features-dir")
    check_readable_file(source.text_embeddings, "--text-embeddings")
    name = requested_regions(source) if source.features == "none" else source.features
    if name != "auto":
        masks = check_mask_options(source.looking_for(texts), name)
        if masks.weights is not None:
            masks.weights.check()
    if source.sam_model is not None and is_local_path(source.sam_model, 2):
        _existing_mode(Path(source.sam_model), "--sam-model")
    if source.prompt_template not in ("{}", "ensemble") and "{}" not in source.prompt_template:
        raise InputError(
            f"--prompt-template {short_repr(source.prompt_template)} has no {{}} for the prompt; give a template such "
            'as "a photo of a {}"'
        )
    needed = source.features == "none" or (len(texts) > 0 and source.text_embeddings is None)
    kind = encoder_kind(source.encoder)  # raises for an unknown encoder
    if needed:
        kind.check(source)
