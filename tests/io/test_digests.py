"""Damage and files in the wrong place are noticed before any number is used, and nothing is read outside of arrays."""

import json
import random
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from normlift_ns import Evidence, SemanticField
from normlift_ns.core.sparse import SparseRows
from normlift_ns.errors import InputError
from normlift_ns.io.arrays import array_digest, check_array, load_arrays, save_arrays
from normlift_ns.io.atomic import text_digest
from normlift_ns.io.field import read_evidence
from normlift_ns.io.run_dir import MANIFEST_FILE, check_file_digests, read_manifest, write_manifest
from tests.examples import FACTOR
from tests.hostile import damaged, fuzz, hostile_json, survives
from tests.io.test_field import FORMS, VIEWS, D, N
from tests.io.test_field import example as lifted_example
from tests.random_scenes import random_evidence, same_evidence

FLIPS = 20 * FACTOR
"""Of each file, besides its first bit and its last."""


@cache
def example(form: str = "evidence", seed: int = 0) -> SemanticField:
    lifted, means, source = lifted_example(seed)
    return SemanticField.build(lifted, means, source, storage=form, tolerance=2e-3)  # type: ignore[arg-type]


def flipped(content: bytes, bit: int) -> bytes:
    changed = bytearray(content)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def some_bits(content: bytes) -> list[int]:
    size = 8 * len(content)
    return [0, size - 1, *random.Random(0).sample(range(size), FLIPS)]


def test_every_flipped_bit_of_a_field_is_noticed(tmp_path: Path) -> None:
    for form in FORMS:
        example(form).save(tmp_path / form)
        files = sorted((tmp_path / form).iterdir())
        assert len(files) == (3 if form == "evidence" else 2)
        for path in files:
            whole = path.read_bytes()
            for bit in some_bits(whole):
                path.write_bytes(flipped(whole, bit))
                with pytest.raises(ValueError, match=rf"{path}|schema version"):
                    SemanticField.load(path.parent)
            path.write_bytes(whole)
        assert SemanticField.load(tmp_path / form).manifest == example(form).manifest


def test_files_of_different_lifts_do_not_pass_together(tmp_path: Path) -> None:
    """Also where one is of version 0.1, without digests."""
    for name in ("right", "old"):
        example().save(tmp_path / name)
    example(seed=1).save(tmp_path / "other")
    as_version_0_1(tmp_path / "old")
    for other in ("other", "old"):
        for name in ("field.safetensors", "evidence.safetensors", "manifest.json"):
            mixed = shutil.copytree(tmp_path / "right", tmp_path / f"{other} {name}")
            shutil.copy(tmp_path / other / name, mixed)
            with pytest.raises(ValueError, match=r"safetensors .* different lifts: .*lift again"):
                SemanticField.load(mixed)
    loaded = SemanticField.load(tmp_path / "right")
    replace(loaded, source=loaded.source.flip(0)).save(tmp_path / "flipped")  # has digests of its own
    assert read_manifest(tmp_path / "right")[1] != read_manifest(tmp_path / "flipped")[1]
    assert torch.equal(SemanticField.load(tmp_path / "flipped").source, loaded.source.flip(0))


def as_version_0_1(folder: Path) -> None:
    """Takes the digests away, as if there had never been any."""
    for path in folder.glob("*.safetensors"):
        with safe_open(path, "pt") as file:
            facts = {name: value for name, value in (file.metadata() or {}).items() if name != "digest"}
        save_file(load_file(path), path, metadata=facts or None)
    manifest = json.loads((folder / MANIFEST_FILE).read_text())
    facts = {name: value for name, value in manifest.items() if name not in ("digest", "digests")}
    (folder / MANIFEST_FILE).write_text(json.dumps(facts, indent=2) + "\n")


@pytest.mark.parametrize("form", FORMS)
def test_a_field_of_version_0_1_opens_with_a_note(form: str, tmp_path: Path) -> None:
    field = example(form)
    field.save(tmp_path)
    as_version_0_1(tmp_path)
    with pytest.warns(UserWarning, match=rf"^{tmp_path} .*0\.1.*lift again"):
        loaded = SemanticField.load(tmp_path)
    assert torch.equal(loaded.query(torch.eye(D)), field.query(torch.eye(D)))
    assert loaded.manifest == field.manifest
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded.save(tmp_path / "again")
        SemanticField.load(tmp_path / "again")


def with_value(value: float) -> Callable[[torch.Tensor], torch.Tensor]:
    def change(tensor: torch.Tensor) -> torch.Tensor:
        tensor.view(-1)[3] = value
        return tensor

    return change


def forge(folder: Path, file: str, name: str, change: Callable[[torch.Tensor], torch.Tensor | None]) -> None:
    """Changes an array of a field, or takes it away, and seals all files again."""
    manifest, digests = read_manifest(folder)
    arrays, facts, _ = load_arrays(folder / file, framework="pt")
    changed = change(arrays.pop(name))
    arrays |= {} if changed is None else {name: changed}
    digest = save_arrays(folder / file, arrays, facts, overwrite=True)
    (folder / MANIFEST_FILE).unlink()
    write_manifest(folder, manifest, {**(digests or {}), file: digest})


NAN, INF = float("nan"), float("inf")
WRONG = {
    "negative source": ("source", with_value(-1), "source .* -1"),
    "source out of range": ("source", with_value(N), rf"source .*\.\.{N}"),
    "short source": ("source", lambda x: x[1:], r"source is int32 \(39,\)"),
    "long source": ("source", lambda x: x.long(), r"source is int64 \(40,\)"),
    "NaN norm": ("norm", with_value(NAN), "norm .* nan"),
    "infinite reliability": ("reliability", with_value(INF), r"reliability .*\.\.inf"),
    "negative weight": ("weight", with_value(-1.0), "weight .* -1"),
    "no n_eff": ("n_eff", lambda x: None, "is damaged.*'n_eff' is missing"),
    "no table": ("TABLE", lambda x: None, "is damaged.*'TABLE' is missing"),
    "short table": ("TABLE", lambda x: x[:-1], "TABLE is .*, expected"),
    "narrow table": ("TABLE", lambda x: x[:, 1:].contiguous(), "TABLE is .*, expected"),
    "wrong type": ("TABLE", lambda x: x.double(), "TABLE is float64 .*, expected"),
    "NaN in the table": ("TABLE", with_value(NAN), "TABLE .*nan"),
    "infinite table": ("TABLE", with_value(INF), "TABLE .*inf"),
}
WRONG_ROWS = {
    "column out of range": ("region", with_value(10**6), r"columns .*\.\.1000000, .* 0\.\.17"),
    "negative column": ("region", with_value(-7), "columns .* -7"),
    "falling offsets": ("offsets", with_value(10**9), "offsets"),
    "no offsets": ("offsets", lambda x: x[:0], "offsets"),
    "short offsets": ("offsets", lambda x: torch.cat([x[:5], x[-1:]]), r"evidence.*\(.* 5 Gaussians.* 40"),
    "short columns": ("region", lambda x: x[:-1], "offsets"),
    "narrow columns": ("region", lambda x: x.to(torch.int16), "columns are int16"),
    "NaN weight": ("weight", with_value(NAN), "weights .* nan"),
    "negative weight of a region": ("weight", with_value(-1.0), "weights .* -1"),
    "integer weights": ("weight", lambda x: x.int(), "weights are int32"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.filterwarnings("ignore:.*was written by version 0.1")
def test_arrays_that_lead_outside_are_refused(form: str, tmp_path: Path) -> None:
    table = "features" if form == "evidence" else "coordinates"
    for name, (array, change, message) in (WRONG | WRONG_ROWS if form == "evidence" else WRONG).items():
        folder = tmp_path / name
        example(form).save(folder)
        file = "evidence.safetensors" if name in WRONG_ROWS else "field.safetensors"
        forge(folder, file, array.replace("TABLE", table), change)
        for old in (False, True):
            if old:
                as_version_0_1(folder)
            with pytest.raises(ValueError, match=message.replace("TABLE", table)) as caught:
                SemanticField.load(folder)
            assert str(folder) in str(caught.value) and "ns-normlift" in str(caught.value), name


@pytest.mark.usefixtures("unchecked")
def test_a_product_never_reads_outside_of_its_table() -> None:
    rows = SparseRows(torch.tensor([0, 2]), torch.tensor([0, 5]).int(), torch.ones(2))
    assert rows.num_columns == 6
    with pytest.raises(ValueError, match=r"column \(6\).* 5"):
        rows.matmul(torch.ones(5, 1))
    assert rows.matmul(torch.ones(6, 1)).tolist() == [[2.0]]
    for broken in (
        replace(rows, column=torch.tensor([0, -5]).int()),
        replace(rows, offsets=torch.tensor([0, 3])),
        replace(rows, offsets=torch.tensor([0, 5, -3, 2])),
        replace(rows, weight=torch.ones(1)),
    ):
        with pytest.raises(ValueError, match=r"^(columns|row offsets) must "):
            broken.matmul(torch.ones(6, 1))


def test_flips_and_other_keys_of_evidence_are_noticed(tmp_path: Path) -> None:
    path, evidence = tmp_path / "e.safetensors", random_evidence(15, VIEWS, 3)
    digest = evidence.save(path, key="a")
    assert digest == read_evidence(path, key="a").digest != evidence.save(tmp_path / "f.safetensors")
    for key in ("", "b"):
        with pytest.raises(ValueError, match=r"is damaged.*digest"):
            Evidence.load(path, key=key)
    whole = path.read_bytes()
    for bit in some_bits(whole):
        path.write_bytes(flipped(whole, bit))
        with pytest.raises(ValueError, match=r"e\.safetensors is damaged"):
            Evidence.load(path, key="a")
    path.write_bytes(whole)
    facts = {k: v for k, v in load_arrays(path, key="a").metadata.items() if k != "digest"}
    save_file(load_file(path), path, metadata=facts)
    assert same_evidence(Evidence.load(path), evidence)  # as version 0.1 wrote it, where it has no key
    with pytest.raises(ValueError, match="its metadata has none"):
        Evidence.load(path, key="a")
    double = random_evidence(15, VIEWS, 3, dtype=torch.float64)
    double.save(path)
    assert same_evidence(Evidence.load(path), double)


def test_a_digest_covers_names_types_shapes_numbers_facts_and_key() -> None:
    base, facts = {"a": torch.arange(6.0), "b": torch.ones(2)}, {"f": "1"}
    digests = [
        array_digest(base, facts),
        array_digest(base, facts, "key"),
        array_digest(base, {"f": "2"}),
        array_digest(base, {"g": "1"}),
        array_digest({"a": base["b"], "b": base["a"]}, facts),
        array_digest({**base, "a": base["a"].view(2, 3)}, facts),
        array_digest({**base, "a": base["a"].view(torch.int32)}, facts),
        array_digest({**base, "c": torch.zeros(0)}, facts),
        array_digest({**base, "b": torch.tensor([1.0, 1.0000001])}, facts),
    ]
    assert len(set(digests)) == len(digests)
    assert array_digest(dict(reversed(base.items())), facts) == digests[0]
    strided = torch.stack([base["a"], base["a"]], dim=1)[:, 0]
    assert array_digest({**base, "a": strided}, facts) == digests[0]


def test_tensors_of_any_kind_come_back_and_the_same_content_is_the_same_file(tmp_path: Path) -> None:
    kinds = (torch.zeros(0, 3), torch.tensor(3.0), torch.ones(2).bfloat16(), torch.tensor([True]), torch.ones(2).half())
    for i, tensor in enumerate(kinds):
        digest = save_arrays(tmp_path / str(i), {"größe/\n": tensor}, {"fact": "ü"})
        tensors, facts, found = load_arrays(tmp_path / str(i), framework="pt")
        assert (facts, found) == ({"fact": "ü"}, digest)
        assert torch.equal(tensors["größe/\n"], tensor)
        array = tensor.float().numpy()
        check_array("a", array, "float32", array.shape, 0, 3)
        with pytest.raises(ValueError, match="a is "):
            check_array("a", array, "float32", (*array.shape, 1), 0, 3)
    # The same content is the same file
    contents = set()
    tensors = {"größe": torch.ones(3), "b\n\x01": torch.zeros(2).half()}
    facts = {"a": "1\t/", "b": "ü\x7f\\", "c": '"'}
    for i in range(20):  # safetensors alone makes many files of it
        save_arrays(tmp_path / f"same{i}", tensors, facts)
        contents.add((tmp_path / f"same{i}").read_bytes())
    assert load_arrays(tmp_path / "same0").metadata == facts
    assert len(contents) == 1


def test_a_manifest_may_say_anything(tmp_path: Path) -> None:
    needed = {"schema_version": 1, "num_gaussians": 3, "dimension": 2, "means_fingerprint": "", "form": "float16"}
    facts = {**needed, "digest": "mine", "text": '"digest": ""', "deep": {"digest": "", "ü": [1e-05, None]}}
    write_manifest(tmp_path, facts, {"a": "b"})
    assert read_manifest(tmp_path) == ({k: v for k, v in facts.items() if k != "digest"}, {"a": "b"})
    path = tmp_path / MANIFEST_FILE
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))  # as a copy by way of Windows may have it
    assert read_manifest(tmp_path)[1] == {"a": "b"}
    deep = '{"schema_version": 1, "encoder": ' + "[" * 900 + "]" * 900 + "}"
    for text in ("[" * 10**6, '{"a":' * 10**6, deep, "[]", "null", "{", "ÿ"):
        path.write_bytes(text.encode("latin1"))
        with pytest.raises(InputError, match=r"manifest\.json|schema version None"):
            read_manifest(tmp_path)
    for text, found in (('{"schema_version": 1, "digest": 7}', "damaged.* 7"), ('{"schema_version": 99}', " 99.* 1")):
        path.write_text(text)
        with pytest.raises(InputError, match=found):
            read_manifest(tmp_path)
    with path.open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(InputError, match=r"1,099,511,627,776"):
        read_manifest(tmp_path)


@pytest.mark.usefixtures("unchecked")
def test_manifests_with_hostile_values_and_a_right_digest(tmp_path: Path) -> None:
    field = example("float16")
    more = {"encoder": {"encoder": "open_clip", "text_vectors": None}, "features": {"kind": "given", "content": "0"}}
    SemanticField(field.scalars, field.source, field.store, {**field.manifest, **more}, field.means).save(tmp_path)
    facts = json.loads((tmp_path / MANIFEST_FILE).read_text())
    facts.pop("digest", None)

    def seal(content: bytes) -> bytes:
        text = content.decode().replace("{", '{"digest": "", ', 1)
        return text.replace('"digest": ""', f'"digest": "{text_digest(text)}"', 1).encode()

    def load() -> None:
        survives(lambda: check_file_digests(tmp_path))
        SemanticField.load(tmp_path, field.means)

    fuzz(15, hostile_json(facts).map(seal), tmp_path / MANIFEST_FILE, load)


@pytest.mark.usefixtures("unchecked")
def test_damaged_files_without_digests(tmp_path: Path) -> None:
    field = example("evidence")
    field.save(tmp_path)
    as_version_0_1(tmp_path)
    for path in sorted(tmp_path.iterdir()):
        whole = path.read_bytes()
        fuzz(10, damaged(whole), path, lambda: SemanticField.load(tmp_path, field.means))
        path.write_bytes(whole)


def test_evidence_of_counts_and_views_that_cannot_be(tmp_path: Path) -> None:
    path = tmp_path / "e.safetensors"
    random_evidence(15, VIEWS, 3).save(path)
    tensors, facts, _ = load_arrays(path, framework="pt")
    views = tensors["region_view"]
    unlabeled = {name: rows for name, rows in tensors.items() if name.startswith("unlabeled")}
    for facts_changed, tensors_changed, message in (
        ({"num_views": "-1"}, {}, "num_views.*-1, 1, 0"),
        ({"weight_power": "3"}, {}, "weight_power.*4, 3, 0"),
        ({"num_excluded": "16"}, {}, "num_excluded.*4, 1, 16"),
        ({"num_excluded": "-1"}, {}, "num_excluded.*4, 1, -1"),
        ({"format": "other"}, {}, "'other'"),
        ({}, {"region_view": views.flip(0)}, "decrease"),
        ({}, {"region_view": views + 1}, r"1\.\.4.* 0\.\.3"),
        ({}, {"region_view": views.long()}, "region_view .*int64.*int32"),
        ({"num_views": "²"}, {}, "damaged .*²"),
        ({}, {"region_view": None}, "damaged .*region_view"),
        ({}, {name: rows[: "offsets" in name] for name, rows in unlabeled.items()}, "unlabeled pixels"),
        ({"num_excluded": "15"}, {}, None),
    ):
        content = {name: x for name, x in {**tensors, **tensors_changed}.items() if x is not None}
        save_arrays(path, content, {**facts, **facts_changed}, overwrite=True)
        if message is None:
            assert Evidence.load(path).num_excluded == 15
        else:
            with pytest.raises(InputError, match=message):
                Evidence.load(path)


def test_a_large_checkpoint_without_its_end_is_refused_unread(tmp_path: Path) -> None:
    folder, path = tmp_path / "normlift", tmp_path / "nerfstudio_models" / "step-1.ckpt"
    folder.mkdir()
    path.parent.mkdir()
    with path.open("wb") as file:
        file.truncate(10**12)  # a sparse file that would take minutes to read
    write_manifest(folder, example().manifest, {"../nerfstudio_models/step-1.ckpt": "0" * 16})
    with pytest.raises(InputError, match=r"step-1\.ckpt"):
        check_file_digests(folder)
