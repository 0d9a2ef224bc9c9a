"""Encoders by entry point: how they are found, what a broken one does, the recipe of CONTRIBUTING.md as a package."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

from normlift_ns import encoders
from normlift_ns.cli.preflight import check_source_options
from normlift_ns.data.open_splat import SPLAT_READERS
from normlift_ns.encoders.build import make_source
from normlift_ns.encoders.cache import cached
from normlift_ns.encoders.huggingface import MODEL_FAMILIES, check_transformers_version
from normlift_ns.encoders.registry import ENCODERS, encoder_kind, find_encoder_kind, make_encoder
from normlift_ns.errors import InputError
from normlift_ns.exports import EXPORTERS
from normlift_ns.options import SourceOptions
from normlift_ns.segmentation.registry import MASK_SOURCES
from tests.conftest import project
from tests.encoders.tiny import refused

ROOT = Path(__file__).parents[2]
OURS = ["color", "imagenet", "metaclip2", "open_clip", "siglip", "siglip2"]


def install(folder: Path, package: str, points: str, code: str = "") -> None:
    info = folder / f"{package}-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1\n")
    (info / "entry_points.txt").write_text(points)
    (folder / f"{package}.py").write_text(code)


@contextmanager
def plugged(folder: Path, package: str, points: str, code: str) -> Iterator[None]:
    """Such a package on the path."""
    install(folder, package, points, code)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield
    sys.modules.pop(package, None)


def points(**encoders: str) -> str:
    return f"[{ENCODERS.group}]\n" + "".join(f"{name} = {value}\n" for name, value in encoders.items())


def test_ours_are_registered_in_pyproject_and_built_in() -> None:
    """So that they are found without metadata too, as in a source tree on PYTHONPATH."""
    for registry in (ENCODERS, MASK_SOURCES, EXPORTERS, SPLAT_READERS):
        assert project()["entry-points"][registry.group] == registry.built_in
        assert sorted(registry.built_in) == registry.names()
        assert all(registry.load(name) is not None for name in registry.names())
    assert ENCODERS.names() == OURS
    for name in OURS:
        kind = encoder_kind(name)
        expected = {"color": ("cosine", 0.7), "imagenet": ("cosine", "auto")}.get(name, ("lerf", 0.5))
        assert (kind.rule, kind.threshold) == expected
        assert isinstance(kind, encoders.EncoderKind)  # where packages of others import it from


def test_an_unknown_name_is_refused_with_those_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, "plug", points(other="plug:KIND", same="plug:KIND"))
    install(tmp_path, "two", points(same="two:KIND"))
    monkeypatch.syspath_prepend(tmp_path)
    parts = ("'clip'", "--encoder", "color, imagenet, metaclip2, open_clip, other, same, siglip, siglip2")
    refused(lambda: encoder_kind("clip"), *parts)
    refused(lambda: check_source_options(SourceOptions(encoder="clip"), ()), *parts)
    assert find_encoder_kind("clip") is None and find_encoder_kind(3) is None
    refused(lambda: encoder_kind("same"), "'same'", "plug", "two", "uninstall")
    for name in ("b", "a"):  # of two copies of a package the first on the path counts
        install(tmp_path / name, "twice", f"[normlift_ns.encoders]\n{name} = twice:ENCODER\n")
        monkeypatch.syspath_prepend(tmp_path / name)
    assert {"a", "b"} & set(ENCODERS.names()) == {"a"}


def test_a_broken_encoder_breaks_itself_only(tmp_path: Path) -> None:
    for number, (value, code, parts) in enumerate((
        ("nowhere:KIND", "", ["cannot be loaded", "ModuleNotFoundError"]),
        ("plug:KIND", "1 / 0", ["cannot be loaded", "ZeroDivisionError", "--encoder open_clip"]),
        ("plug:KIND", "raise SystemExit(3)", ["cannot be loaded", "SystemExit: 3"]),
        ("plug:KIND", "KIND = 3", ["plug:KIND", "int", "EncoderKind"]),
    )):  # fmt: skip
        install(tmp_path / str(number), "worse", f"[{ENCODERS.group}]\nno value at all\n= = =\n[")
        with plugged(tmp_path / str(number), "plug", points(bad=value, open_clip="plug:KIND"), code):
            refused(lambda: encoder_kind("bad"), "'bad'", "plug", *parts)
            assert encoder_kind("open_clip").make.__module__ == "normlift_ns.encoders.registry"
            assert ENCODERS.names() == ["bad", *OURS]


WRONG = """
import torch
from normlift_ns.encoders.registry import EncoderKind
class Wrong:
    identity = {{}}
    def encode(self, image, labels): return {rows}
    def text(self, prompts): return {rows}
KIND = EncoderKind(lambda options, device: {made})
"""


def test_what_another_package_makes_is_checked(tmp_path: Path) -> None:
    image, labels = torch.zeros(4, 2, 3, dtype=torch.uint8), torch.arange(2).repeat(4, 1)[None].int()
    for number, (rows, made, parts) in enumerate((
        ("torch.ones(2, 3)", "Wrong()", ["1.73"]),
        ("torch.eye(3)", "Wrong()", ["torch.float32 (3, 3)", "per region", "[2, D]"]),
        ("None", "Wrong()", ["NoneType", "per region"]),
        ("torch.eye(2) / torch.zeros(1)", "Wrong()", ["expected 1"]),
        ("1 / 0", "Wrong()", ["'wrong'", "ZeroDivisionError"]),
        ("0", "object()", ["identity", "encode", "text"]),
        ("0", "missing", ["'wrong'", "NameError"]),
    )):  # fmt: skip
        code = WRONG.format(rows=rows, made=made)
        with plugged(tmp_path / str(number), "wrong_plug", points(wrong="wrong_plug:KIND"), code):
            refused(lambda: make_encoder(SourceOptions(encoder="wrong")).encode(image, labels), *parts)


MASKS = """
import torch
from normlift_ns.segmentation.registry import MaskSource
class Halves:
    identity = {{"version": 1}}
    def labels(self, image, name): return {labels}
HALVES = MaskSource(lambda options, device: Halves(), options=("level",))
"""


def test_another_package_adds_masks(tmp_path: Path) -> None:
    image, halves = torch.zeros(4, 2, 3, dtype=torch.uint8), "torch.arange(2).repeat(4, 1)"
    entry = f"[{MASK_SOURCES.group}]\nhalves = halves_plug:HALVES\nlangsplat = halves_plug:HALVES\n"

    def options(**more: Any) -> SourceOptions:
        return SourceOptions(**{"encoder": "color", "regions": "halves", **more})

    refused(options, "must be one of auto, sam, sam3, edges, patches, superpixel, grid, files; got 'halves'")
    with plugged(tmp_path / "good", "halves_plug", entry, MASKS.format(labels=halves)):
        check_source_options(options(level="2"), ())
        source = make_source(options(level="2"))
        assert source.identity["regions"] == {"kind": "halves", "version": 1}
        view = source.view(image, "a.png")
        assert len(view.features) == 2 and view.labels.tolist() == [[0, 1]] * 4
        assert cached(source, tmp_path / "cache").view(image, "a.png").labels.equal(view.labels)
        refused(lambda: check_source_options(options(sam_model="a/b"), ()), "--sam-model a/b", '"halves"')
        known = "auto, sam, sam3, edges, patches, superpixel, grid, files, halves"
        refused(lambda: options(regions="langsplat"), known)
    for number, (labels, parts) in enumerate((
        ("torch.zeros(2, 2)", ["torch.float32 (2, 2)", "(4, 2)", "[H, W]"]),
        (f"{halves} * 2", ["0..2", "without gaps"]),
        ("1 / 0", ["ZeroDivisionError"]),
    )):  # fmt: skip
        with plugged(tmp_path / str(number), "halves_plug", entry, MASKS.format(labels=labels)):
            refused(lambda: make_source(options()).view(image, "a.png"), "'halves'", *parts)


def test_packages_that_are_too_old_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    versions = {"torch": "2.6.0", "transformers": "5.0.0"}
    monkeypatch.setattr("normlift_ns.encoders.weights.version", lambda package: versions[package])
    options = SourceOptions(encoder="siglip2", encoder_model="/nowhere")
    for package, found, least in (("torch", "2.5.1", "2.6"), ("transformers", "4.49.0", "4.56")):
        versions[package], enough = found, versions[package]
        for call in (lambda: check_source_options(options, ()), lambda: make_encoder(options)):
            refused(call, "siglip2", f"{package} {least}", found, "--encoder open_clip")
        versions[package] = "10.0"
        check_transformers_version(MODEL_FAMILIES["siglip2"])
        versions[package] = enough


def test_mistakes_are_told_before_torch_is_loaded(empty_hub: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    for options, error, parts in (
        ({"encoder_model": "/nowhere/x"}, FileNotFoundError, ["/nowhere/x", "--encoder-model"]),
        ({"encoder_model": "siglip"}, InputError, ["'siglip'"]),
        ({"encoder_pretrained": "openai"}, InputError, ["--encoder-pretrained openai", "--encoder open_clip"]),
        ({}, FileNotFoundError, ["SigLIP 2", "google/siglip2-base-patch16-224"]),
    ):
        source = SourceOptions(encoder="siglip2", **options)
        refused(lambda source=source: check_source_options(source, ()), *parts, error=error)


@pytest.mark.slow
def test_the_recipe_works_as_a_package(trained: Path, tmp_path: Path) -> None:
    recipe = (ROOT / "CONTRIBUTING.md").read_text("utf8").split("## An encoder of your own")[1].split("\n## ")[0]
    (project,), (code,) = (re.findall(f"```{kind}\n(.*?)```", recipe, re.DOTALL) for kind in ("toml", "python"))
    source, installed = tmp_path / "source", tmp_path / "installed"
    source.mkdir()
    (source / "pyproject.toml").write_text(project)
    (source / "normlift_mean_rgb.py").write_text(code)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", str(installed), str(source)], check=True)

    def run(command: str, *words: object, here: bool = True) -> subprocess.CompletedProcess[str]:
        paths = os.environ | {"CUDA_VISIBLE_DEVICES": ""} | ({"PYTHONPATH": str(installed)} if here else {})
        program = [str(Path(sys.executable).with_name(command)), *map(str, words)]
        return subprocess.run(program, env=paths, capture_output=True, text=True, check=False)

    few = ("--max-views", 4, "--lift-downscale", 2, "--vote-k", 6, "--region-count", 200, "--timestamp", "rgb")
    lifted = trained.parents[2] / "normlift" / "rgb" / "config.yml"
    done = run("ns-normlift", "--load-config", trained, "--encoder", "mean_rgb", *few)
    assert done.returncode == 0, done.stdout + done.stderr
    asked = ("--load-config", lifted, "--output-json", tmp_path / "a.json", "--overwrite", "True")
    done = run("ns-normlift-query", *asked, "--text", "red", "yellow")
    assert done.returncode == 0, done.stdout + done.stderr
    red, yellow = json.loads((tmp_path / "a.json").read_text())["queries"]
    assert red["peak"] > 0.9 and 0 < red["fraction"] < 0.5 and red["centroid"] != yellow["centroid"]
    done = run("ns-normlift-query", *asked[:2], "--text", "purple")
    assert done.returncode == 1 and "text 'purple' is none of red, green, blue, yellow" in done.stderr
    done = run("ns-normlift-query", *asked[:2], "--text", "red", here=False)
    assert done.returncode == 1 and "unknown encoder 'mean_rgb'" in done.stderr and "--text-embeddings" in done.stderr
