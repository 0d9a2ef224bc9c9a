"""Cache of the evidence of rasterized views. A file holds several views, and each view is looked up on its own.

A file is named after the keys of its views, and its header lists them. So a view is found whichever views surround it:
if images are added between old ones, only the new images are rasterized.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

from normlift_ns.core.evidence import Evidence
from normlift_ns.io.arrays import read_metadata

_VIEWS = "views"
"""Header entry that holds the keys of the views, in their order."""
_CACHED_HEADERS = 2**14
"""File headers that a process keeps in memory."""


class CachedView(NamedTuple):
    """Location of the evidence of one view."""

    evidence: Evidence
    """Evidence of several views."""
    view: int
    """Index of the view in it."""


def cache_views(evidence: Evidence, folder: Path, keys: Sequence[str]) -> None:
    """Write the evidence of views to a file in a folder.

    Args:
        evidence: Evidence of the views.
        folder: Folder of the cache.
        keys: Digests of the inputs of each view, in the order of the views.

    Raises:
        OSError: If the file cannot be written, for instance because the disk is full.
    """
    path = _path(folder, keys)
    evidence.save(path, key=path.stem, remarks={_VIEWS: " ".join(keys)})


def find_cached_views(folder: Path, keys: Sequence[str]) -> dict[int, CachedView]:
    """Return the cached views by index into `keys`; files that are damaged or have the wrong name are skipped."""
    places: dict[int, CachedView] = {}
    for path, file_keys in _candidates(folder, keys):
        wanted = [number for number, key in enumerate(keys) if number not in places and key in file_keys]
        evidence = _load(path, len(file_keys)) if len(wanted) > 0 else None
        if evidence is not None:
            places.update((number, CachedView(evidence, file_keys.index(keys[number]))) for number in wanted)
        if len(places) == len(keys):
            break
    return places


def views_in_cache(folder: Path, keys: Sequence[str]) -> list[bool]:
    """Return for each view whether the header of a file in a folder lists it; only headers are read."""
    listed = {key for keys in _headers(folder).values() for key in keys}
    return [key in listed for key in keys]


def join_cached_views(places: Mapping[int, CachedView]) -> Evidence:
    """Return the evidence of all views in the order of their indices."""
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
    """Yield the files that hold any of the views, with the keys of their views.

    The file of exactly these views comes first, then those that hold the most of them.
    """
    exact = _path(folder, keys)
    if exact.is_file():
        yield exact, list(keys)
    headers, wanted = _headers(folder), set(keys)
    counts = {path: len(wanted.intersection(file_keys)) for path, file_keys in headers.items()}
    paths = (path for path, count in counts.items() if count > 0 and path != exact)
    yield from ((path, headers[path]) for path in sorted(paths, key=lambda path: (-counts[path], path.name)))


def _headers(folder: Path) -> dict[Path, list[str]]:
    """Return the keys that the header of each file lists."""
    try:
        with os.scandir(folder) as entries:
            files = [(entry.path, entry.stat()) for entry in entries if entry.name.endswith(".safetensors")]
    except OSError:
        return {}
    return {Path(path): _header(path, stat.st_mtime_ns, stat.st_size).split() for path, stat in files}


@lru_cache(_CACHED_HEADERS)
def _header(path: str, modified: int, size: int) -> str:
    """Return the keys in the header of a file, or an empty string if it is damaged."""
    try:
        return read_metadata(Path(path)).get(_VIEWS, "")
    except (FileNotFoundError, ValueError):
        return ""
