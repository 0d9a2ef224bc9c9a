"""Flat options to sources, and what is refused."""

from pathlib import Path

from normlift_ns.encoders.base import PatchFeatures
from normlift_ns.encoders.build import make_source
from normlift_ns.encoders.open_clip_network import OpenClipEncoder
from normlift_ns.encoders.weights import EDGES, IMAGENET, PackageFile
from normlift_ns.options import SourceOptions
from normlift_ns.segmentation import registry
from normlift_ns.segmentation.regions import Grid, LabelFiles, Superpixels
from normlift_ns.segmentation.registry import describe_choice, resolve_source
from normlift_ns.segmentation.sam import SamMasks
from tests.encoders.test_weights import put
from tests.encoders.tiny import refused


def test_options_reach_the_regions(tmp_path):
    (tmp_path / "sam.pth").write_text("")
    sam, files = str(tmp_path / "sam.pth"), {"regions": "files", "regions_dir": tmp_path, "level": "2"}
    for options, expected in (
        ({"encoder": "color"}, Superpixels(256)),
        ({"regions_dir": tmp_path}, LabelFiles(tmp_path)),
        ({"regions": "superpixel", "region_count": 9}, Superpixels(9)),
        ({"regions": "grid", "region_count": 9}, Grid(9)),
        ({**files, "regions_background": -1}, LabelFiles(tmp_path, background=-1, level=2)),
        ({**files, "regions_resample": True}, LabelFiles(tmp_path, level=2, resample=True)),
        ({"regions": "sam"}, SamMasks("facebook/sam-vit-huge", "l", "cpu")),
        ({"regions": "sam", "sam_model": sam, "level": "default"}, SamMasks(sam, "default", "cpu")),
        ({"regions": "sam", "sam_model": sam, "sam_precision": "bfloat16"}, SamMasks(sam, "l", "cpu", "bfloat16")),
    ):
        assert make_source(SourceOptions(**options)).regions == expected, options
    (tmp_path / "moved").mkdir()
    assert LabelFiles(tmp_path).identity == LabelFiles(tmp_path / "moved").identity  # names no place
    assert [x.identity["kind"] for x in (Superpixels(9), LabelFiles(tmp_path))] == ["superpixel", "files"]
    source = make_source(SourceOptions(encoder_model="ViT-B-32", encoder_pretrained="openai", prompt_template="a {}"))
    assert source == PatchFeatures(OpenClipEncoder("ViT-B-32", "openai", template="a {}"), 1024)
    assert make_source(SourceOptions("open_clip", region_count=9)) == PatchFeatures(OpenClipEncoder(), 9)


def make_present(file: PackageFile) -> None:
    """A file of the right size, which is all that the choice looks at."""
    file.path.parent.mkdir(parents=True, exist_ok=True)
    with file.path.open("wb") as content:
        content.truncate(file.size)


def test_auto_takes_the_best_that_is_there_and_names_what_is_better(tmp_path, empty_hub, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def check(chosen: str, better: str | None, device: str = "cpu", **options) -> None:
        found, told = (call(SourceOptions(**options), device) for call in (resolve_source, describe_choice))
        assert f"{found.encoder} {found.regions}" == chosen
        assert (told is None) == (better is None)
        assert (told or "").partition("ns-normlift-weights --get ")[2] == (better or ""), told

    for device in ("cpu", "cuda"):
        check("color superpixel", "imagenet edges", device)
    check("color superpixel", None, encoder="color")
    check("color files", "imagenet", regions_dir=tmp_path)
    check("color grid", "imagenet", regions="grid", regions_dir=tmp_path)
    for own in ({"encoder_model": "ViT-L-14"}, {"encoder_pretrained": "a.pt"}, {"prompt_template": "a {}"}):
        check("open_clip patches", "", **own)
    check("open_clip auto", None, features="langsplat", features_dir=tmp_path)
    check("open_clip patches", "edges", "cuda", encoder="open_clip")
    check("open_clip superpixel", "edges", encoder_model="RN50")
    check("open_clip sam", None, encoder="open_clip", sam_model="weights")
    make_present(IMAGENET)
    check("imagenet patches", "open_clip edges")
    make_present(EDGES)
    check("imagenet edges", "open_clip")
    check("imagenet edges", "open_clip sam", "cuda")
    check("open_clip edges", "", encoder_model="RN50")
    for name in ("config.json", "model.safetensors"):
        put(empty_hub, "google/siglip2-base-patch16-224", name)
    check("siglip2 patches", "")
    put(empty_hub, "laion/CLIP-ViT-B-16-laion2B-s34B-b88K", "open_clip_model.safetensors")
    check("open_clip edges", "sam", "cuda")
    for name in ("config.json", "model.safetensors"):
        put(empty_hub, "facebook/sam-vit-huge", name)
    check("open_clip sam", "", "cuda")
    check("open_clip patches", "")
    monkeypatch.setattr(registry, "find_spec", lambda name: None)
    assert "pip install h5py && ns-normlift-weights" in str(describe_choice(SourceOptions("imagenet"), "cpu"))


def test_bad_options_say_what_to_do(tmp_path):
    for options, parts in (
        ({"regions": "patches"}, ["--regions patches", "--encoder color"]),
        ({"regions": "patches", "level": "l"}, ["--level l", '"patches"']),
        ({"regions": "sam", "level": "2"}, ["s, m, l, default", "'2'"]),
        ({"regions": "sam", "regions_dir": Path()}, ["--regions-dir .", '"sam"']),
        ({"regions": "superpixel", "regions_dir": tmp_path}, [f"--regions-dir {tmp_path}", "--regions files"]),
        ({"regions": "grid", "sam_model": "x/y"}, ["--sam-model x/y", "--regions sam", '"grid"']),
        ({"regions": "grid", "sam_precision": "float16"}, ["--sam-precision float16", "--regions sam", '"grid"']),
        ({"regions": "files"}, ["--regions files", "--regions-dir"]),
        ({"regions": "grid", "level": "1"}, ["--level 1", "--regions edges, files or sam", '"grid"']),
        ({"level": "l", "regions_dir": Path()}, ["--level", "--regions files", "'l'"]),
        ({"level": "-1", "regions_dir": Path()}, ["--level", "'-1'"]),
        ({"features": "langsplat"}, ["--features langsplat", "--features-dir"]),
        ({"features_dir": Path("f")}, ["--features-dir f", "--features langsplat"]),
    ):
        refused(lambda options=options: make_source(SourceOptions(**{"encoder": "color", **options})), *parts)
