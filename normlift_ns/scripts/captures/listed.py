"""The list of captures: its lines as calls of ns-normlift, and the run that each of them makes.

A run of a batch is named after a digest of its options and of what says which scene it is of, so that the name tells
whether a capture was lifted with the same options, and no two processes can both write it.
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
"""Which option of ns-normlift takes a path of that suffix; all others are configs."""
_ELSEWHERE = ("device", "timestamp", "output_dir")
"""Options that say where something is computed or goes, and do not change what is lifted."""
_KEY_LENGTH = 16


@dataclass(frozen=True)
class Capture:
    """A line of the list."""

    name: str
    """The line."""
    words: tuple[str, ...]
    """What ns-normlift is called with, the name of the new run included."""
    key: str
    """Digest of scene and options, 16 hexadecimal digits."""
    run: Path | None
    """Directory of the lifted run; None where it shows only when the capture is opened."""


def read_captures(path: Path, options: Sequence[str]) -> tuple[Capture, ...]:
    """The captures of a list, in its order.

    Args:
        path: a text file. A line holds a path of a config.yml, a PLY file or a checkpoint of gsplat, and perhaps
            options of ns-normlift, quoted as in a shell; or options alone. Empty lines and those that begin with # do
            not count.
        options: of ns-normlift, for all captures; those of a line come after them.
    Raises:
        InputError: no text, an empty list, a line that ns-normlift would not understand, or that stands there twice.
    """
    try:
        common = _read(options)
    except InputError as error:
        raise InputError(f"After --: {error}") from None
    if (given := next((name for name in _source_names() if getattr(common, name) is not None), None)) is not None:
        raise InputError(
            f"--{given.replace('_', '-')} stands after --, where it would hold for every capture. Write it into "
            f"{path}, one line per capture."
        )
    try:
        text = path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path} is no text in UTF-8. Expected a list of captures, one path per line.") from None
    found: dict[str, tuple[int, Capture]] = {}
    for number, line in enumerate(map(str.strip, text.splitlines()), start=1):
        if line == "" or line.startswith("#"):
            continue
        capture = _capture(line, options, common, f"{path}, line {number}")
        if capture.key in found:
            raise InputError(
                f"{path}, line {number}, is the same capture with the same options as line {found[capture.key][0]}: "
                f"{visible(line)}. Remove one of the two."
            )
        found[capture.key] = number, capture
    if len(found) == 0:
        raise InputError(f"{path} lists no capture. Expected one path per line, such as outputs/…/config.yml.")
    return tuple(capture for _, capture in found.values())


def is_lifted(run: Path) -> bool:
    """Whether a lifted run is there, and whole as far as its manifest tells.

    Raises:
        InputError: something else, or a damaged run.
    """
    if not os.path.lexists(run):
        return False
    try:
        read_manifest(run / FIELD_FOLDER)
    except (InputError, OSError) as error:
        raise InputError(f"{error}. To have the capture lifted again, delete {run} and rerun the command.") from error
    return True


def identity(command: NormLift) -> str:
    """Digest of a scene and of the options that it is lifted with, 16 hexadecimal digits.

    Of the scene it knows the path, and names and sizes of the files that hold its Gaussians; of folders of features,
    label maps and weights the paths.
    """
    facts = {name: value for name, value in asdict(command).items() if name not in _ELSEWHERE}
    sizes = [(file.name, file.stat().st_size) for file in _scene_files(command) if file.is_file()]
    text = json.dumps([facts, sizes], sort_keys=True, default=os.path.abspath)  # paths are all that JSON has no form of
    return text_digest(text).rpartition(":")[2][:_KEY_LENGTH]


def _source_names() -> tuple[str, ...]:
    return "load_config", *_SOURCES.values()


def _scene_files(command: NormLift) -> list[Path]:
    if command.load_config is None:
        return [path for path in (command.load_ply, command.load_gsplat) if path is not None]
    step = "*" if command.load_step is None else f"{command.load_step:09d}"
    return sorted((command.load_config.absolute().parent / "nerfstudio_models").glob(f"step-{step}.ckpt"))[-1:]


def _capture(line: str, options: Sequence[str], common: NormLift, where: str) -> Capture:
    try:
        first, *rest = shlex.split(line)
    except ValueError as error:
        raise InputError(f"{where}: {visible(line)} is not quoted as in a shell ({error}). Close the quotes.") from None
    source = None if first.startswith("--") else _SOURCES.get(Path(first).suffix.lower(), "load_config")
    own = [first, *rest] if source is None else [f"--{source.replace('_', '-')}", first, *rest]
    try:
        if source is None or len(rest) > 0:
            command = _read([*options, *own])
        else:  # most lists have no options, and tyro takes its time
            command = replace(common, **{source: Path(first)})
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    key = identity(command)
    stamp = f"{_PREFIX}{key}"
    return Capture(line, (*options, *own, "--timestamp", stamp), key, _run(command, stamp))


def _read(words: Sequence[str]) -> NormLift:
    """The words of a call of ns-normlift.

    Raises:
        InputError: ns-normlift does not know them, or the batch has no use for one.
    """
    try:
        command = read_flags(NormLift, words, name="ns-normlift")
    except InputError as error:
        raise InputError(
            f"ns-normlift does not know all of these options: {visible(shlex.join(words))}. {error}"
        ) from None
    if command.timestamp is not None or command.overwrite:
        flag = "--overwrite" if command.overwrite else "--timestamp"
        raise InputError(
            f"{flag} is for ns-normlift alone: a batch names its runs by their options, so that a rerun does only what "
            "is missing. Leave it out; to have a capture lifted again, delete its run."
        )
    return command


def _run(command: NormLift, stamp: str) -> Path | None:
    try:
        name, outputs = new_run_place(command.load_config, command.splat, command.output_dir)
        return None if name is None or outputs is None else run_directory(outputs, name, stamp)
    except (InputError, OSError):  # a capture that cannot be opened, which its own process says
        return None
