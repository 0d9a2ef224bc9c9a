"""ns-normlift-query --segment sam3, and --regions sam3: a network of the real kind whose answers are red pixels."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from normlift_ns import LiftOptions, SourceOptions, lift_run
from normlift_ns.cli import query
from normlift_ns.segmentation.sam3 import Sam3Network, TextMasks
from tests.cli.conftest import run_entry, said


@pytest.fixture
def asked() -> list[str]:
    return []


@pytest.fixture
def weights(tmp_path, monkeypatch, asked) -> Path:
    def find(self: Sam3Network, image: torch.Tensor, texts: list[str]) -> list[TextMasks]:
        asked.extend(texts)
        r, g, b = image.int().unbind(2)
        there = {"red": (r > 2 * g) & (r > 2 * b) & (r > 60), "green": torch.zeros_like(r, dtype=torch.bool)}
        return [TextMasks(there[text][None], torch.tensor([0.9])) for text in texts]

    monkeypatch.setattr(Sam3Network, "segment", find)
    from tests.segmentation.tiny_sam import write_tiny  # noqa: PLC0415 (transformers)

    write_tiny(tmp_path / "sam3", "sam3")
    return tmp_path / "sam3"


@pytest.fixture
def segmented(own: Path, weights: Path) -> tuple[object, ...]:
    lifted = own.parents[2] / "normlift" / "t" / "config.yml"
    return ("--load-config", lifted, "--segment", "sam3", "--segment-model", weights, "--segment-views", 4)


def test_sam3_answers_beside_the_run(segmented, tmp_path, monkeypatch, capsys) -> None:
    table, arrays = tmp_path / "table.json", tmp_path / "arrays.npz"
    flags = (*segmented, "--text", "red", "--output-json", table, "--output-npz", arrays)
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    shown = said(capsys)
    assert "SAM 3" in shown and "50%" in shown
    (row,) = json.loads(table.read_text())["queries"]
    found = row["segment"]
    assert len(found["views"]) == 4 and 0 < len(found["agree"]) <= len(found["found_in"]) <= 4
    assert 0 < found["fraction"] < 0.3 and found["iou"] > 0.1
    assert np.allclose(found["centroid"], row["centroid"], atol=0.5)
    assert 0.5 < found["agreement"] <= 1 and 0 < found["mean_reliability"] < 1 and found["peak"] > 0.9
    with np.load(arrays) as kept:
        share, reliability = kept["segment_relevancy"], kept["segment_reliability"]
        assert share.shape == reliability.shape == kept["segment_agreement"].shape == kept["relevancy"].shape
    assert float((share > 0.5).mean()) == pytest.approx(found["fraction"])


@pytest.mark.slow
def test_what_was_found_before_is_kept(own, segmented, weights, asked, tmp_path, monkeypatch, capsys) -> None:
    table, kept = tmp_path / "table.json", own.parents[2] / "normlift" / ".cache" / "masks"

    def ask(*more: str) -> dict:
        flags = (*segmented, "--output-json", table, "--overwrite", "True", "--threshold", 0.6)
        assert run_entry(monkeypatch, query.entrypoint, *flags, *more) == 0
        return json.loads(table.read_text())["queries"][0]["segment"]

    first = ask("--text", "red")
    assert asked == ["red"] * 4 and len(list(kept.iterdir())) == 4
    with monkeypatch.context() as without:
        without.setattr(Sam3Network, "load", lambda *_: pytest.fail("the network is not needed"))
        assert ask("--text", "red") == first and len(asked) == 4
    assert ask("--text", "red", "green") == first and asked[4:] == ["green"] * 4
    victim = sorted(kept.iterdir())[0]
    victim.write_bytes(victim.read_bytes()[:-3] + b"\xff\xff\xff")
    other = sorted(kept.iterdir())[1]
    shutil.copy(other, sorted(kept.iterdir())[2])  # under the name of another
    assert ask("--text", "red", "green") == first and len(asked) == 10
    said(capsys)
    sure = ask("--text", "red", "--min-reliability", "0.6")
    assert 0 < sure["fraction"] < first["fraction"] and sure["mean_reliability"] > max(0.6, first["mean_reliability"])
    assert "0.6" in said(capsys)
    config = weights / "config.json"
    config.write_text(config.read_text() + "\n")  # other weights: another digest
    assert ask("--text", "red") == first and len(asked) == 14


def test_what_sam3_finds_can_be_the_regions(little: Path, weights: Path, tmp_path) -> None:
    source = SourceOptions(encoder="color", regions="sam3", sam_model=str(weights))
    how = LiftOptions(max_views=4, refine=False, consensus=False)
    run = lift_run(little, source=source, lift=how, queries=["red"], output_dir=tmp_path, check_alignment=False)
    manifest = run.field.manifest
    assert manifest["source"]["sam3_prompts"] == ["red"] or manifest["source"]["sam3_prompts"] == ("red",)
    assert manifest["features"]["regions"]["texts"] == ["red"]
    seen = float((run.field.scalars.norm > 0).float().mean())
    assert 0 < seen < 0.7  # the rest is unlabelled
    red = run.ask("red")["red"]
    assert red.peak is not None and red.peak > 0.6
