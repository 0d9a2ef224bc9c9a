"""What is said of errors, and where tracebacks go."""

import os
import tempfile
from pathlib import Path

import pytest
import torch

from normlift_ns.errors import InputError, describe_error, escape_unprintable, log_traceback


def raised(error: Exception) -> Exception:
    try:
        raise error
    except Exception as caught:
        return caught


@pytest.fixture(autouse=True)
def state(monkeypatch, tmp_path) -> Path:
    """The user's own folder of state."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "normlift_ns"


def test_mistakes_of_the_user_are_told_as_they_are(state):
    for error, message in (
        (InputError("beta must be positive"), "beta must be positive"),
        (FileNotFoundError(2, "No such file or directory", "a.txt"), "a.txt: No such file or directory"),
        (OSError("field.safetensors cannot be written (disk full)"), "field.safetensors cannot be written (disk full)"),
        (OSError(28, "No space left on device"), "No space left on device"),
        (MemoryError("the GPU's memory is full"), "the GPU's memory is full"),
    ):
        assert describe_error(raised(error)) == (message, 1)
    for error, facts in (
        (MemoryError(), ("memory", "--max-views", "--lift-downscale")),
        (torch.cuda.OutOfMemoryError("CUDA out of memory.\nTried 2 GiB"), ("(CUDA out of memory.)", "--device cpu")),
        (RuntimeError("Numpy is not available"), ("pip install 'numpy<2'",)),
    ):
        message, code = describe_error(raised(error))
        assert code == 1 and all(fact in message for fact in facts), message
    assert not state.exists()


def test_tracebacks_go_to_the_temporary_folder_or_are_printed(monkeypatch, tmp_path, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    log = log_traceback(raised(ValueError("x")))
    assert log is not None and log.parent == tmp_path
    monkeypatch.setattr("normlift_ns.errors._log_folders", lambda: [Path(os.devnull)])
    message, code = describe_error(raised(RuntimeError("first\nsecond" + "x" * 9999)))
    assert code == 70 and "bug" in message
    assert "RuntimeError: first." in message and "second" not in message
    assert "Traceback" in capsys.readouterr().err


def test_control_characters_are_shown_as_escapes():
    for text, shown in (
        ("plain [/red] :smile: 中文 é", "plain [/red] :smile: 中文 é"),
        ("\x1b[31mred", "\\x1b[31mred"),
        ("a\nb\tc\rd\0", "a\\nb\\tc\\rd\\x00"),
        ("\u202eabc\u200f", "\\u202eabc\\u200f"),
        ("\udc80\x9b31m", "\\udc80\\x9b31m"),
    ):
        assert escape_unprintable(text) == shown
        escape_unprintable(text).encode("utf8")
