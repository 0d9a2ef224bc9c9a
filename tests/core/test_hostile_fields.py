"""Whatever stands in the files of a field, only our own error leaves their loaders."""

from __future__ import annotations

import json
import os
import struct
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from normlift_ns import Evidence, SemanticField
from normlift_ns.core.disk.digests import text_digest
from normlift_ns.core.disk.manifest import MANIFEST, check_files, read_manifest
from normlift_ns.core.disk.tensors import load_tensors, save_tensors
from normlift_ns.errors import InputError
from tests.core.test_digests import FORMS, VIEWS, as_version_0_1, example
from tests.scenes import random_evidence

HOSTILE: tuple[Any, ...] = (
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        2**31,
        2**63,
        10**400,
        1.5,
        -0.0,
        float("nan"),
        float("inf"),
        "",
        "a",
        "..",
        "/",
        "\0",
    ),
    *("\ud800", "[/red]", "x" * 10_000, "evidence", "float16", "low_rank", [], {}, [[]], {"": None}, [0] * 1000),
)
EXAMPLES = [pytest.param(25, id="fast"), pytest.param(200, id="slow", marks=pytest.mark.slow)]


def edited(content: bytes, data: st.DataObject) -> bytes:
    """Bytes flipped, removed, inserted, repeated or cut off."""
    where = data.draw(st.integers(0, len(content) - 1), "where")
    length = data.draw(st.integers(1, 40), "length")
    new = data.draw(st.binary(max_size=20), "new")
    ways = (
        content[:where] + new + content[where + length :],
        content[:where] + bytes([content[where] ^ 1 << length % 8]) + content[where + 1 :],
        content[:where],
        content[:where] + content[where : where + length] * 2 + content[where + length :],
        struct.pack("<Q", data.draw(st.sampled_from([0, 2**20, 2**63, 2**64 - 1]), "header")) + content[8:],
    )
    return data.draw(st.sampled_from(ways), "way")


def replaced(value: Any, data: st.DataObject) -> Any:
    """JSON with a hostile value in one place, or without that place."""
    if isinstance(value, dict | list) and len(value) > 0 and data.draw(st.integers(0, 9)) > 0:
        keys = list(value) if isinstance(value, dict) else range(len(value))
        key = data.draw(st.sampled_from(keys), "key")
        if isinstance(value, dict):
            if data.draw(st.integers(0, 9)) == 0:
                return {name: inner for name, inner in value.items() if name != key}
            return {**value, key: replaced(value[key], data)}
        return [*value[:key], replaced(value[key], data), *value[key + 1 :]]
    return data.draw(st.sampled_from(HOSTILE), "value")


def only_our_errors(action: Callable[[], object]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            action()
        except (InputError, FileNotFoundError) as error:
            assert len(str(error)) > 0


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("examples", EXAMPLES)
@pytest.mark.parametrize("sealed", [True, False])
def test_manifests_with_hostile_values(sealed: bool, examples: int) -> None:
    """With a right digest, and without any as version 0.1 wrote them."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        field = example("float16")
        more = {
            "encoder": {"encoder": "open_clip", "text_vectors": None},
            "features": {"kind": "given", "content": "0"},
        }
        SemanticField(field.scalars, field.source, field.store, {**field.manifest, **more}, field.means).save(folder)
        if not sealed:
            as_version_0_1(folder)
        facts = json.loads((folder / MANIFEST).read_text())

        @settings(max_examples=examples, deadline=None)
        @given(st.data())
        def test(data: st.DataObject) -> None:
            changed = replaced(facts, data)
            if sealed and isinstance(changed, dict):
                text = json.dumps({**changed, "digest": ""}, indent=2) + "\n"
                text = text.replace('"digest": ""', f'"digest": "{text_digest(text)}"', 1)
            else:
                text = json.dumps(changed)
            (folder / MANIFEST).write_text(text, "utf8")
            only_our_errors(lambda: SemanticField.load(folder, field.means))
            only_our_errors(lambda: check_files(folder))

        test()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("examples", EXAMPLES)
@pytest.mark.parametrize("file", [MANIFEST, "field.safetensors", "evidence.safetensors"])
@pytest.mark.parametrize("digests", [True, False])
def test_edited_bytes(digests: bool, file: str, examples: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        field = example("evidence")
        field.save(folder)
        if not digests:
            as_version_0_1(folder)
        whole = (folder / file).read_bytes()

        @settings(max_examples=examples, deadline=None)
        @given(st.data())
        def test(data: st.DataObject) -> None:
            (folder / file).write_bytes(edited(whole, data))
            only_our_errors(lambda: SemanticField.load(folder, field.means))

        test()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("examples", EXAMPLES)
def test_evidence_with_hostile_facts_and_arrays(examples: int) -> None:
    """With right digests."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "e.safetensors"
        random_evidence(15, VIEWS, 3).save(path)
        tensors, facts, _ = load_tensors(path)

        @settings(max_examples=examples, deadline=None)
        @given(st.data())
        def test(data: st.DataObject) -> None:
            fact, array = data.draw(st.sampled_from(sorted(facts))), data.draw(st.sampled_from(sorted(tensors)))
            other = tensors[data.draw(st.sampled_from(sorted(tensors)))]
            value = data.draw(st.sampled_from(["", "-1", "1e3", "99999999999999", "9" * 5000, "nan", "²", facts[fact]]))
            given = {name: tensor for name, tensor in tensors.items() if name != array}
            if data.draw(st.booleans()):
                given[array] = other[: data.draw(st.integers(0, 4))].clone() if data.draw(st.booleans()) else -other
            save_tensors(path, given, {**facts, fact: value}, overwrite=True)
            only_our_errors(lambda: Evidence.load(path))

        test()


@pytest.mark.parametrize("name", ["field.safetensors", "evidence.safetensors", MANIFEST])
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: os.symlink(path, path), lambda path: path.touch()])
@pytest.mark.parametrize("form", FORMS[:1])
def test_what_is_no_file(name: str, make: Callable[[Path], None], form: str, tmp_path: Path) -> None:
    example(form).save(tmp_path)
    (tmp_path / name).unlink()
    make(tmp_path / name)
    with pytest.raises((InputError, FileNotFoundError), match=name):
        SemanticField.load(tmp_path)


def test_a_deep_or_large_manifest_is_refused(tmp_path: Path) -> None:
    example().save(tmp_path)
    path = tmp_path / MANIFEST
    for text in ("[" * 10**6, '{"a":' * 10**6, '{"schema_version": 1, "encoder": ' + "[" * 900 + "]" * 900 + "}"):
        path.write_text(text)
        with pytest.raises(InputError, match=r"manifest\.json"):
            read_manifest(tmp_path)
    with path.open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(InputError, match=r"it has 1,099,511,627,776 bytes"):
        read_manifest(tmp_path)
