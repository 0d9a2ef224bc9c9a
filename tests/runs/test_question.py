from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from safetensors.torch import save_file

from normlift_ns import InputError
from normlift_ns.core.disk.manifest import read_manifest, write_manifest
from normlift_ns.core.disk.tensors import save_tensors
from normlift_ns.question import Question
from normlift_ns.runs.question import load_question, save_question
from normlift_ns.text_encoders import encoder_digest
from tests.hostile import EXAMPLES, damaged, fuzz, hostile_json, no_files, survives

WHOLE = Question(
    ("a; b", "größe\n"), torch.eye(3)[:2], ("c",), torch.ones(1, 3), "margin", 0.02, min_reliability=0.5, refined=False
)


@pytest.mark.parametrize("question", [WHOLE, Question(("a",), torch.eye(3)[:1])])
def test_what_is_stored_is_loaded(question: Question, tmp_path: Path) -> None:
    assert load_question(tmp_path) is None
    save_question(tmp_path, Question(("old",), torch.ones(1, 3)))
    save_question(tmp_path, question)
    loaded = load_question(tmp_path)
    assert loaded is not None
    for name, value in vars(question).items():
        if isinstance(value, np.ndarray):
            assert np.array_equal(getattr(loaded, name), value) and getattr(loaded, name).dtype == value.dtype
        else:
            assert getattr(loaded, name) == value
    assert [path.name for path in tmp_path.iterdir()] == ["queries.safetensors"]


def test_nothing_is_stored_in_a_run_that_is_gone_or_was_replaced(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"normlift is gone: .* moved or deleted .* nothing was stored"):
        save_question(tmp_path / "normlift", WHOLE)
    assert list(tmp_path.iterdir()) == []
    manifest = {"num_gaussians": 1, "means_fingerprint": "", "form": "float16", "schema_version": 1, "features": {}}
    write_manifest(tmp_path, {**manifest, "dimension": 4}, {})
    with pytest.raises(InputError, match="its vectors have 3 numbers, the features of the run 4"):
        save_question(tmp_path, WHOLE)
    assert not (tmp_path / "queries.safetensors").exists()


FACTS = {"texts": ["a"], "negatives": [], "form": "cosine", "threshold": 0.5, "min_reliability": 0, "refined": True}


@pytest.mark.parametrize(
    "facts",
    [None, "{", "[]", json.dumps({**FACTS, "texts": ["a", "b"]}), json.dumps({**FACTS, "form": "dot"}), json.dumps({})],
)
def test_a_damaged_file_says_what_to_do(facts: str | None, tmp_path: Path) -> None:
    metadata = None if facts is None else {"question": facts}
    save_file({"vectors": torch.eye(3)[:1]}, tmp_path / "queries.safetensors", metadata=metadata)
    with pytest.raises(ValueError, match=r"queries\.safetensors is damaged .*--save True"):
        load_question(tmp_path)
    (tmp_path / "queries.safetensors").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"queries\.safetensors is damaged"):
        load_question(tmp_path)


def test_every_flipped_bit_is_noticed(tmp_path: Path) -> None:
    path = save_question(tmp_path, WHOLE)
    whole = path.read_bytes()
    for bit in range(0, 8 * len(whole), 7):
        changed = bytearray(whole)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        with pytest.raises(ValueError, match=r"queries\.safetensors is damaged .*--save True"):
            load_question(tmp_path)


def store(folder: Path, facts: object, **tensors: torch.Tensor) -> Path:
    """A whole file, with a digest, of what no version of ours would write."""
    given = {"vectors": torch.eye(3)[:1], **tensors}
    text = facts if isinstance(facts, str) else json.dumps(facts)
    save_tensors(folder / "queries.safetensors", given, {"question": text}, overwrite=True)
    return folder / "queries.safetensors"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"refined": "false"}, "Expected `bool`, got `str`"),
        ({"refined": 0}, "Expected `bool`, got `int`"),
        ({"threshold": "0.5"}, "Expected `float`, got `str`"),
        ({"threshold": True}, "Expected `float`, got `bool`"),
        ({"threshold": None}, "Expected `float`, got `null`"),
        ({"threshold": float("nan")}, "malformed"),
        ({"min_reliability": 1.5}, "Expected `float` <= 1"),
        ({"min_reliability": -0.1}, "Expected `float` >= 0"),
        ({"texts": "a"}, "Expected `array`, got `str`"),
        ({"texts": []}, "length >= 1"),
        ({"texts": [3]}, "Expected `str`, got `int`"),
        ({"texts": [" "]}, "matching regex"),
        ({"negatives": ["b"]}, "1 negatives, no vectors"),
        ({"form": "lerf"}, "rule 'lerf' compares with negatives, and there are none"),
        ({"form": "dot"}, "Invalid enum value 'dot'"),
        ({"more": 1}, "unknown field `more`"),
    ],
)
def test_facts_have_their_types_and_ranges(changes: dict[str, object], message: str, tmp_path: Path) -> None:
    store(tmp_path, {**FACTS, **changes})
    with pytest.raises(InputError, match=rf"queries\.safetensors is damaged \(.*{message}.*--save True"):
        load_question(tmp_path)


def test_a_question_of_another_run_is_refused(tmp_path: Path) -> None:
    manifest = {"num_gaussians": 1, "means_fingerprint": "", "form": "float16", "schema_version": 1, "dimension": 3}
    for name, weights in (("a", "first"), ("b", "second"), ("c", None)):
        features = {} if weights is None else {"encoder": {"kind": "open_clip", "pretrained": weights}}
        write_manifest(tmp_path / name, {**manifest, "features": features}, {})
    first = encoder_digest(read_manifest(tmp_path / "a")[0])
    path = save_question(tmp_path / "a", replace(WHOLE, encoder=first))
    assert load_question(tmp_path / "a") is not None
    for name in ("b", "c"):
        shutil.copy(path, tmp_path / name)
    with pytest.raises(InputError, match=r"queries\.safetensors is damaged .*read by another encoder"):
        load_question(tmp_path / "b")
    assert load_question(tmp_path / "c") is not None  # nobody knows
    save_question(tmp_path / "b", WHOLE)  # of a click
    assert load_question(tmp_path / "b") is not None
    (tmp_path / "a" / "manifest.json").unlink()
    write_manifest(tmp_path / "a", {**manifest, "dimension": 4}, {})
    with pytest.raises(InputError, match="its vectors have 3 numbers, the features of the run 4"):
        load_question(tmp_path / "a")


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({"vectors": torch.eye(3)}, r"vectors of 1 texts is float32 \(3, 3\), expected float32 \(1, 3\)"),
        ({"vectors": torch.ones(3)}, r"is float32 \(3,\)"),
        ({"vectors": torch.tensor(1.0)}, r"is float32 \(\)"),
        ({"vectors": torch.ones(1, 0)}, r"\(1, 0\)"),
        ({"vectors": torch.ones(1, 3, dtype=torch.float64)}, "is float64"),
        ({"vectors": torch.zeros(1, 3)}, "vector of 'a' is zero or not finite"),
        ({"vectors": torch.tensor([[1.0, torch.nan, 1.0]])}, r"numbers in nan\.\.nan"),
        ({"vectors": torch.tensor([[1.0, -torch.inf, 1.0]])}, "vector of 'a' is zero or not finite"),
        ({"negative_vectors": torch.ones(1, 3)}, "0 negatives, some vectors of them"),
        ({"others": torch.ones(1, 3)}, "it holds others, vectors"),
    ],
)
def test_vectors_fit_the_texts(tensors: dict[str, torch.Tensor], message: str, tmp_path: Path) -> None:
    store(tmp_path, FACTS, **tensors)
    with pytest.raises(InputError, match=rf"queries\.safetensors is damaged \(.*{message}"):
        load_question(tmp_path)


def test_negatives_fit_theirs(tmp_path: Path) -> None:
    facts = {**FACTS, "negatives": ["b", "c"], "form": "lerf"}
    store(tmp_path, facts, negative_vectors=torch.ones(2, 3))
    assert load_question(tmp_path) is not None
    for wrong in (torch.ones(1, 3), torch.ones(2, 4), torch.zeros(2, 3)):
        store(tmp_path, facts, negative_vectors=wrong)
        with pytest.raises(InputError, match=r"negative_vectors of 2 texts|vector of 'b' is zero"):
            load_question(tmp_path)


@pytest.mark.parametrize(
    "changes",
    [
        {"threshold": float("nan")},
        {"threshold": float("inf")},
        {"min_reliability": 2.0},
        {"texts": ("a", " ")},
        {"vectors": torch.zeros(2, 3)},
        {"negatives": ()},
        {"texts": ("a", "\ud800")},
    ],
)
def test_a_question_that_could_not_be_loaded_is_not_stored(changes: dict[str, object], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the question cannot be stored"):
        save_question(tmp_path, replace(WHOLE, **changes))  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("examples", EXAMPLES)
def test_hostile_facts_raise_our_errors_only(examples: int, tmp_path: Path) -> None:
    @settings(max_examples=examples, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(hostile_json(FACTS))
    def run(text: bytes) -> None:
        store(tmp_path, text.decode())
        survives(lambda: load_question(tmp_path))

    run()


@pytest.mark.parametrize("examples", EXAMPLES)
def test_damaged_files_raise_our_errors_only(examples: int, tmp_path: Path) -> None:
    path = save_question(tmp_path, WHOLE)
    fuzz(examples, damaged(path.read_bytes()), path, lambda: load_question(tmp_path))


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    for what in no_files(tmp_path / "queries.safetensors"):
        if what == "nothing":
            assert load_question(tmp_path) is None
        else:
            with pytest.raises(InputError, match=r"queries\.safetensors is damaged"):
                load_question(tmp_path)
