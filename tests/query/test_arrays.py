"""Questions without torch: the same answers as with it, from files alone."""

import io
import json
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns import InputError, SemanticField, open_run
from normlift_ns.cli import query
from normlift_ns.cli.query import answer_lines, run_repl
from normlift_ns.core.field import with_null_level
from normlift_ns.core.relevancy import RELEVANCY_RULES
from normlift_ns.io.field import read_field
from normlift_ns.options import RelevancyRule
from normlift_ns.query import arrays, engine
from normlift_ns.query.question import Query
from tests.cli.conftest import run_entry, said
from tests.examples import examples
from tests.io.test_field import FORMS, D, example
from tests.random_scenes import unit_rows


@examples(8)
@given(
    seed=st.integers(0, 50),
    form=st.sampled_from(FORMS),
    rule=st.sampled_from(get_args(RelevancyRule)),
    refined=st.booleans(),
    min_reliability=st.sampled_from([0.0, 0.2, 0.9]),
)
def test_answers_are_those_of_torch(seed, form, rule, refined, min_reliability):
    lifted, means, source = example(seed)
    field = SemanticField.build(lifted, means, source, storage=form, tolerance=2e-3)
    field = with_null_level(field, unit_rows(5, D, seed + 8).float())
    vectors, negatives = (100 * unit_rows(count, D, seed + 7).float().numpy() for count in (3, 2))
    question = Query(
        ("a", "b", "c"), vectors, ("d", "e"), negatives, rule, 0.1, min_reliability=min_reliability, refined=refined
    )
    expected = engine.run_query(field, means, question)  # all prompts in one block
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(arrays, "_BLOCK_ELEMENTS", 100)  # rows are read in several blocks
        for module in (arrays, engine):
            patch.setattr(module, "PROMPT_BLOCK", 2)
        field.save(folder)
        stored = arrays.ArrayField(*read_field(Path(folder)))
        found = engine.run_query(stored, stored.arrays["means"], question)
    assert all(isinstance(x, np.ndarray) for x in (found.relevancy, found.valid, found.selected, found.mask))
    np.testing.assert_allclose(found.relevancy, expected.relevancy.numpy(), rtol=0, atol=2e-6)
    assert np.array_equal(found.valid, expected.valid.numpy())
    near = np.abs(expected.relevancy.numpy() - 0.1) < 2e-6
    assert np.array_equal(found.selected | near, expected.selected.numpy() | near)
    if not near.any():
        for ours, theirs in zip(found.to_json(), expected.to_json(), strict=True):
            assert set(ours) == set(theirs)
            bins, same = ours.pop("histogram"), theirs["histogram"]
            assert (bins is None) == (same is None)
            assert bins is None or sum(bins.pop("counts")) == sum(same.pop("counts")) == found.valid.sum()
            assert bins == (None if same is None else pytest.approx(same, abs=1e-5))
            for name, value in ours.items():
                assert value == (pytest.approx(theirs[name], abs=1e-5) if value is not None else None), name


def test_every_rule_is_in_the_table_and_vectors_of_another_encoder_are_refused(tmp_path):
    assert set(RELEVANCY_RULES) == set(get_args(RelevancyRule))
    lifted, means, source = example()
    SemanticField.build(lifted, means, source).save(tmp_path)
    with pytest.raises(InputError, match=rf"must have shape \[Q, {D}\].*got \(1, 3\)"):
        arrays.ArrayField(*read_field(tmp_path)).query(np.ones((1, 3), np.float32))


BLOCK = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name in ("torch", "nerfstudio", "open_clip"):
            raise AssertionError(f"{name} is imported")

sys.meta_path.insert(0, Blocked())
from normlift_ns.cli.query import entrypoint
entrypoint()
"""


def ask_without_torch(config: Path, text: str, *flags: object) -> None:
    words = [sys.executable, "-c", BLOCK, "--load-config", config, "--text", text, *flags]
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and text in done.stdout, done.stderr


@pytest.mark.slow
def test_answers_by_vectors_of_a_file_need_no_torch(lifted, tmp_path):
    np.savez(tmp_path / "t.npz", fox=np.ones(343, np.float32))
    ask_without_torch(lifted, "fox", "--text-embeddings", tmp_path / "t.npz")


def test_answers_need_neither_torch_nor_nerfstudio(lifted, tmp_path):
    lifted = shutil.copytree(lifted.parent, tmp_path / "run") / "config.yml"  # others ask what is stored, too
    outputs = ("--output-json", tmp_path / "a.json", "--output-npz", tmp_path / "a.npz", "--save-query")
    ask_without_torch(lifted, "red", "sky blue", *outputs)
    rows = json.loads((tmp_path / "a.json").read_text())["queries"]
    run = open_run(lifted)
    expected = run.ask("red", "sky blue")
    for row, other in zip(rows, expected.to_json(), strict=True):
        bins, same = row.pop("histogram"), other.pop("histogram")
        assert sum(bins.pop("counts")) == sum(same.pop("counts"))
        assert bins == pytest.approx(same, abs=1e-5)
        assert row == {key: pytest.approx(value, abs=1e-5) for key, value in other.items()}
    stored = run.ask_stored()
    assert stored is not None and stored.texts == ("red", "sky blue")
    assert torch.allclose(stored.relevancy, expected.relevancy, rtol=0, atol=1e-6)


def test_lines_become_lines_of_json(lifted, monkeypatch, capsys):
    for flags, lines, code in ((("--stdin",), b"red\n\n  wooden  \nsky blue\n", 1), (("--stdin", "True"), b"red\n", 0)):
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(lines), isatty=lambda: False))
        assert run_entry(monkeypatch, query.entrypoint, "--load-config", lifted, *flags) == code
        shown = capsys.readouterr()
        if code == 1:
            red, wooden, blue = map(json.loads, shown.out.splitlines())
            assert red["text"] == "red" and 0.005 < red["fraction"] < 0.1 and red["rule"] == "cosine"
            assert "color name" in wooden["error"]
            assert blue["threshold"] == 0.7
            assert "1 of 3" in shown.err
    assert run_entry(monkeypatch, query.entrypoint, "--load-config", lifted, "--text", "red") == 0
    assert f"{red['fraction']:.2%}" in said(capsys)


def test_lines_are_answered_as_they_come_also_those_of_windows(lifted, monkeypatch):
    run, shown = arrays.open_quick(lifted), io.StringIO()
    monkeypatch.setattr(sys, "stdout", shown)

    def lines():
        for number, text in enumerate([b"red\n", "blau\xff".encode("latin1"), b"blue"]):
            assert len(shown.getvalue().splitlines()) == number
            yield text

    assert run is not None
    with pytest.raises(InputError, match="1 of 3"):
        answer_lines(run, {}, lines())
    shown.truncate(shown.seek(0))
    answer_lines(run, {}, [b"\xef\xbb\xbfred\r\n"])
    assert json.loads(shown.getvalue())["text"] == "red"
    monkeypatch.setattr(sys, "stdin", None)
    answer_lines(run, {})
    assert len(shown.getvalue().splitlines()) == 1
    monkeypatch.setattr(sys, "stdout", None)
    with pytest.raises(InputError, match="closed"):
        answer_lines(run, {}, [b"red"])


def test_a_person_asks_one_text_after_the_other(lifted, tmp_path, monkeypatch, capsys):
    from prompt_toolkit.application import create_app_session  # noqa: PLC0415 (slow)
    from prompt_toolkit.input import create_pipe_input  # noqa: PLC0415
    from prompt_toolkit.output import DummyOutput  # noqa: PLC0415

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    run = arrays.open_quick(lifted)
    assert run is not None
    with create_pipe_input() as typed, create_app_session(input=typed, output=DummyOutput()):
        typed.send_text("help\nred, yellow\nwooden\n \nsky blue\n\x04")
        run_repl(run, {}, keep_history=True)
        shown = said(capsys)
        assert "sky blue" in shown and "wooden" in shown and '"salt, pepper"' in shown
        assert "red, yellow" not in shown and "yellow" in shown  # two prompts
        history = tmp_path / "normlift_ns" / "history"
        assert stat.S_IMODE(history.stat().st_mode) == 0o600
        before = history.read_text()
        assert "+wooden" in before
        typed.send_text("yellow\nexit\n")
        run_repl(run, {}, keep_history=False)
        assert history.read_text() == before
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
        typed.send_text("yellow\n\x04")
        run_repl(run, {}, keep_history=True)  # no place for it


def test_a_run_with_another_checkpoint_is_opened_whole(lifted, tmp_path):
    """Its own files do not tell then which one the scene is."""
    copy = shutil.copytree(lifted.parent, tmp_path / "run")
    assert arrays.open_quick(copy / "config.yml") is not None
    (checkpoint,) = (copy / "nerfstudio_models").iterdir()
    os.link(checkpoint, copy / "nerfstudio_models" / "step-000099999.ckpt")
    assert arrays.open_quick(copy / "config.yml") is None
    means = torch.zeros(3, 3).numpy()
    opened = arrays.open_quick(copy / "config.yml", means=means)
    assert opened is not None and opened.field.arrays["means"] is means
