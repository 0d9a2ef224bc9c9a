"""Hostile files for the tests of loaders: damaged bytes, JSON with wrong values, and things that are no files.

Every loader raises `InputError`, or `FileNotFoundError`, or reads the file: see `survives`.
"""

import json
import os
import warnings
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, given
from hypothesis import strategies as st

from normlift_ns import InputError
from tests.examples import examples

VALUES: list[Any] = [
    None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, 10**40, -(10**40), 10**400, 0.5, -0.0, 1e308, 1e-320, "", " ",
    "0", "1", "false", "nan", "a\0b", "\ud800", "[/red]", "$\\frac{$", "../x", "/", "\n", "x" * 5000, [], {}, [[]],
    [None], {"": {}}, [1, 2], {"a": 1}, float("nan"), float("inf"), float("-inf"),
]  # fmt: skip
"""In place of what a JSON file should hold."""


def survives(call: Callable[[], object]) -> None:
    """Only the errors of our own leave a loader, and they say something of one line or few."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            call()
    except (InputError, FileNotFoundError) as error:
        assert 10 < len(str(error)) < 20000, error
        if isinstance(error, FileNotFoundError):
            assert error.errno is None, f"the system's message and not ours: {error}"


def fuzz(number: int, contents: st.SearchStrategy[bytes], path: Path, load: Callable[[], object]) -> None:
    """Tries a loader on files of many contents at one path; many more of them in `make test-all`."""

    @examples(number, database=None, suppress_health_check=list(HealthCheck))
    @given(contents)
    def run(content: bytes) -> None:
        path.write_bytes(content)
        survives(load)

    run()


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """A file with bits flipped, bytes replaced, cut out, put in or repeated, the end cut off; the first part, where
    headers are, more often than the rest."""
    found = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        end = len(found) if draw(st.booleans()) else min(len(found), 256)
        at = draw(st.integers(0, max(0, end - 1)))
        kind = draw(st.sampled_from(("flip", "set", "cut", "insert", "repeat", "end", "digits")))
        if kind == "flip" and len(found) > 0:
            found[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == "set" and len(found) > 0:
            found[at] = draw(st.sampled_from((0, 255, 127, 128, 32, 57)))
        elif kind == "cut":
            del found[at : at + draw(st.integers(1, 32))]
        elif kind == "insert":
            found[at:at] = draw(st.binary(min_size=1, max_size=16))
        elif kind == "repeat":
            found[at:at] = found[at : at + 64]
        elif kind == "end":
            del found[at:]
        else:  # a number in a header becomes a large one
            places = [i for i in range(min(len(found), 1024)) if chr(found[i]).isdigit()]
            if len(places) > 0:
                place = draw(st.sampled_from(places))
                found[place:place] = draw(st.sampled_from((b"9" * 12, b"-", b"1e", b"0x", b".")))
    return bytes(found)


@st.composite
def hostile_json(draw: st.DrawFn, document: Any) -> bytes:
    """JSON text of a document in which a value or two are replaced, or keys are gone, new or there twice."""
    found = deepcopy(document)
    for _ in range(draw(st.integers(1, 2))):
        place = draw(st.sampled_from(list(_places(found)) or [None]))
        if place is None:
            break
        parent, key = place
        kind = draw(st.sampled_from(("value", "value", "value", "gone", "new", "deep")))
        if kind == "value":
            parent[key] = deepcopy(draw(st.sampled_from(VALUES)))
        elif kind == "gone":
            del parent[key]
        elif kind == "deep":
            parent[key] = "DEEP"
        elif isinstance(parent, dict):
            parent[draw(st.sampled_from(("", "x", "-1", "01", "1e3", "None")))] = deepcopy(
                draw(st.sampled_from(VALUES))
            )
        else:
            parent.append(deepcopy(draw(st.sampled_from(VALUES))))
    text = json.dumps(found)
    deep = draw(st.sampled_from((200, 5000, 100_000)))
    text = text.replace('"DEEP"', "[" * deep + "]" * deep)
    if draw(st.integers(0, 9)) == 0:
        text = text.replace("{", '{"labels": 1, ', 1)  # perhaps a key that stands twice
    return text.replace("NaN", draw(st.sampled_from(("NaN", "1e400", "-1e400")))).encode()


def _places(found: Any) -> Iterator[tuple[Any, Any]]:
    """Containers in a document, with each of their keys."""
    children = found.items() if isinstance(found, dict) else enumerate(found) if isinstance(found, list) else ()
    for key, child in list(children):
        yield found, key
        yield from _places(child)


def no_files(path: Path) -> Iterator[str]:
    """Makes the path one thing after the other that is no file with content, and says what it is."""
    outside = path.with_name(f"{path.name}.elsewhere")
    for kind, make in {
        "nothing": lambda: None,
        "an empty file": path.touch,
        "a folder": path.mkdir,
        "a link to nothing": lambda: path.symlink_to(outside),
        "a link to itself": lambda: path.symlink_to(path),
        "a pipe": lambda: os.mkfifo(path),
        "a device": lambda: path.symlink_to("/dev/zero"),
        "one byte": lambda: path.write_bytes(b"x"),
    }.items():
        if path.is_dir():
            path.rmdir()
        elif os.path.lexists(path):
            path.unlink()
        make()
        yield kind
