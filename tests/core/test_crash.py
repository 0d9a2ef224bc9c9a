"""What is said of errors, and where tracebacks go."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

import pytest

from normlift_ns.crash import explain, log_traceback
from normlift_ns.errors import InputError, visible


def raised(error: Exception) -> Exception:
    try:
        raise error
    except Exception as caught:
        return caught


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (InputError("beta must be positive"), "beta must be positive"),
        (FileNotFoundError(2, "No such file or directory", "a.txt"), "a.txt: No such file or directory"),
        (PermissionError(13, "Permission denied", "a"), "a: Permission denied"),
        (OSError("field.safetensors cannot be written (disk full)"), "field.safetensors cannot be written (disk full)"),
        (OSError(28, "No space left on device"), "No space left on device"),
        (MemoryError(), "the memory is full; lift fewer or smaller views: --max-views, --lift-downscale"),
        (MemoryError("the GPU's memory is full"), "the GPU's memory is full"),
    ],
)
def test_mistakes_of_the_user_are_told_as_they_are(error, message, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert explain(raised(error)) == (message, 1)
    assert list(tmp_path.iterdir()) == []


def test_a_full_gpu_is_no_bug(monkeypatch, tmp_path):
    import torch  # noqa: PLC0415

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    message, code = explain(raised(torch.cuda.OutOfMemoryError("CUDA out of memory.\nTried to allocate 2 GiB")))
    assert code == 1 and "(CUDA out of memory.)" in message and "--device cpu" in message


def test_a_torch_without_its_numpy_is_no_bug():
    message, code = explain(raised(RuntimeError("Numpy is not available")))
    assert code == 1 and "pip install 'numpy<2'" in message


@pytest.mark.parametrize("error", [ValueError("wrong"), KeyError("x"), RecursionError("deep"), AssertionError()])
def test_ours_are_written_to_a_file_of_the_user_alone(error, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    message, code = explain(raised(error))
    (log,) = (tmp_path / "state" / "normlift_ns").iterdir()
    assert code == 70
    assert f"This is a bug of normlift_ns: {type(error).__name__}" in message and str(log) in message
    assert str(os.getpid()) in log.name
    assert "Traceback" in log.read_text() and "in raised" in log.read_text()
    assert stat.S_IMODE(log.stat().st_mode) == 0o600


def test_without_a_state_folder_the_temporary_one_is_taken(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    log = log_traceback(raised(ValueError("x")))
    assert log is not None and log.parent == tmp_path


def test_without_any_folder_the_traceback_is_printed(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("normlift_ns.crash._folders", lambda: [Path(os.devnull)])
    message, code = explain(raised(ValueError("x")))
    assert code == 70 and "The details are above" in message
    assert "Traceback" in capsys.readouterr().err


def test_only_the_first_line_of_a_foreign_message_is_shown(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    message, _ = explain(raised(RuntimeError("first\nsecond" + "x" * 9999)))
    assert "RuntimeError: first. The" in message and "second" not in message


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain [/red] :smile: 中文 é", "plain [/red] :smile: 中文 é"),
        ("\x1b[31mred", "\\x1b[31mred"),
        ("a\nb\tc\rd\0", "a\\nb\\tc\\rd\\x00"),
        ("\u202eabc\u200f", "\\u202eabc\\u200f"),
        ("\udc80", "\\udc80"),
        ("\x9b31m", "\\x9b31m"),
    ],
)
def test_control_characters_are_shown_as_escapes(text, shown):
    assert visible(text) == shown
    visible(text).encode("utf8")
