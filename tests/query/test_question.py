import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from normlift_ns import InputError
from normlift_ns.io.arrays import save_arrays
from normlift_ns.io.run_dir import read_manifest, write_manifest
from normlift_ns.query.question import Query, load_query, save_query
from normlift_ns.query.text_encoder import encoder_digest
from tests.hostile import damaged, fuzz, hostile_json, no_files
from tests.io.test_digests import flipped

WHOLE = Query(
    ("a; b", "größe\n"), torch.eye(3)[:2], ("c",), torch.ones(1, 3), "margin", 0.02, min_reliability=0.5, refined=False
)


def test_what_is_stored_is_loaded(tmp_path: Path) -> None:
    assert load_query(tmp_path) is None
    save_query(tmp_path, Query(("old",), torch.ones(1, 3)))
    for question in (WHOLE, Query(("a",), torch.eye(3)[:1])):
        save_query(tmp_path, question)
        loaded = load_query(tmp_path)
        assert loaded is not None
        for name, value in vars(question).items():
            if isinstance(value, np.ndarray):
                assert np.array_equal(getattr(loaded, name), value) and getattr(loaded, name).dtype == value.dtype
            else:
                assert getattr(loaded, name) == value
        assert [path.name for path in tmp_path.iterdir()] == ["queries.safetensors"]


def test_nothing_is_stored_in_a_run_that_is_gone_or_was_replaced(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"normlift "):
        save_query(tmp_path / "normlift", WHOLE)
    assert list(tmp_path.iterdir()) == []
    manifest = {"num_gaussians": 1, "means_fingerprint": "", "form": "float16", "schema_version": 1, "features": {}}
    write_manifest(tmp_path, {**manifest, "dimension": 4}, {})
    with pytest.raises(InputError, match=r" 3 .* 4"):
        save_query(tmp_path, WHOLE)
    assert not (tmp_path / "queries.safetensors").exists()


FACTS = {"texts": ["a"], "negatives": [], "form": "cosine", "threshold": 0.5, "min_reliability": 0, "refined": True}


def damaged_question(message: str) -> Any:
    return pytest.raises(InputError, match=rf"queries\.safetensors .*{message}.*--save-query True")


def test_a_damaged_file_says_what_to_do(tmp_path: Path) -> None:
    more = [json.dumps(facts) for facts in ({**FACTS, "texts": ["a", "b"]}, {**FACTS, "form": "dot"}, {})]
    for facts in (None, "{", "[]", *more):
        metadata = None if facts is None else {"question": facts}
        save_file({"vectors": torch.eye(3)[:1]}, tmp_path / "queries.safetensors", metadata=metadata)
        with damaged_question(""):
            load_query(tmp_path)
    path = save_query(tmp_path, WHOLE)
    whole = path.read_bytes()
    for bit in range(0, 8 * len(whole), 43):
        path.write_bytes(flipped(whole, bit))
        with damaged_question(""):
            load_query(tmp_path)
    for what in no_files(path):
        if what == "nothing":
            assert load_query(tmp_path) is None
        else:
            with pytest.raises(InputError, match=r"queries\.safetensors is (damaged|not a regular file)"):
                load_query(tmp_path)


def store(folder: Path, facts: object, **tensors: torch.Tensor) -> Path:
    """A whole file, with a digest, of what no version of ours would write."""
    given = {"vectors": torch.eye(3)[:1], **tensors}
    text = facts if isinstance(facts, str) else json.dumps(facts)
    save_arrays(folder / "queries.safetensors", given, {"question": text}, overwrite=True)
    return folder / "queries.safetensors"


def test_facts_have_their_types_and_ranges(tmp_path: Path) -> None:
    for changes, message in (
        ({"refined": "false"}, "bool.*str"),
        ({"threshold": True}, "float.*bool"),
        ({"threshold": float("nan")}, "malformed"),
        ({"min_reliability": 1.5}, "float.*<= 1"),
        ({"min_reliability": -0.1}, "float.*>= 0"),
        ({"texts": "a"}, "array.*str"),
        ({"texts": []}, "length >= 1"),
        ({"texts": [" "]}, "regex"),
        ({"negatives": ["b"]}, "negatives is 1"),
        ({"form": "lerf"}, "'lerf'.*negatives"),
        ({"form": "dot"}, "'dot'"),
        ({"more": 1}, "`more`"),
    ):
        store(tmp_path, {**FACTS, **changes})
        with damaged_question(message):
            load_query(tmp_path)


def test_a_question_of_another_run_is_refused(tmp_path: Path) -> None:
    manifest = {"num_gaussians": 1, "means_fingerprint": "", "form": "float16", "schema_version": 1, "dimension": 3}
    for name, weights in (("a", "first"), ("b", "second"), ("c", None)):
        features = {} if weights is None else {"encoder": {"kind": "open_clip", "pretrained": weights}}
        write_manifest(tmp_path / name, {**manifest, "features": features}, {})
    first = encoder_digest(read_manifest(tmp_path / "a")[0])
    path = save_query(tmp_path / "a", replace(WHOLE, encoder=first))
    assert load_query(tmp_path / "a") is not None
    for name in ("b", "c"):
        shutil.copy(path, tmp_path / name)
    with pytest.raises(InputError, match=r"queries\.safetensors cannot be used .*another encoder"):
        load_query(tmp_path / "b")
    assert load_query(tmp_path / "c") is not None  # nobody knows
    save_query(tmp_path / "b", WHOLE)  # of a click
    assert load_query(tmp_path / "b") is not None
    (tmp_path / "a" / "manifest.json").unlink()
    write_manifest(tmp_path / "a", {**manifest, "dimension": 4}, {})
    with pytest.raises(InputError, match=r" 3 .* 4"):
        load_query(tmp_path / "a")


def test_vectors_fit_the_texts(tmp_path: Path) -> None:
    for tensors, message in (
        ({"vectors": torch.eye(3)}, r"float32 \(3, 3\).* float32 \(1, 3\)"),
        ({"vectors": torch.ones(1, 0)}, r"\(1, 0\)"),
        ({"vectors": torch.ones(1, 3, dtype=torch.float64)}, "float64"),
        ({"vectors": torch.zeros(1, 3)}, "'a' is zero"),
        ({"vectors": torch.tensor([[1.0, -torch.inf, 1.0]])}, "'a' is zero or not finite"),
        ({"negative_vectors": torch.ones(1, 3)}, "negatives is 0"),
        ({"others": torch.ones(1, 3)}, "others"),
    ):
        store(tmp_path, FACTS, **tensors)
        with damaged_question(message):
            load_query(tmp_path)
    facts = {**FACTS, "negatives": ["b", "c"], "form": "lerf"}
    store(tmp_path, facts, negative_vectors=torch.ones(2, 3))
    assert load_query(tmp_path) is not None
    for wrong in (torch.ones(1, 3), torch.ones(2, 4), torch.zeros(2, 3)):
        store(tmp_path, facts, negative_vectors=wrong)
        with damaged_question("(array negative_vectors|'b' is zero)"):
            load_query(tmp_path)


def test_a_question_that_could_not_be_loaded_is_not_stored(tmp_path: Path) -> None:
    for changes in (
        {"threshold": float("nan")},
        {"min_reliability": 2.0},
        {"texts": ("a", " ")},
        {"embeddings": torch.zeros(2, 3)},
        {"texts": ("a", "\ud800")},
    ):
        with pytest.raises(InputError, match="cannot be stored"):
            save_query(tmp_path, replace(WHOLE, **changes))  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_hostile_facts_and_damaged_files_raise_our_errors_only(tmp_path: Path) -> None:
    path = save_query(tmp_path, WHOLE)
    whole = damaged(path.read_bytes())
    forged = hostile_json(FACTS).map(lambda text: store(tmp_path, text.decode()).read_bytes())
    for contents in (forged, whole):
        fuzz(15, contents, path, lambda: load_query(tmp_path))
