"""Mistakes that show before torch is imported: what they say, and what they cost."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from normlift_ns.encoders import weights
from normlift_ns.errors import InputError
from normlift_ns.options import LiftOptions, RefineConfig
from normlift_ns.scripts import evaluate, export, lift, query
from normlift_ns.scripts.answers.glance import glance
from normlift_ns.scripts.early import check_effect
from tests.scripts.conftest import run_entry, said

CONFIG = """!!python/object:nerfstudio.engine.trainer.TrainerConfig
experiment_name: room
method_name: splatfacto
timestamp: run
output_dir: !!python/object/apply:pathlib.PosixPath
- outputs
pipeline: !!python/object:a.B
  datamanager: !!python/object:a.C
    data: !!python/object/apply:pathlib.PosixPath
    - room
"""
MOST_SECONDS = 1.5
"""Of CPU, on a slow machine; 0.5 on a usual one."""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A trained and lifted run, as far as one can see without opening it."""
    folder = tmp_path / "outputs" / "room" / "splatfacto" / "run"
    (folder / "nerfstudio_models").mkdir(parents=True)
    (folder / "nerfstudio_models" / "step-000000009.ckpt").touch()
    (folder / "normlift").mkdir()
    (folder / "config.yml").write_text(CONFIG)
    (tmp_path / "room").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "dangling").symlink_to("nothing")
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "outputs" / "room" / "normlift" / "old").mkdir(parents=True)
    return folder / "config.yml"


@pytest.fixture(autouse=True)
def nothing_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("lift_run", "open_run"):
        monkeypatch.setattr(f"normlift_ns.front_door.{name}", None)


COLOUR = ("--encoder", "colour")
LIFT = [
    (("--encoder", "colour", "--beta", "nan"), "--beta must be not negative, got nan"),
    (("--threshold", "0.5"), "--threshold"),
    ((*COLOUR, "--device", "cuda:x:"), "--device must be auto, cpu or cuda, got 'cuda:x:'"),
    ((*COLOUR, "--timestamp", "../x"), "the timestamp '../x' is not the name of a folder"),
    ((*COLOUR, "--timestamp", "old"), "old exists; give another --timestamp or --output-dir, or --overwrite True."),
    ((*COLOUR, "--output-dir", "file"), "file, named with --output-dir, is no folder"),
    ((*COLOUR, "--output-dir", "file/below/it"), "file, named with --output-dir, is no folder"),
    ((*COLOUR, "--output-dir", "loop"), "'loop', named with --output-dir, cannot be opened"),
    ((*COLOUR, "--output-dir", "dangling/x"), "is a link that leads nowhere"),
    ((*COLOUR, "--export-langsplat", "file"), "file, named with --export-langsplat, is no folder"),
    ((*COLOUR, "--data", "nowhere"), "There is no dataset at nowhere, given with --data"),
    ((*COLOUR, "--load-step", "3"), "No checkpoint step-000000003.ckpt in"),
    ((*COLOUR, "--load-step", "-3"), "--load-step must be at least 0, got -3"),
    ((*COLOUR, "--regions-dir", "[/red]"), "[/red], given with --regions-dir, does not exist"),
    ((*COLOUR, "--regions-dir", "file"), "file, given with --regions-dir, is no folder"),
    ((*COLOUR, "--regions", "files"), 'regions "files" need a folder of label maps'),
    ((*COLOUR, "--regions", "sam", "--level", "x"), "--level must be one of s, m, l, default for sam, got 'x'"),
    ((*COLOUR, "--regions", "grid", "--level", "l"), "--level 'l' is for --regions files or sam, not for \"grid\""),
    ((*COLOUR, "--regions-dir", "room", "--level", "x"), "is the number of a map"),
    ((*COLOUR, "--sam-model", "a/b/c.pth"), "a/b/c.pth, given with --sam-model, does not exist"),
    (("--features", "langsplat"), "features 'langsplat' need their folder: give it with --features-dir"),
    (("--features", "langsplat", "--features-dir", "loop"), "'loop', given with --features-dir, cannot be opened"),
    (
        ("--features", "langsplat", "--features-dir", "room", "--level", "x"),
        "--level must be one of s, m, l, default, sum for langsplat, got 'x'",
    ),
    (
        ("--features", "langsplat", "--features-dir", "room", "--text-vectors", "fifo"),
        "fifo, given with --text-vectors, is a pipe or a device",
    ),
    (("--encoder-pretrained", "missing.pt"), "weight file missing.pt does not exist"),
    ((*COLOUR, "--queries", "red", " "), "text 2 of 2 of --queries is empty"),
    ((*COLOUR, "--queries", "red", "red"), "'red', is given twice"),
    ((*COLOUR, "--queries", "a\0b"), "holds a character that no text has"),
    ((*COLOUR, "--queries", "x" * 10**6), "has 1,000,000 characters"),
    ((*COLOUR, "--queries", "\udcff"), "holds a character that no text has"),
]


@pytest.mark.parametrize(("flags", "message"), LIFT, ids=[" ".join(flags)[:40] for flags, _ in LIFT])
def test_a_lift_is_refused_early(flags, message, config, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", config, *flags) == 1
    assert message in said(capsys)
    assert sorted(tmp_path.rglob("*")) == before


SPLATS = [
    (("--load-ply", "nowhere.ply"), "nowhere.ply, given with --load-ply, does not exist"),
    (("--load-ply", "room"), "room, given with --load-ply, is a folder; give a file"),
    (("--load-gsplat", "fifo"), "fifo, given with --load-gsplat, is a pipe or a device"),
    (("--load-ply", "file"), "A splat needs one file of cameras, got none"),
    (("--load-ply", "file", "--colmap", "room", "--transforms", "x"), "one file of cameras, got two"),
    (("--load-ply", "file", "--colmap", "file"), "file, given with --colmap, is no folder"),
    (("--load-ply", "file", "--transforms", "dangling"), "dangling (a link that leads nowhere), given with"),
    (("--load-ply", "file", "--colmap", "room", "--masks", "none"), "none, given with --masks, does not exist"),
    (("--load-ply", "file", "--colmap", "room", "--test-every", "1"), "--test-every must be at least 2, got 1"),
    (("--load-ply", "file", "--colmap", "room", "--timestamp", "old"), "old exists; give another --timestamp"),
    (("--load-config", "room"), "No config at room"),
    (("--load-config", "loop"), "No config at loop"),
    (("--load-config", "fifo"), "No config at fifo"),
    (("--load-config", "file"), "file is not a nerfstudio config: it has no method_name"),
]


@pytest.mark.parametrize(("flags", "message"), SPLATS, ids=[" ".join(flags) for flags, _ in SPLATS])
def test_a_splat_is_refused_early(flags, message, config, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_entry(monkeypatch, lift.entrypoint, *flags, *COLOUR) == 1
    assert message in said(capsys).replace("│", "")


QUERY = [
    (("--text",), "no text given"),
    (("--text", ""), "text 1 of 1 of --text is empty"),
    (("--text", "a", "a"), "'a', is given twice"),
    (("--text", "a", "--negatives", "b", ""), "text 2 of 2 of --negatives is empty"),
    (("--text", "a", "--threshold", "inf"), "--threshold must be finite, got inf"),
    (("--text", "a", "--min-reliability", "nan"), "--min-reliability must be in 0..1, got nan"),
    (("--text", "a", "--json", "room"), "room exists; give another --json"),
    (("--text", "a", "--json", "room", "--overwrite", "True"), "room, given with --json, is there and is no file"),
    (("--text", "a", "--json", "fifo", "--overwrite", "True"), "fifo, given with --json, is there and is no file"),
    (("--text", "a", "--json", "file/x"), "file, named with --json, is no folder"),
    (("--text", "a", "--json", "n", "--output-path", "n"), "--json and --output-path name the same file, n"),
    (("--text", "a", "--render-dir", "file"), "file, named with --render-dir, is no folder"),
    (("--text", "a", "--text-vectors", "none.npz"), "none.npz, given with --text-vectors, does not exist"),
    (("--text", "a", "--device", "gpu"), "--device must be auto, cpu or cuda, got 'gpu'"),
]


@pytest.mark.parametrize(("flags", "message"), QUERY, ids=[" ".join(flags) for flags, _ in QUERY])
def test_a_query_is_refused_early(flags, message, config, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_entry(monkeypatch, query.entrypoint, "--load-config", config, *flags) == 1
    assert message in said(capsys)


EXPORT = [
    (("--part", "selection"), "--part selection needs something to look for: give --text"),
    (("--reach", "nan"), "--reach must be positive, at least 1e-06, got nan"),
    (("--min-size", "0"), "--min-size must be at least 1, got 0"),
    (("--output-dir", "file"), "file, named with --output-dir, is no folder"),
    (("--output-filename", "/"), "--output-filename is empty"),
]


@pytest.mark.parametrize(("flags", "message"), EXPORT, ids=[" ".join(flags) for flags, _ in EXPORT])
def test_an_export_is_refused_early(flags, message, config, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    given = ("--load-config", config, "--output-dir", "out", *flags)
    assert run_entry(monkeypatch, export.entrypoint, *given) == 1
    assert message in said(capsys)


EVAL = [
    (("--protocol", "masks", "--labels", "none"), "none, given with --labels, does not exist"),
    (("--protocol", "scannet", "--labels", "room"), "room, given with --labels, is a folder; give a file"),
    (("--protocol", "masks", "--labels", "room", "--purity", "nan"), "--purity must be in 0..1, got nan"),
    (("--protocol", "masks", "--labels", "room", "--min-weight", "inf"), "--min-weight must be finite, got inf"),
    (("--protocol", "masks", "--labels", "room", "--names", "none"), "none, given with --names, does not exist"),
    (("--protocol", "masks", "--labels", "room", "--output-path", "file/x"), "file, named with --output-path"),
    (("--protocol", "masks", "--labels", "room", "room"), "1 runs and 2 --labels were given"),
]


@pytest.mark.parametrize(("flags", "message"), EVAL, ids=[" ".join(flags) for flags, _ in EVAL])
def test_an_evaluation_is_refused_early(flags, message, config, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_entry(monkeypatch, evaluate.entrypoint, "--load-config", config, *flags) == 1
    assert message in said(capsys)


def test_a_dataset_that_is_gone_is_refused_early(config, tmp_path, monkeypatch, capsys):
    (tmp_path / "room").rmdir()
    monkeypatch.chdir("/")
    for entrypoint, flags in ((lift.entrypoint, COLOUR), (query.entrypoint, ("--text", "a"))):
        assert run_entry(monkeypatch, entrypoint, "--load-config", config, *flags) == 1
        assert f"{tmp_path / 'room'}" in (shown := said(capsys)) and "where it is with --data" in shown


def test_a_run_without_semantics_is_refused_early(config, monkeypatch, capsys):
    (config.parent / "normlift").rmdir()
    assert run_entry(monkeypatch, query.entrypoint, "--load-config", config, "--text", "a") == 1
    assert "is a run without semantics" in said(capsys)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_is_refused_early(config, tmp_path, monkeypatch, capsys):
    (tmp_path / "locked").mkdir(mode=0o500)
    flags = ("--output-dir", tmp_path / "locked" / "new")
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", config, *COLOUR, *flags) == 1
    assert "may not be written" in said(capsys)


def test_a_cache_that_is_a_file_is_refused_early(config, tmp_path, monkeypatch, capsys):
    (tmp_path / "room" / "normlift").mkdir(parents=True)
    (tmp_path / "room" / "normlift" / ".cache").touch()
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", config, *COLOUR, "--output-dir", tmp_path) == 1
    assert ".cache, named with --output-dir, is no folder; give another place" in said(capsys)


@pytest.mark.parametrize("there", [False, True, None])
def test_weights_that_cannot_be_had_are_refused_early(there, config, monkeypatch, capsys):
    def unreachable(address: str) -> None:
        raise ConnectionError(f"{address} cannot be reached")

    asked: list[tuple[str, str]] = []
    monkeypatch.setattr(weights, "clip_weights_at_hand", lambda *name: asked.append(name) or there, raising=False)
    monkeypatch.setattr(weights, "probe", unreachable)
    monkeypatch.setenv("HF_ENDPOINT", "https://hub")
    code = run_entry(monkeypatch, lift.entrypoint, "--load-config", config, "--timestamp", "old")
    assert (code, asked) == (1, [("ViT-B-16", "laion2b_s34b_b88k")])
    message = "weights 'laion2b_s34b_b88k' of OpenCLIP model ViT-B-16 are not on this machine, and cannot be downloaded"
    assert (f"{message} (https://hub cannot be reached)" in said(capsys)) == (there is False)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[",
        "a: [",
        "- 1",
        "\0",
        "&a [*a]",
        "[" * 5000,
        "method_name: [1]",
        "{" * 3000,
        "a: !!x",
        "\ud800",
    ],
)
def test_what_is_no_config_is_one_message(text, tmp_path, monkeypatch, capsys):
    (tmp_path / "config.yml").write_bytes(text.encode("utf8", "surrogatepass"))
    assert run_entry(monkeypatch, lift.entrypoint, "--load-config", tmp_path / "config.yml", *COLOUR) == 1
    assert "is not a nerfstudio config" in said(capsys)


@pytest.mark.parametrize("key", ["experiment_name", "timestamp", "output_dir", "pipeline"])
@pytest.mark.parametrize("value", ["null", "[1, 2]", "{a: b}", "7", "!!python/object/apply:os.system [x]"])
def test_other_configs_are_looked_at_without_harm(key, value, tmp_path):
    lines = [line for line in CONFIG.splitlines() if not line.startswith((f"{key}:", " ", "-"))]
    (tmp_path / "config.yml").write_text("\n".join([*lines, f"{key}: {value}"]))
    glance(tmp_path / "config.yml")


def test_places_of_a_config(config, tmp_path):
    seen = glance(config)
    assert (seen.experiment, seen.output_dir, seen.data[0]) == ("room", tmp_path / "outputs", tmp_path / "room")
    assert yaml.compose(CONFIG) is not None


@pytest.mark.parametrize(
    ("module", "flags"),
    [
        ("lift", ("--load-config", "nowhere.yml")),
        ("lift", ("--load-config", "CONFIG", *COLOUR, "--sigma-d", "nan")),
        ("lift", ("--load-config", "CONFIG", *COLOUR, "--timestamp", "old")),
        ("query", ("--load-config", "CONFIG", "--text", "a", "--json", "file/x")),
        ("export", ("--load-config", "CONFIG", "--output-dir", "file")),
        ("evaluate", ("--load-config", "CONFIG", "--protocol", "masks", "--labels", "none")),
    ],
)
def test_a_mistake_costs_little_and_imports_nothing_heavy(module, flags, config, tmp_path):
    words = [str(config) if flag == "CONFIG" else flag for flag in flags]
    program = (
        f"import sys\nsys.argv = ['command', *{words!r}]\nfrom normlift_ns.scripts.{module} import entrypoint\n"
        "try:\n    entrypoint()\nfinally:\n"
        "    heavy = {'torch', 'numpy', 'nerfstudio', 'scipy', 'matplotlib'} & set(sys.modules)\n"
        "    assert not heavy, heavy\n"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    assert after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime < MOST_SECONDS


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"consensus": False, "consensus_power": 2.0}, "--consensus-power is for --consensus True"),
        ({"consensus": False, "consensus_sample": 9}, "--consensus-sample is for --consensus True"),
        ({"consensus": False, "consensus_least": 0.0}, "--consensus-least is for --consensus True"),
        ({"vote": RefineConfig(vote="paper", prior=2.0)}, "--prior is for --vote posterior"),
    ],
)
def test_options_of_what_is_off_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        check_effect(LiftOptions(**options))
    check_effect(LiftOptions(consensus=True, consensus_power=2.0, vote=RefineConfig(vote="posterior", prior=2.0)))
