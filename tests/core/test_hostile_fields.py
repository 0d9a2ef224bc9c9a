"""Whatever stands in the files of a field, only our own error leaves their loaders."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given
from hypothesis import strategies as st

from normlift_ns import Evidence, SemanticField
from normlift_ns.core.disk.digests import text_digest
from normlift_ns.core.disk.manifest import MANIFEST, check_files, read_manifest
from normlift_ns.core.disk.tensors import load_tensors, save_tensors
from normlift_ns.errors import InputError
from tests.core.test_digests import VIEWS, as_version_0_1, example
from tests.examples import examples
from tests.hostile import damaged, fuzz, hostile_json, no_files, survives
from tests.scenes import random_evidence


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("sealed", [True, False])
def test_manifests_with_hostile_values(sealed: bool, tmp_path: Path) -> None:
    """With a right digest, and without any as version 0.1 wrote them."""
    field = example("float16")
    more = {
        "encoder": {"encoder": "open_clip", "text_vectors": None},
        "features": {"kind": "given", "content": "0"},
    }
    SemanticField(field.scalars, field.source, field.store, {**field.manifest, **more}, field.means).save(tmp_path)
    if not sealed:
        as_version_0_1(tmp_path)
    facts = json.loads((tmp_path / MANIFEST).read_text())
    facts.pop("digest", None)

    def seal(content: bytes) -> bytes:
        text = content.decode().replace("{", '{"digest": "", ', 1)
        return text.replace('"digest": ""', f'"digest": "{text_digest(text)}"', 1).encode()

    def load() -> None:
        survives(lambda: check_files(tmp_path))
        SemanticField.load(tmp_path, field.means)

    contents = hostile_json(facts)
    fuzz(15, contents.map(seal) if sealed else contents, tmp_path / MANIFEST, load)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("digests", [True, False])
def test_damaged_files(digests: bool, tmp_path: Path) -> None:
    field = example("evidence")
    field.save(tmp_path)
    if not digests:
        as_version_0_1(tmp_path)
    for path in sorted(tmp_path.iterdir()):
        whole = path.read_bytes()
        fuzz(10, damaged(whole), path, lambda: SemanticField.load(tmp_path, field.means))
        path.write_bytes(whole)


@pytest.mark.usefixtures("unchecked")
def test_evidence_with_hostile_facts_and_arrays(tmp_path: Path) -> None:
    """With right digests."""
    path = tmp_path / "e.safetensors"
    random_evidence(15, VIEWS, 3).save(path)
    tensors, facts, _ = load_tensors(path)

    @examples(15, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def test(data: st.DataObject) -> None:
        fact, array = data.draw(st.sampled_from(sorted(facts))), data.draw(st.sampled_from(sorted(tensors)))
        other = tensors[data.draw(st.sampled_from(sorted(tensors)))]
        value = data.draw(st.sampled_from(["", "-1", "1e3", "99999999999999", "9" * 5000, "nan", "²", facts[fact]]))
        given = {name: tensor for name, tensor in tensors.items() if name != array}
        if data.draw(st.booleans()):
            given[array] = other[: data.draw(st.integers(0, 4))].clone() if data.draw(st.booleans()) else -other
        save_tensors(path, given, {**facts, fact: value}, overwrite=True)
        survives(lambda: Evidence.load(path))

    test()


def test_what_is_no_file(tmp_path: Path) -> None:
    example().save(tmp_path)
    for path in sorted(tmp_path.iterdir()):
        whole = path.read_bytes()
        for _ in no_files(path):
            with pytest.raises((InputError, FileNotFoundError), match=path.name):
                SemanticField.load(tmp_path)
        path.write_bytes(whole)
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
    with pytest.raises(InputError, match=r"1,099,511,627,776"):
        read_manifest(tmp_path)
