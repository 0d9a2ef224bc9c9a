"""Outputs that hit a file of somebody, and input that only looks impossible: a message, and nothing has changed."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from normlift_ns import InputError
from normlift_ns.analysis.objects import csv_text
from normlift_ns.cli import export, lift, query
from normlift_ns.encoders.cache import _are_labels
from normlift_ns.io.arrays import save_arrays
from normlift_ns.io.field import read_field
from normlift_ns.io.run_dir import read_manifest, write_manifest
from tests.cli.conftest import QUICK, run_entry, said
from tests.io.test_digests import example


def digests(folder: Path) -> dict[str, str]:
    return {str(x): hashlib.md5(x.read_bytes()).hexdigest() for x in sorted(folder.rglob("*")) if x.is_file()}


def test_no_output_of_a_command_replaces_what_is_not_ours(own: Path, tmp_path: Path, monkeypatch, capsys):
    run, room, out = own.parents[2] / "normlift" / "t", tmp_path / "own" / "room", tmp_path / "out"
    out.mkdir()
    config, cloud, diary = run / "config.yml", out / "cloud.ply", out / "diary.txt"
    assert run_entry(monkeypatch, export.entrypoint, "--load-config", config, "--output-dir", out,
                     "--output-filename", "cloud.ply") == 0  # fmt: skip
    diary.write_text("mine")
    before, image = digests(tmp_path), next((room / "images").iterdir())
    ask, over = ("--load-config", config, "--text", "red"), ("--overwrite", "True")
    for command, flags, *facts in (
        *((query, (*ask, "--log-file", path), "--log-file") for path in (
            config, run / "normlift" / "field.safetensors", room / "transforms.json", image, diary, cloud,
        )),
        (query, (*ask, "--output-json", room / "transforms.json", *over), "data set"),
        (query, (*ask, "--output-json", run / "normlift" / "manifest.json", *over), "part of the run"),
        (query, (*ask, "--output-json", diary, *over), "diary"),
        (query, (*ask, "--output-npz", cloud, *over), "cloud"),
        (query, ("--load-config", config, "--inventory", "--image", diary, *over), "diary"),
        (export, (*ask, "--output-dir", tmp_path / "new", "--masks-dir", room / "images", *over), "data set"),
        (export, (*ask, "--output-dir", out, "--output-filename", "cloud.ply", "--transfer", cloud, *over), "input"),
        (export, (*ask, "--output-dir", out, "--output-filename", "diary.txt", *over), "diary"),
        (lift, ("--load-config", config, *QUICK, "--timestamp", "t", *over), "which the lift reads"),
        (query, (*ask, "--relevancy", "lerf", "--negatives"), "negatives"),
        (lift, ("--load-config", own, *QUICK, "--regions", "sam", "--sam-model", "~/x"), "~/x"),
    ):  # fmt: skip
        code = run_entry(monkeypatch, command.entrypoint, *flags)
        shown = said(capsys)
        assert code == 1 and all(fact in shown for fact in facts), (flags, shown)
        assert digests(tmp_path) == before, flags


def test_a_log_is_added_to_logs_of_ours_only(ended, tmp_path: Path) -> None:
    log = tmp_path / "a.log"
    for text, code in (
        ("", 0), ("2026-01-01T10:00:00+00:00 /bin/ns-normlift-query --text a\n", 0), ("a\n", 1), ("{}", 1),
        ("2026-01-01T10:00:00+00:00 GET /\n", 1), ("\n2026-01-01T10:00:00+00:00 ns-normlift\n", 1),
    ):  # fmt: skip
        log.write_text(text)
        assert ended(lambda _: None, "--log-file", str(log))[0] == code, text
        assert log.read_text().startswith(text) and (log.read_text() == text) == (code == 1)
    log.write_text("")
    assert ended(lambda _: None, "--word", str(log), "--log-file", str(log))[0] == 1 and log.read_text() == ""


def test_no_cell_of_a_table_is_a_formula() -> None:
    for text in ("=1+1", "+1", "-1", "@a", "\t=1", "\r=1", "  =1", "|a"):
        assert csv_text(text) == f"'{text}"
    assert [csv_text(text) for text in ("red mug", "a=b", "", "1-2")] == ["red mug", "a=b", "", "1-2"]


def test_forged_caches_and_fields_are_damaged(tmp_path: Path) -> None:
    image, labels = torch.zeros(40, 50, 3, dtype=torch.uint8), torch.arange(2000).reshape(1, 1, 40, 50).short()
    assert _are_labels(labels, image)
    for wrong in (32767, 2000, -2, 7):  # too large, one too many, too small, leaves a gap
        forged = labels.clone()
        forged[0, 0, 0, 5] = wrong
        assert not _are_labels(forged, image), wrong
    folder = tmp_path / "field"
    example("evidence").save(folder)
    arrays, (facts, listed) = load_file(folder / "field.safetensors"), read_manifest(folder)
    assert (arrays["weight"] == 0).any()
    arrays["norm"] = np.ones_like(arrays["norm"])
    digest = save_arrays(folder / "field.safetensors", arrays, overwrite=True)
    (folder / "manifest.json").unlink()
    write_manifest(folder, facts, {**(listed or {}), "field.safetensors": digest})
    with pytest.raises(InputError, match="weight 0"):
        read_field(folder)
