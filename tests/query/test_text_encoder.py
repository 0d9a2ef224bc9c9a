"""The encoder that answers is the one that made the field."""

import os
import re
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from normlift_ns import SemanticField
from normlift_ns.encoders.open_clip_network import OpenClipEncoder
from normlift_ns.encoders.text_files import CachedTextEncoder, TextEmbeddingFile
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import file_digest
from normlift_ns.options import DEFAULT_MODEL, SourceOptions
from normlift_ns.query.text_encoder import (
    ENCODER_KEYS,
    encoder_settings,
    precomputed_settings,
    text_encoder_for,
    with_text_source,
)
from tests.io.test_digests import example


def field_with(settings: dict[str, Any], features: dict[str, Any]) -> SemanticField:
    field = example("float16")
    return replace(field, manifest={**field.manifest, "encoder": settings, "features": features})


@pytest.mark.parametrize("kind", ["regions", "langsplat", "version 0.1"])
def test_replaced_weights_are_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "w.pt"
    path.write_bytes(b"weights" * 1000)
    source = SourceOptions(encoder_pretrained=str(path))
    identity = OpenClipEncoder(DEFAULT_MODEL, str(path)).identity
    if kind == "version 0.1":
        identity["pretrained"] = f"blake2b:{blake2b(path.read_bytes(), digest_size=16).hexdigest()}"
    features = {
        "regions": {"regions": {"kind": "grid"}, "levels": [], "encoder": identity},
        "langsplat": {"kind": "langsplat", "level": "l", "texts": identity},
    }
    field = field_with(encoder_settings(source), features.get(kind, features["regions"]))
    encoder = text_encoder_for(field, cache=tmp_path / "texts")
    assert isinstance(encoder, CachedTextEncoder)
    content = bytearray(path.read_bytes())
    content[77] ^= 1
    stamps = path.stat()
    path.write_bytes(content)
    os.utime(path, ns=(stamps.st_atime_ns, stamps.st_mtime_ns))  # as old and as large as before
    with pytest.raises(InputError) as caught:
        text_encoder_for(field, cache=tmp_path / "texts")
    expected = identity["pretrained"]
    for part in (str(path), file_digest(path, compare_to=expected), expected, "--text-embeddings", "lift again"):
        assert part in str(caught.value)
    assert "--encoder-pretrained" not in str(caught.value)  # ns-normlift-query has no such flag
    template = with_text_source(field, template="a {}")
    with pytest.raises(InputError, match="expected"):
        text_encoder_for(template)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=rf"{path}.* --text-embeddings") as missing:
        text_encoder_for(field)
    assert "--encoder-pretrained" not in str(missing.value)
    np.savez(tmp_path / "own.npz", fox=np.ones(12, np.float32))  # the user's choice needs no weights
    own = with_text_source(field, text_embeddings=tmp_path / "own.npz")
    assert isinstance(text_encoder_for(own), TextEmbeddingFile)


def test_relative_paths_are_stored_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("w.pt").write_bytes(b"a")
    settings = encoder_settings(SourceOptions(encoder_pretrained="w.pt", text_embeddings=Path("t.npz")))
    assert set(settings) == set(ENCODER_KEYS)
    assert settings["encoder_pretrained"] == str(tmp_path / "w.pt")
    assert settings["text_vectors"] == str(tmp_path / "t.npz")
    assert encoder_settings(SourceOptions("open_clip"))["encoder_pretrained"] == "laion2b_s34b_b88k"  # a tag is no path


def test_a_relative_path_of_version_0_1_finds_the_same_file_or_none(tmp_path, monkeypatch) -> None:
    settings = {**encoder_settings(SourceOptions("open_clip")), "encoder_pretrained": "w.pt"}
    content = f"blake2b:{blake2b(b'right', digest_size=16).hexdigest()}"
    field = field_with(settings, {"encoder": {"kind": "open_clip", "pretrained": content}})
    for name, text in (("a", b"right"), ("b", b"wrong")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "w.pt").write_bytes(text)
    monkeypatch.chdir(tmp_path / "a")
    text_encoder_for(field)
    monkeypatch.chdir(tmp_path / "b")
    with pytest.raises(InputError, match=re.escape(content)):
        text_encoder_for(field)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"weight file w\.pt"):
        text_encoder_for(field)


def test_a_file_that_is_called_like_the_tag_is_not_taken_for_it(tmp_path, monkeypatch) -> None:
    tag = SourceOptions().encoder_pretrained
    features = {"encoder": {"kind": "open_clip", "pretrained": tag}}
    field = field_with(encoder_settings(SourceOptions("open_clip")), features)
    text_encoder_for(field)
    monkeypatch.chdir(tmp_path)
    Path(tag).write_bytes(b"weights")
    with pytest.raises(InputError, match=f"expected {tag}"):
        text_encoder_for(field)


def test_replaced_text_vectors_are_refused_unless_they_are_chosen(tmp_path: Path) -> None:
    path = tmp_path / "t.npz"
    np.savez(path, fox=np.ones(12, np.float32))
    settings = encoder_settings(SourceOptions(features="langsplat", text_embeddings=path))
    field = field_with(settings, {"kind": "langsplat", "level": "l", "texts": TextEmbeddingFile(path).identity})
    assert torch.is_tensor(text_encoder_for(field).text(["fox"]))
    np.savez(path, fox=np.arange(12, dtype=np.float32))
    with pytest.raises(InputError, match=rf"{path} .* text_embeddings"):
        text_encoder_for(field)
    assert torch.is_tensor(text_encoder_for(with_text_source(field, text_embeddings=path)).text(["fox"]))
    path.unlink()
    with pytest.raises(FileNotFoundError, match=str(path)):
        text_encoder_for(field)


def test_features_of_version_0_1_may_say_nothing_of_the_encoder(tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", fox=np.ones(12, np.float32))
    for features in ({}, {"kind": "given", "content": "0"}, {"encoder": 3}, {"encoder": {"pretrained": None}}):
        given = field_with(precomputed_settings(str(tmp_path / "t.npz")), features)
        assert isinstance(text_encoder_for(given), TextEmbeddingFile)
        text_encoder_for(field_with(encoder_settings(SourceOptions("open_clip")), features))
