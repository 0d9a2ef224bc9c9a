from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from normlift_ns.asking import Question
from normlift_ns.runs.question import load_question, save_question

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
        if isinstance(value, torch.Tensor):
            assert torch.equal(getattr(loaded, name), value)
        else:
            assert getattr(loaded, name) == value
    assert [path.name for path in tmp_path.iterdir()] == ["queries.safetensors"]


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
