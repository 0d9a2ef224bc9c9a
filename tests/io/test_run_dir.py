"""The files of a lifted run belong together, and no output takes the place of one."""

import json
import warnings
from pathlib import Path

import pytest
import torch

from normlift_ns.encoders.text_files import write_text_embeddings
from normlift_ns.errors import InputError
from normlift_ns.io import run_dir
from tests.io.test_digests import as_version_0_1, example, flipped

CONFIG = "method_name: normlift\ntimestamp: größe\n"


def write_run(run: Path, seed: int = 0) -> Path:
    """What surrounds a field; its loaders are tested elsewhere."""
    run.mkdir(parents=True)
    (run / "config.yml").write_text(run_dir.add_digest_comment(CONFIG), "utf8")
    (run / "dataparser_transforms.json").write_text(json.dumps({"scale": 1.0, "seed": seed}))
    (run / "nerfstudio_models").mkdir()
    (run / "nerfstudio_models" / "step-000000007.ckpt").write_bytes(bytes(range(seed, seed + 99)))
    write_text_embeddings(run / "normlift" / "texts.npz", {"fox": torch.arange(1.0 + seed, 5.0 + seed)})
    beside = [*run.glob("*.json"), *run.glob("*/*.ckpt"), *run.glob("*/*.npz"), run / "absent.json", run.parent / "x"]
    (run.parent / "x").write_text("elsewhere")
    example("float16").save(run / "normlift", beside=run_dir.run_file_digests(run / "normlift", beside), own=True)
    return run


BESIDE = ["dataparser_transforms.json", "nerfstudio_models/step-000000007.ckpt", "normlift/texts.npz"]


def test_the_manifest_knows_the_files_of_the_run(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    digests = run_dir.read_manifest(run / "normlift")[1]
    assert digests is not None
    beside = {"../dataparser_transforms.json", "../nerfstudio_models/step-000000007.ckpt"}
    assert set(digests) == {"field.safetensors", "texts.npz"} | beside
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run_dir.check_run(run)
        run_dir.check_run(run.rename(tmp_path / "moved"))
        run_dir.check_run(tmp_path / "no run")
    with pytest.raises(FileNotFoundError, match=r"manifest\.json is missing"):
        run_dir.read_manifest(tmp_path / "no run")


def test_files_of_another_run_and_flipped_bits_are_refused(tmp_path: Path) -> None:
    run, other = write_run(tmp_path / "a" / "run"), write_run(tmp_path / "b" / "run", seed=1)
    for path in (run / name for name in BESIDE):
        whole, foreign = path.read_bytes(), (other / path.relative_to(run)).read_bytes()
        for wrong in (foreign, whole[:-1], b"", *(flipped(whole, bit) for bit in range(0, 190, 13))):
            path.write_bytes(wrong)
            with pytest.raises(InputError, match=rf"{path} is damaged.* expected xxh3_128:.*copy"):
                run_dir.check_run(run)
        path.unlink()
        run_dir.check_run(run)  # who needs it says so
    as_version_0_1(run / "normlift")
    (run / BESIDE[0]).write_text("{}")
    run_dir.check_run(run)  # without digests nothing is checked


def test_an_edited_config_is_warned_of_until_its_first_line_goes(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    config = run / "config.yml"
    whole = config.read_bytes()
    for bit in range(0, 8 * len(whole), 29):
        config.write_bytes(flipped(whole, bit))
        if config.read_bytes().startswith(b"# Lines below: "):
            with pytest.warns(UserWarning, match=r"config\.yml .*delete its first line"):
                run_dir.check_run(run)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for fine in (CONFIG.replace("normlift", "other").encode(), whole.replace(b"\n", b"\r\n"), b"", b"\xff"):
            config.write_bytes(fine)
            run_dir.check_run(run)
        config.unlink()
        run_dir.check_run(run)


def test_a_manifest_leads_nowhere_else(tmp_path: Path) -> None:
    for i, name in enumerate(["/etc/passwd", "../../x", "../a/b", "..", ".", "", "a/b", "a\0", "\udcff", "../.x"]):
        example("float16").save(tmp_path / str(i), beside={name: "xxh3_128:0"})
        with pytest.raises(InputError, match=r"manifest\.json is damaged"):
            run_dir.check_file_digests(tmp_path / str(i))


def test_overwrite_replaces_runs_and_nothing_else(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"experiment name .* string"):
        run_dir.run_directory(tmp_path, 5)  # pyright: ignore[reportArgumentType] (from a config.yml)
    run = write_run(tmp_path / "run")
    run_dir.refuse_existing_run(run, overwrite=True)
    run_dir.refuse_existing_run(tmp_path / "new", overwrite=False)
    with pytest.raises(FileExistsError, match="another timestamp"):
        run_dir.refuse_existing_run(run, overwrite=False)
    (tmp_path / "photos").mkdir()
    with pytest.raises(FileExistsError, match=r"photos .*config\.yml"):
        run_dir.refuse_existing_run(tmp_path / "photos", overwrite=True)
