"""Evidence of views that were rasterized before, in files of several views, found again view by view.

A file is named by the keys of its views, and its head lists them. So a view is found whatever views surround it now:
photographs that are added between old ones cost no more than themselves.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

from normlift_ns.core.disk.arrays import read_facts
from normlift_ns.core.evidence import Evidence

_VIEWS = "views"
"""Among the remarks of a file: the keys of its views, in their order."""
_KNOWN = 2**14
"""Heads of files that a process remembers."""


class Place(NamedTuple):
    """Where the evidence of one view is."""

    evidence: Evidence
    """Of several views."""
    view: int
    """Which of them."""


def keep_views(evidence: Evidence, folder: Path, keys: Sequence[str]) -> None:
    """Writes the evidence of some views into a folder.

    Args:
        keys: digests of what each view was made from, in the order of the views.
    Raises:
        OSError: it cannot be written, for instance because the disk is full.
    """
    path = _path(folder, keys)
    evidence.save(path, key=path.stem, remarks={_VIEWS: " ".join(keys)})


def kept_views(folder: Path, keys: Sequence[str]) -> dict[int, Place]:
    """The views, by their numbers, whose evidence a folder holds; those in damaged files, or in files that stand under
    the name of others, are not among them.
    """
    found: dict[int, Place] = {}
    for path, there in _candidates(folder, keys):
        wanted = [number for number, key in enumerate(keys) if number not in found and key in there]
        evidence = _load(path, len(there)) if len(wanted) > 0 else None
        if evidence is not None:
            found.update((number, Place(evidence, there.index(keys[number]))) for number in wanted)
        if len(found) == len(keys):
            break
    return found


def known_views(folder: Path, keys: Sequence[str]) -> list[bool]:
    """Whether the heads of the files in a folder list each of the views; nothing else of them is read."""
    listed = {key for keys in _heads(folder).values() for key in keys}
    return [key in listed for key in keys]


def joined_views(places: Mapping[int, Place]) -> Evidence:
    """The evidence of views 0, 1, …, one after the other."""
    runs: list[tuple[Evidence, list[int]]] = []
    for number in sorted(places):
        evidence, view = places[number]
        if len(runs) > 0 and runs[-1][0] is evidence and view not in runs[-1][1]:
            runs[-1][1].append(view)
        else:
            runs.append((evidence, [view]))
    device = runs[0][0].region_view.device
    parts = [
        evidence if views == list(range(evidence.num_views)) else evidence.select_views(views)
        for evidence, views in runs
    ]
    return parts[0] if len(parts) == 1 else Evidence.merge(*(part.to(device) for part in parts))


def _path(folder: Path, keys: Sequence[str]) -> Path:
    name = blake2b(" ".join(keys).encode(), digest_size=16).hexdigest()
    return folder / f"{name}.safetensors"


def _load(path: Path, count: int) -> Evidence | None:
    try:
        evidence = Evidence.load(path, key=path.stem)
    except (FileNotFoundError, ValueError):
        return None
    return evidence if evidence.num_views == count else None


def _candidates(folder: Path, keys: Sequence[str]) -> Iterator[tuple[Path, list[str]]]:
    """Files that hold any of the views, with the keys of theirs: the file of just these first, then those that hold
    most of them.
    """
    whole = _path(folder, keys)
    if whole.is_file():
        yield whole, list(keys)
    heads, wanted = _heads(folder), set(keys)
    shares = {path: len(wanted.intersection(there)) for path, there in heads.items()}
    some = (path for path, share in shares.items() if share > 0 and path != whole)
    yield from ((path, heads[path]) for path in sorted(some, key=lambda path: (-shares[path], path.name)))


def _heads(folder: Path) -> dict[Path, list[str]]:
    """The keys that the head of every file names."""
    try:
        with os.scandir(folder) as entries:
            files = [(entry.path, entry.stat()) for entry in entries if entry.name.endswith(".safetensors")]
    except OSError:
        return {}
    return {Path(path): _head(path, state.st_mtime_ns, state.st_size).split() for path, state in files}


@lru_cache(_KNOWN)
def _head(path: str, changed: int, size: int) -> str:
    """What a file says of its views; nothing where it is damaged."""
    try:
        return read_facts(Path(path)).get(_VIEWS, "")
    except (FileNotFoundError, ValueError):
        return ""
