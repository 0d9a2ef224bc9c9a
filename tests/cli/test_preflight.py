"""Mistakes that show before torch is imported: what they say, and what they cost."""

import os
from pathlib import Path
from unittest.mock import Mock

import pytest

from normlift_ns.cli import check, evaluate, export, lift, query, serve, view
from normlift_ns.data.nerfstudio.config import read_config_paths
from normlift_ns.encoders import open_clip
from tests.cli.conftest import run_entry, said

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


MY_ANSWERS = ("answers.json", "scores.npz", "objects.json", "0003_1_sky_blue.png")
MY_EXPORTS = ("a.ply", "b_rows.npy", "c_names.json", "d_objects.json")
MY_SCORES = ("e.json", "f_sweeps.svg", "g_signals.svg", "h_coverage_camera_path.json", "i_coverage_pose_5.png")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A trained and lifted run, as far as one can see without opening it, and things that are no files."""
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
    (tmp_path / "mine").mkdir()
    for name in (*MY_ANSWERS, *MY_EXPORTS, *MY_SCORES):
        (tmp_path / "mine" / name).touch()
    return folder / "config.yml"


@pytest.fixture(autouse=True)
def nothing_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pipeline.lift_run", "lifted_run.open_run"):
        monkeypatch.setattr(f"normlift_ns.{name}", None)


COLOUR, CLIP = ("--encoder", "color"), ("--encoder", "open_clip")
LIFT = [
    ("--encoder color --reliability-beta nan", "--reliability-beta", "got nan"),
    ("--encoder words", "'words'", "--encoder"),
    ("--queries oragne", "oragne", "orange"),
    ("--threshold 0.5", "--threshold"),
    ("--device cuda:x:", "--device must be auto, cpu or cuda, or a GPU such as cuda:1; got 'cuda:x:'"),
    ("--timestamp ../x", "'../x'", "folder name"),
    ("--timestamp old", "old exists", "--timestamp", "--output-dir", "not a lifted run"),
    ("--output-dir file", "file, needed for --output-dir"),
    ("--output-dir dangling/x", "dangling", "link"),
    ("--export-langsplat file", "file, needed for --export-langsplat"),
    ("--data nowhere", "nowhere, given with --data"),
    ("--load-step 3", "step-000000003.ckpt"),
    ("--regions-dir [/red]", "[/red], given with --regions-dir"),
    ("--regions-dir room --level x", "--level", "(0, 1, ...)"),
    ("--sam-model a/b/c.pth", "a/b/c.pth, given with --sam-model"),
    ("--features langsplat --features-dir loop", "--features-dir"),
    ("--features langsplat --features-dir room --level x", "s, m, l, default, sum for langsplat, got 'x'"),
    ("--features langsplat --features-dir room --text-embeddings fifo", "fifo, given with --text-embeddings", "pipe"),
    ("--encoder open_clip --encoder-pretrained missing.pt", "missing.pt"),
    (("--queries", "red", " "), "prompt 2 of 2 in --queries"),
    ("--consensus False --consensus-power 2", "--consensus-power has no effect without --consensus True"),
    ("--consensus False --consensus-min-agreement 0", "--consensus-min-agreement has no effect without --consensus"),
    ("--vote paper --vote-prior 2", "--vote-prior has no effect without --vote posterior"),
    ("--consensus-power 2 --vote posterior --vote-prior 2 --queries oragne", "oragne"),
]
SPLATS = [
    ("--load-ply nowhere.ply", "nowhere.ply, given with --load-ply"),
    ("--load-gsplat fifo", "fifo, given with --load-gsplat", "pipe"),
    ("--load-ply file", "camera file", "none"),
    ("--load-ply file --colmap room --transforms x", "camera file", "two"),
    ("--load-ply file --transforms dangling", "dangling, given with --transforms, is a broken link"),
    ("--load-ply file --colmap room --masks none", "none, given with --masks"),
    ("--load-ply file --colmap room --timestamp old", "old exists", "--timestamp"),
    ("--load-config room", "config room is not a file"),
    ("", "got 0"),
    ("--load-ply file --load-config config.yml", "got 2"),
    ("--load-ply file --colmap nowhere", "nowhere, given with --colmap"),
    ("--load-ply file --transforms room --data x", "--data", "--load-config"),
    ("--load-ply file --transforms room --views some", "--views", "'some'"),
    ("--load-config config.yml --colmap x", "--colmap", "--load-ply or --load-gsplat"),
    ("--load-config config.yml --background white", "--background", "--load-ply"),
]
CHECK = [("--output-json mine/answers.json", "answers.json exists", "--output-json", "--overwrite True")]
QUERY = [
    ("--text", "--text", "--interactive"),
    ("--text a --load-config no.yml", "no.yml"),
    (("--text", ""), "prompt 1 of 1 in --text"),
    (("--text", "a", "--negatives", "b", ""), "prompt 2 of 2 in --negatives"),
    ("--text a --min-reliability nan", "--min-reliability must be in 0..1, got nan"),
    ("--text a --output-json room", "room exists", "--output-json"),
    ("--text a --output-json room --overwrite True", "room, given with --output-json", "room"),
    ("--text a --output-json mine/answers.json", "answers.json exists", "--output-json", "--overwrite True"),
    ("--text a --output-npz mine/scores.npz", "scores.npz exists", "--output-npz", "--overwrite True"),
    ("--text a --objects --objects-dir mine", "objects.json exists", "--objects-dir", "--overwrite True"),
    (("--text", "a", "sky blue", "--render-dir", "mine"), "sky_blue.png exists", "--render-dir", "--overwrite True"),
    ("--text a --output-json file/x", "--output-json is"),
    ("--text a --output-json n --render-dir n/b", "n/b", "is an output file"),
    ("--text a --output-json n --output-npz n", "--output-json and --output-npz", ", n"),
    ("--text a --render-dir file", "file, needed for --render-dir"),
    ("--text a --explain --explain-dir file", "file, needed for --explain-dir"),
    ("--text a --objects --objects-dir file", "file, needed for --objects-dir"),
    ("--text a --text-embeddings none.npz", "none.npz, given with --text-embeddings"),
    ("--text a --render-views 9999 --output-json a.json", "--render-views", "--render-dir"),
    ("--text a --objects-dir x", "--objects-dir", "--objects"),
    ("--text a --meters-per-unit 2", "--meters-per-unit", "--objects"),
    ("--text a --explain-dir x", "--explain-dir", "--explain True"),
    ("--text a --segment-views 3", "--segment-views", "--segment sam3"),
    ("--stdin --explain", "--explain", "--text", "--stdin"),
    ("--text a --stdin", "--text and --stdin"),
    ("--interactive", "--interactive", "terminal"),
    ("", "no prompt is given"),
    ("--stdin --interactive True", "--stdin", "--interactive"),
    ("--stdin --output-json a.json", "--output-json", "--text", "--stdin"),
    ("--interactive --save-query", "--save-query", "--text", "--interactive"),
    ("--inventory --text red", "cannot be combined"),
    ("--text red --image a.png", "--inventory"),
    ("--inventory --vocabulary none.txt", "does not exist"),
    ("--inventory --save-query", "--save-query"),
    ("--text a --log-file .", ".", "not a regular file"),
    ("--text a --log-file nowhere/a.log", "nowhere/a.log, given with --log-file", "No such file"),
    ("--text a --log-file", "--log-file"),
    ("--log-file --text a", "--log-file"),
    ("--text a --quiet yes", "--quiet must be True or False, got 'yes'"),
]
EXPORT = [
    ("--select selection", "--select selection", "--text"),
    ("--transfer file", "--transfer", "--text"),
    ("--select nothing", "--select", "'nothing'"),
    ("--exporters note", "unknown exporter 'note'"),
    *((f"--output-dir mine --output-filename {x[0]}.ply", f"{x} exists", "--output-dir") for x in MY_EXPORTS),
    ("--object-max-gap nan", "--object-max-gap", "got nan"),
    ("--output-dir file", "file, needed for --output-dir"),
    ("--output-filename /", "--output-filename"),
    ("--text a --transfer none.ply", "none.ply, given with --transfer"),
    ("--text a --select clean --masks-dir m", "--masks-dir"),
    *((f"--text a --output-filename {name}", "--output-filename") for name in ("../a.ply", "..", "b/a")),
    ("--text a --transfer-distance 3", "--transfer FILE"),
    ("--text a --floater-threshold 2", "--select clean"),
    ("--threshold 0.5", "--text"),
]
STUDIES = "--protocol masks --labels room --study sweeps signals coverage --output-path mine"
EVAL = [
    *((f"{STUDIES}/{x[0]}.json", f"{x} exists", "--output-path", "--overwrite True") for x in MY_SCORES),
    ("--protocol masks --labels none", "none, given with --labels"),
    ("--protocol lerf --labels none", "none, given with --labels"),
    ("--protocol masks --labels room --purity nan", "--purity must be in 0..1, got nan"),
    ("--protocol masks --labels room --names none", "none, given with --names"),
    ("--protocol masks --labels room --output-path file/x", "--output-path is"),
    ("--protocol masks --labels room room", "got 1 and 2", "--labels"),
    ("--protocol none", "protocol none", "--labels", "--study coverage"),
    ("--protocol none --study coverage --labels .", "protocol none", "--study coverage"),
    ("--protocol none --study coverage --margin 0.5", "--margin is an option of --protocol lerf"),
    ("--protocol scannet --labels room --margin 0.5", "--margin is an option of --protocol lerf"),
]
VIEW = [
    ("--port 70000", "--port", "65,535", "70000"),
    ("--load-config no.yml", "no.yml"),
    ("--device tpu", "--device", "'tpu'"),
    *((f"--host {name}", f"--host {name}") for name in ("192.0.2.1", "a" * 70)),
    ("--text-embeddings none.npz", "none.npz, given with --text-embeddings"),
]
SERVE = [("", "No run is given", "ns-normlift-serve RUN/config.yml"), ("nowhere/config.yml", "nowhere/config.yml")]


@pytest.mark.parametrize(
    ("command", "given", "cases"),
    [
        pytest.param(lift, ("--load-config", "CONFIG", *COLOUR), LIFT, id="lift"),
        pytest.param(lift, COLOUR, SPLATS, id="splat"),
        pytest.param(check, ("--load-config", "CONFIG", *COLOUR), CHECK, id="check"),
        pytest.param(query, ("--load-config", "CONFIG"), QUERY, id="query"),
        pytest.param(export, ("--load-config", "CONFIG", "--output-dir", "out"), EXPORT, id="export"),
        pytest.param(evaluate, ("--load-config", "CONFIG"), EVAL, id="eval"),
        pytest.param(view, ("--load-config", "CONFIG"), VIEW, id="view"),
        pytest.param(serve, (), SERVE, id="serve"),
        pytest.param(serve, ("CONFIG",), VIEW[:-1], id="serve a run"),
    ],
)
def test_a_mistake_is_told_early_and_leaves_nothing(command, given, cases, config, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    for flags, *facts in cases:
        words = [str(config) if word == "CONFIG" else word for word in given]
        words += flags.split() if isinstance(flags, str) else flags
        assert run_entry(monkeypatch, command.entrypoint, *words) == 1, flags
        text = said(capsys).replace("│", "")
        assert [fact for fact in facts if fact not in text] == [] and "Traceback" not in text, (flags, text)
        assert sorted(tmp_path.rglob("*")) == before, flags


def test_a_run_that_is_not_lifted_is_told(config, monkeypatch, capsys):
    (config.parent / "normlift").rmdir()
    for command, text in ((query, ("--text", "a")), (view, ())):
        assert run_entry(monkeypatch, command.entrypoint, "--load-config", config, *text) == 1
        assert "run without semantics" in said(capsys)


def test_a_dataset_that_is_gone_is_refused_early(config, tmp_path, monkeypatch, capsys):
    (tmp_path / "room").rmdir()
    monkeypatch.chdir("/")
    for entrypoint, flags in ((lift.entrypoint, COLOUR), (query.entrypoint, ("--text", "a"))):
        assert run_entry(monkeypatch, entrypoint, "--load-config", config, *flags) == 1
        assert f"{tmp_path / 'room'}" in (shown := said(capsys)) and "with --data" in shown


def test_a_cache_that_is_a_file_or_a_locked_folder_is_refused_early(config, tmp_path, monkeypatch, capsys):
    (tmp_path / "room" / "normlift").mkdir(parents=True)
    (tmp_path / "room" / "normlift" / ".cache").touch()
    (tmp_path / "locked").mkdir(mode=0o500)
    folders = {tmp_path: ".cache, needed for --output-dir", tmp_path / "locked" / "new": "is not writable"}
    for folder, fact in list(folders.items())[: 1 if os.geteuid() == 0 else 2]:  # root may write everywhere
        assert run_entry(monkeypatch, lift.entrypoint, "--load-config", config, *COLOUR, "--output-dir", folder) == 1
        assert fact in said(capsys)


def test_weights_that_cannot_be_had_are_refused_early(config, monkeypatch, capsys):
    monkeypatch.setattr("urllib.request.urlopen", Mock(side_effect=OSError("no route")))
    monkeypatch.setenv("HF_ENDPOINT", "https://hub")
    for there in (False, True, None):
        at_hand = Mock(return_value=there)
        monkeypatch.setattr(open_clip, "has_local_clip_weights", at_hand, raising=False)
        code = run_entry(monkeypatch, lift.entrypoint, "--load-config", config, *CLIP, "--timestamp", "old")
        at_hand.assert_called_once_with("ViT-B-16", "laion2b_s34b_b88k")
        assert code == 1
        text = said(capsys)
        assert ("laion2b_s34b_b88k" in text and "https://hub cannot be reached" in text) == (there is False)


def test_what_is_no_config_is_one_message(tmp_path, monkeypatch, capsys):
    broken = ("", "[", "a: [", "- 1", "\0", "&a [*a]", "[" * 5000, "method_name: [1]", "{" * 3000, "a: !!x", "\ud800")
    for text in broken:
        (tmp_path / "config.yml").write_bytes(text.encode("utf8", "surrogatepass"))
        assert run_entry(monkeypatch, lift.entrypoint, "--load-config", tmp_path / "config.yml", *COLOUR) == 1
        assert "is not a nerfstudio config" in said(capsys), text[:20]


def test_places_of_a_config_and_others_are_looked_at_without_harm(config, tmp_path):
    seen = read_config_paths(config)
    assert (seen.experiment, seen.output_dir, seen.data[0]) == ("room", tmp_path / "outputs", tmp_path / "room")
    for key in ("experiment_name", "timestamp", "output_dir", "pipeline"):
        lines = [line for line in CONFIG.splitlines() if not line.startswith((f"{key}:", " ", "-"))]
        for value in ("null", "[1, 2]", "{a: b}", "7", "!!python/object/apply:os.system [x]"):
            (tmp_path / "config.yml").write_text("\n".join([*lines, f"{key}: {value}"]))
            read_config_paths(tmp_path / "config.yml")
