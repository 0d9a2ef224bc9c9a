"""Capture lists of ns-normlift-batch: the ns-normlift call and the run directory of each line.

Runs of a batch are named after a digest of the scene and the options. The name therefore shows whether a capture was
lifted with the same options, and no two processes can both write it.
"""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from normlift_ns.core.disk.digests import text_digest
from normlift_ns.core.disk.manifest import read_manifest
from normlift_ns.errors import InputError, visible
from normlift_ns.runs.files import FIELD_FOLDER, run_directory
from normlift_ns.scripts.early import new_run_place
from normlift_ns.scripts.lift import NormLift
from normlift_ns.scripts.shared import read_flags

_PREFIX = "batch_"
_SOURCES = {".ply": "load_ply", ".pt": "load_gsplat"}
"""Options of ns-normlift by the suffix of the path that they take; all other paths are configs."""
_NOT_IN_KEY = ("device", "timestamp", "output_dir")
"""Options that do not change what is lifted, only where it is computed or stored."""
_KEY_LENGTH = 16


@dataclass(frozen=True)
class Capture:
    """One line of a capture list."""

    name: str
    """The line itself."""
    words: tuple[str, ...]
    """Arguments of ns-normlift, including the name of the new run."""
    key: str
    """Digest of scene and options, 16 hexadecimal digits."""
    run: Path | None
    """Directory of the lifted run; None if it is not known before the capture is opened."""


def read_captures(path: Path, options: Sequence[str]) -> tuple[Capture, ...]:
    """Read a capture list, in its order.

    Args:
        path: Text file. A line has the path of a config.yml, a PLY file or a gsplat checkpoint. Options of ns-normlift,
            quoted as in a shell, may follow the path or replace it. Empty lines and lines that start with # are
            ignored.
        options: Options of ns-normlift for all captures; those of a line override them.
    Raises:
        InputError: The file is not UTF-8 text or lists no captures, or a line is invalid or a duplicate.
    """
    try:
        common = _parse(options)
    except InputError as error:
        raise InputError(f"After --: {error}") from None
    if (name := next((name for name in _source_names() if getattr(common, name) is not None), None)) is not None:
        raise InputError(
            f"--{name.replace('_', '-')} comes after --, where it applies to every capture. Write it into {path}, one "
            "line per capture."
        )
    try:
        text = path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8 text. Expected a list of captures, one path per line.") from None
    captures: dict[str, tuple[int, Capture]] = {}
    for number, line in enumerate(map(str.strip, text.splitlines()), start=1):
        if line == "" or line.startswith("#"):
            continue
        capture = _make_capture(line, options, common, f"{path}, line {number}")
        if capture.key in captures:
            raise InputError(
                f"{path}, line {number}, is the same capture with the same options as line {captures[capture.key][0]}: "
                f"{visible(line)}. Remove one of the two."
            )
        captures[capture.key] = number, capture
    if len(captures) == 0:
        raise InputError(f"{path} lists no captures. Expected one path per line, such as outputs/…/config.yml.")
    return tuple(capture for _, capture in captures.values())


def is_lifted(run: Path) -> bool:
    """Return whether a lifted run exists and has a valid manifest.

    Raises:
        InputError: The path is something else, or a damaged run.
    """
    if not os.path.lexists(run):
        return False
    try:
        read_manifest(run / FIELD_FOLDER)
    except (InputError, OSError) as error:
        raise InputError(f"{error}. To have the capture lifted again, delete {run} and rerun the command.") from error
    return True


def _capture_key(command: NormLift) -> str:
    """Return a digest of the scene and the options of a lift, 16 hexadecimal digits.

    The digest includes the path of the scene, and the names and sizes of the files with its Gaussians. For folders of
    features, label maps and weights, it includes their paths only.
    """
    options = {name: value for name, value in asdict(command).items() if name not in _NOT_IN_KEY}
    sizes = [(file.name, file.stat().st_size) for file in _scene_files(command) if file.is_file()]
    text = json.dumps([options, sizes], sort_keys=True, default=os.path.abspath)  # only paths need the default
    return text_digest(text).rpartition(":")[2][:_KEY_LENGTH]


def _source_names() -> tuple[str, ...]:
    return "load_config", *_SOURCES.values()


def _scene_files(command: NormLift) -> list[Path]:
    if command.load_config is None:
        return [path for path in (command.load_ply, command.load_gsplat) if path is not None]
    step = "*" if command.load_step is None else f"{command.load_step:09d}"
    return sorted((command.load_config.absolute().parent / "nerfstudio_models").glob(f"step-{step}.ckpt"))[-1:]


def _make_capture(line: str, options: Sequence[str], common: NormLift, location: str) -> Capture:
    try:
        first, *rest = shlex.split(line)
    except ValueError as error:
        raise InputError(
            f"{location}: {visible(line)} is not quoted as in a shell ({error}). Close the quotes."
        ) from None
    source = None if first.startswith("--") else _SOURCES.get(Path(first).suffix.lower(), "load_config")
    own = [first, *rest] if source is None else [f"--{source.replace('_', '-')}", first, *rest]
    try:
        if source is None or len(rest) > 0:
            command = _parse([*options, *own])
        else:  # a shortcut for lines without options, because tyro is slow
            command = replace(common, **{source: Path(first)})
    except InputError as error:
        raise InputError(f"{location}: {error}") from None
    key = _capture_key(command)
    timestamp = f"{_PREFIX}{key}"
    return Capture(line, (*options, *own, "--timestamp", timestamp), key, _run_dir(command, timestamp))


def _parse(words: Sequence[str]) -> NormLift:
    """Parse the arguments of ns-normlift.

    Raises:
        InputError: ns-normlift does not know an argument, or a batch does not support it.
    """
    try:
        command = read_flags(NormLift, words, name="ns-normlift")
    except InputError as error:
        raise InputError(f"invalid options of ns-normlift: {visible(shlex.join(words))}. {error}") from None
    if command.timestamp is not None or command.overwrite:
        flag = "--overwrite" if command.overwrite else "--timestamp"
        raise InputError(
            f"{flag} is not supported in a batch, which names runs by their options and lifts only missing ones. Leave "
            "it out; to lift a capture again, delete its run."
        )
    return command


def _run_dir(command: NormLift, timestamp: str) -> Path | None:
    try:
        name, outputs = new_run_place(command.load_config, command.splat, command.output_dir)
        return None if name is None or outputs is None else run_directory(outputs, name, timestamp)
    except (InputError, OSError):  # the process of this capture reports the error
        return None
