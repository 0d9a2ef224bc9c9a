"""Many captures by several workers: each is lifted once, whoever dies, and a rerun does only what is missing."""

import json
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from itertools import count, permutations
from pathlib import Path
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.cli import batch
from normlift_ns.errors import InputError
from normlift_ns.io.file_lock import ClaimState, read_claim_states, read_jsonl, try_claim
from normlift_ns.lifted_run import open_run
from tests.cli import stand_in
from tests.cli.conftest import SMALL, run_entry, said
from tests.cli.test_preflight import CONFIG
from tests.processes import FORK, killed_at
from tests.viewer.scenes import until

STAND_IN = (sys.executable, "-S", str(Path(__file__).with_name("stand_in.py")))
PATIENCE = 1.5


class Batch:
    """Captures that the stand-in lifts, their list, and the folder of the results."""

    def __init__(self, folder: Path, what: Sequence[str]) -> None:
        self.outputs, self.list, self.results = folder / "outputs", folder / "captures.txt", folder / "captures_batch"
        names = [f"c{i:02d}" for i in range(len(what))]
        self.configs = [self.outputs / name / "splatfacto" / "run" / "config.yml" for name in names]
        for name, config, text in zip(names, self.configs, what):
            config.parent.mkdir(parents=True)
            config.write_text(CONFIG.replace("room", name))
            config.with_name("what.txt").write_text(text)
        self.list.write_text("# captures\n\n" + "".join(f"{config}\n" for config in self.configs))

    def work(self, *options: str, patience: float = PATIENCE) -> dict[str, batch.Outcome]:
        return batch.lift_captures(batch.read_captures(self.list, options), self.results, patience, command=STAND_IN)

    def begun(self) -> Counter[str]:
        file = self.outputs.parent / "begun.txt"
        return Counter(line.split()[0] for line in file.read_text().splitlines()) if file.exists() else Counter()

    def states(self) -> list[str]:
        found = batch.latest_outcomes(read_jsonl(self.results, batch.Outcome))
        return [found[capture.key].state for capture in batch.read_captures(self.list, ())]

    def check_lifted_once(self) -> None:
        runs = [sorted(config.parents[2].glob("normlift/batch_*")) for config in self.configs]
        assert [len(found) for found in runs] == [1] * len(runs) and all(batch.is_lifted(found[0]) for found in runs)
        lines = read_jsonl(self.results, batch.Outcome)
        done = Counter(line.key for line in lines if line.state == "done")
        assert set(self.states()) <= {"done", "skipped"} and set(done.values()) <= {1}
        known = {line.key for line in lines}  # a worker may be killed between its line and the end of its claim
        ends = {(state.outcome, key in known) for key, state in read_claim_states(self.results / "claims").items()}
        assert ends <= {("done", True), ("skipped", True), (None, True)}


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> list[Callable[[Callable[[], bool]], int | None]]:
    """Captures are lifted by the stand-in in this very process; what is put into the list happens first, each once,
    in place of a capture."""
    happens: list[Callable[[Callable[[], bool]], int | None]] = []

    def run(words: Sequence[str], log: Path, beat: Callable[[], bool], every: float) -> int | None:
        if len(happens) > 0:
            return happens.pop(0)(beat)
        with log.open("w") as file, redirect_stdout(file), redirect_stderr(file):
            try:
                stand_in.main(words[len(STAND_IN) :])
            except SystemExit as stop:
                return int(stop.code or 0)
        return 0

    monkeypatch.setattr("normlift_ns.cli.batch.run_logged", run)
    return happens


def alive(pid: int) -> bool:
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.slow
@pytest.mark.parametrize("stride", [4, pytest.param(1, marks=pytest.mark.extra)])
def test_a_worker_may_be_killed_at_any_access_to_files(stride, tmp_path):
    """Killed before every n-th of all that its work takes; the next one finishes it."""
    killed = set()
    for step in count(1, stride):
        made = Batch(tmp_path / str(step), ["0"] * 2)
        captures = batch.read_captures(made.list, ())
        made.results.mkdir()

        def first(made: Batch = made, captures: Sequence[batch.Capture] = captures) -> None:
            batch.lift_captures(captures, made.results, 0.3, command=STAND_IN)

        if not killed_at(step, first, made.results):
            break
        killed.add(tuple(sorted(read_claim_states(made.results / "claims").values(), key=str)))
        batch.lift_captures(captures, made.results, 0.3, command=STAND_IN)
        made.check_lifted_once()
    assert step > 24
    one, done = ClaimState(1, None), ClaimState(1, "done")
    states = {(), (one,), (done,), (done, one), (done, done)}
    assert killed <= states and (killed == states or stride > 1)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends processes with those that started them")
def test_the_process_of_a_killed_worker_ends_with_it(tmp_path):
    made = Batch(tmp_path, ["60"])
    worker, begun = FORK.Process(target=made.work), tmp_path / "begun.txt"
    worker.start()
    until(lambda: begun.exists() and begun.read_text().endswith("\n"))
    pid = int(begun.read_text().split()[1])
    assert alive(pid)
    os.kill(worker.pid, signal.SIGKILL)
    worker.join()
    until(lambda: not alive(pid))


@pytest.mark.parametrize("seconds", [0.2, 9])
def test_a_process_that_ends_has_time_to_clean_up_but_not_for_ever(seconds, tmp_path, monkeypatch):
    program = """if True:
        import signal, sys, time
        def end(*_): time.sleep(float(sys.argv[3])); open(sys.argv[1], "w").close(); sys.exit()
        signal.signal(signal.SIGTERM, end); open(sys.argv[2], "w").close(); time.sleep(60)"""
    ready, cleaned = tmp_path / "ready", tmp_path / "cleaned"
    monkeypatch.setattr(batch, "_GRACE", batch._GRACE if seconds < 1 else 0.1)
    words = [sys.executable, "-S", "-c", program, str(cleaned), str(ready), str(seconds)]
    assert batch.run_logged(words, tmp_path / "log", lambda: not ready.exists(), interval=0.01) is None
    assert cleaned.exists() == (seconds < 1)


def test_damaged_captures_fail_alone_and_are_tried_again(tmp_path):
    made = Batch(tmp_path, ["0", "fail", "crash", "bug"])
    outcomes = made.work()
    assert made.states() == ["done", "failed", "failed", "failed"]
    found = [outcomes[capture.key] for capture in batch.read_captures(made.list, ())]
    assert [outcome.code for outcome in found] == [0, 1, 128 + signal.SIGSEGV, 70]
    assert [outcome.message for outcome in found[1:4:2]] == ["the photographs are [/gone]", "This is a bug"]
    assert "SIGSEGV" in found[2].message and "logs" in found[2].message
    assert [batch.largest_exit_code(found[:n]) for n in (4, 2, 1)] == [128 + signal.SIGSEGV, 1, 0]
    made.configs[1].with_name("what.txt").write_text("0")
    made.work()
    assert made.states() == ["done", "done", "failed", "failed"]
    assert made.begun() == {"c00": 1, "c01": 2, "c02": 2, "c03": 2}
    logs = [path.read_text() for path in (made.results / "logs").iterdir()]
    assert len(logs) == 7 and sum("[/gone]" in log for log in logs) == 1


def test_a_rerun_does_only_what_is_missing(tmp_path, in_process):
    made = Batch(tmp_path, ["0"] * 4)
    made.work()
    captures = batch.read_captures(made.list, ())
    shutil.rmtree(captures[1].run_dir)  # type: ignore[arg-type]
    (captures[2].run_dir / "normlift" / "manifest.json").write_text("{")  # type: ignore[operator]
    checkpoint = made.configs[3].parent / "nerfstudio_models" / "step-000000009.ckpt"
    checkpoint.parent.mkdir()
    checkpoint.write_bytes(b"trained anew")
    outcomes = made.work()
    assert made.begun() == {"c00": 1, "c01": 2, "c02": 1, "c03": 2}
    assert made.states() == ["done", "done", "failed", "done"]
    message = outcomes[captures[2].key].message
    assert "manifest.json" in message and f"delete {captures[2].run_dir}" in message
    made.work("--encoder", "color")  # other options: all of them
    assert made.begun() == {"c00": 2, "c01": 3, "c02": 2, "c03": 3}
    shutil.rmtree(made.results)  # the runs themselves say that they are there
    made.work("--encoder", "color")
    assert sum(made.begun().values()) == 10
    assert {outcome.state for outcome in read_jsonl(made.results, batch.Outcome)} == {"skipped"}


def test_an_interrupted_capture_is_free_at_once(tmp_path, in_process):
    made = Batch(tmp_path, ["0"])
    in_process.append(Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        made.work()
    assert list(read_claim_states(made.results / "claims").values()) == [ClaimState(1, "left")]
    made.work(patience=86400.0)
    assert made.states() == ["done"]


def test_who_was_taken_for_dead_writes_nothing_and_takes_over_where_the_other_dies(tmp_path, in_process):
    made = Batch(tmp_path, ["0"])
    (capture,) = batch.read_captures(made.list, ())

    def taken_over(beat: Callable[[], bool]) -> int | None:
        assert beat()
        assert try_claim(made.results / "claims", capture.key, after=1) is not None  # another one, which dies at once
        return 0 if beat() else None

    in_process.append(taken_over)
    made.work(patience=0.3)
    assert read_claim_states(made.results / "claims") == {capture.key: ClaimState(3, "done")}
    assert [(line.attempt, line.state) for line in read_jsonl(made.results, batch.Outcome)] == [(3, "done")]
    assert made.begun() == {"c00": 1}


def test_lines_of_the_list(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = ["\ufeff# a list", "", "a/config.yml", '  "b c.ply" --colmap "b c" --reliability-beta 2  ']
    lines += ["--load-gsplat x#1.pt --transforms t.json", "X.PLY"]
    Path("list.txt").write_text("\r\n".join(lines), "utf8")
    found = batch.read_captures(Path("list.txt"), ("--encoder", "color"))
    assert [capture.arguments[2:-2] for capture in found] == [
        ("--load-config", "a/config.yml"),
        ("--load-ply", "b c.ply", "--colmap", "b c", "--reliability-beta", "2"),
        ("--load-gsplat", "x#1.pt", "--transforms", "t.json"),
        ("--load-ply", "X.PLY"),
    ]
    assert all(capture.arguments[:2] == ("--encoder", "color") for capture in found)
    assert all(capture.arguments[-2:] == ("--timestamp", f"batch_{capture.key}") for capture in found)
    assert found[0].run_dir is None  # the config is not there
    assert found[1].run_dir == tmp_path / "outputs" / "b c" / "normlift" / f"batch_{found[1].key}"
    assert len({capture.key for capture in found}) == 4


def test_the_identity_of_a_capture_is_that_of_scene_and_options(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"1234")
    line = tmp_path / "list.txt"

    def key(text: str, *options: str) -> str:
        line.write_text(text)
        return batch.read_captures(line, options)[0].key

    path, beta = str(tmp_path / "a.ply"), "--reliability-beta"
    first = key(path)
    assert key(f"--load-ply {path}") == key(f"{tmp_path}/./a.ply") == first
    assert key(path, beta, "1") == key(f"{path} {beta} 1.0", beta, "3") == first  # the default
    assert key(path, "--device", "cpu", "--output-dir", "elsewhere") == first
    others = [(beta, "2"), ("--colmap", "x"), ("--queries", "red"), ("--encoder", "color"), ("--refine", "False")]
    keys = [key(path, *options) for options in others]
    assert len({first, *keys}) == 1 + len(others)
    assert key(f"{path} {beta} 2") == keys[0]
    (tmp_path / "a.ply").write_bytes(b"12345")
    assert key(path) not in {first, *keys}


def test_mistakes_are_one_message_and_leave_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    for text, flags, *facts in (
        ("# none\n\n", "list.txt", "list.txt"),
        ("a\nb 'c\n", "list.txt", "list.txt, line 2", "b 'c"),
        ("a\n\nb --encodr x\n", "list.txt", "list.txt, line 3", "--encodr"),
        ("a --vote-k 0\n", "list.txt", "list.txt, line 1", "k must be at least 1, got 0"),
        ("a\nb\n./a\n", "list.txt", "list.txt, line 3", "line 1"),
        ("a --timestamp x", "list.txt", "list.txt, line 1", "--timestamp"),
        ("a --help", "list.txt", "list.txt, line 1", "ns-normlift --help"),
        ("a", "list.txt -- --quiet yes --log-file x", "after --", "--quiet"),  # is for another command
        ("a", "list.txt -- --load-ply x.ply", "--load-ply", "after --"),
        ("a", "list.txt -- --vote-k 0", "--vote-k must be at least 1, got 0"),
        ("a\0b", "list.txt", "list.txt, line 1", "--load-config"),
        ("\udcff", "list.txt", "list.txt", "UTF-8"),
        ("a", "list.txt --shard 2/1", "--shard", "i/n"),
        ("a", "list.txt --patience 0", "--patience must be in 1..86400, got 0"),
        ("a", "list.txt --results file", "file", "--results"),
        ("a", "gone.txt", "gone.txt", "ns-normlift-batch"),
        ("a", ".", "a folder"),
    ):
        Path("list.txt").write_bytes(text.encode("utf8", "surrogateescape"))
        assert run_entry(monkeypatch, batch.entrypoint, *flags.split()) == 1
        told = said(capsys)
        assert all(fact in told for fact in facts) and "Traceback" not in told, (text, flags, told)
        assert sorted(os.listdir()) == ["file", "list.txt"]


def test_a_part_of_the_list_by_the_environment(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("normlift_ns.cli.batch.run_logged", lambda *_: 0)
    made = Batch(tmp_path, ["0"] * 5)
    for task in range(3):
        for name, value in array(task + 4, 3, least=4).items():
            monkeypatch.setenv(name, value)
        assert run_entry(monkeypatch, batch.entrypoint, made.list) == 0
        assert f"5 captures in {made.list} ({2 if task < 2 else 1} in part {task + 1} of 3)" in said(capsys)
    lines = read_jsonl(made.results, batch.Outcome)
    assert len(lines) == len({line.key for line in lines}) == 5
    assert len(list(made.results.glob("*.jsonl"))) == 3


@pytest.mark.slow
def test_real_captures_one_of_them_damaged(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("list.txt").write_text(f"{trained}\ngone/config.yml\n")
    flags = ("list.txt", "--results", "results", "--", *SMALL, "--output-dir", "lifted", "--queries", "red")
    assert run_entry(monkeypatch, batch.entrypoint, *flags) == 1
    text = said(capsys)
    assert "1 lifted, 1 failed" in text and "config gone/config.yml does not exist" in text
    (config,) = Path().glob("lifted/room/normlift/batch_*/config.yml")
    stored = open_run(config).ask_stored()
    assert stored is not None and stored["red"].peak > 0.8
    lines = [json.loads(line) for path in Path("results").glob("*.jsonl") for line in path.read_text().splitlines()]
    found = sorted((line["state"], line["capture"], line["code"]) for line in lines)
    assert found == [("done", str(trained), 0), ("failed", "gone/config.yml", 1)]


def test_the_last_attempt_counts_whatever_the_clocks_say():
    def outcome(attempt: int, state: batch.OutcomeState, clock: float) -> batch.Outcome:
        return batch.Outcome("fox", "a", attempt, state, 1.0, "", 0, None, "w", clock)

    failed, done, found = outcome(1, "failed", 9e9), outcome(2, "done", 5.0), outcome(3, "skipped", 1.0)
    broken = outcome(4, "failed", 0.0)
    for lines, latest in (((failed, done, found), done), ((failed, found), found), ((broken, done, found), broken)):
        assert all(batch.latest_outcomes(order) == {"a": latest} for order in permutations(lines))


def array(task: int, count: int, least: int = 0, step: int = 1) -> dict[str, str]:
    numbers = {"ID": task, "COUNT": count, "MIN": least, "MAX": least + step * (count - 1), "STEP": step}
    return {f"SLURM_ARRAY_TASK_{name}": str(number) for name, number in numbers.items()}


def held(parts: list[batch.Shard], size: int) -> list[int]:
    """How many parts hold each entry of a list; no part is larger than another by more than one."""
    sizes = [sum(map(part.contains, range(size))) for part in parts]
    assert max(sizes) - min(sizes) <= 1
    return [sum(part.contains(position) for part in parts) for position in range(size)]


@given(st.integers(1, 12), st.integers(0, 5), st.integers(1, 4), st.integers(1, 4), st.integers(0, 100))
def test_shards_tasks_of_an_array_and_ranks_hold_everything_exactly_once(count, least, step, ranks, size):
    ours = [{"RANK": str(r), "WORLD_SIZE": str(ranks)} for r in range(ranks)]
    tasks = [array(least + i * step, count, least, step) for i in range(count)]
    for parts in (
        [batch.make_shard(f"{i}/{count}", {}) for i in range(1, count + 1)],
        [batch.make_shard("auto", rank) for rank in ours],
        [batch.make_shard("auto", task | rank) for task in tasks for rank in ours],
    ):
        assert held(parts, size) == [1] * size


def test_what_the_environment_says_and_cannot_say():
    assert batch.make_shard("auto", {}) == batch.make_shard("none", array(1, 3)) == batch.WHOLE_LIST
    assert batch.make_shard("auto", array(5, 4, least=4)) == batch.Shard(1, 4)
    assert batch.make_shard("auto", {"SLURM_ARRAY_TASK_ID": "2", "SLURM_ARRAY_TASK_COUNT": "3"}) == batch.Shard(2, 3)
    assert batch.make_shard("3/3", array(1, 5)) == batch.Shard(2, 3)

    for word in ("", "1", "0/3", "4/3", "-1/3", "1/3/2", "a/b", "٣/٣", "1/99999999", " 1/2"):
        with pytest.raises(InputError, match="--shard must be auto, none, or i/n"):
            batch.make_shard(word, {})
    for environment, *facts in (
        ({"RANK": "0"}, "RANK is set", "WORLD_SIZE is not"),
        ({"WORLD_SIZE": "2"}, "WORLD_SIZE is set", "RANK is not"),
        ({"RANK": "2", "WORLD_SIZE": "2"}, "RANK is 2", "WORLD_SIZE, 2"),
        ({"RANK": "x", "WORLD_SIZE": "2"}, "RANK", "at least 0", "'x'"),
        ({"RANK": "0", "WORLD_SIZE": "0"}, "WORLD_SIZE", "at least 1", "'0'"),
        ({"SLURM_ARRAY_TASK_ID": "1"}, "SLURM_ARRAY_TASK_ID is set", "SLURM_ARRAY_TASK_COUNT is not"),
        (array(7, 3, least=1), "SLURM_ARRAY_TASK_ID is 7", "COUNT is 3", "MIN is 1"),
        (array(3, 2, least=0, step=2), "without gaps"),
        (array(0, 2, least=1), "without gaps"),
    ):
        with pytest.raises(InputError) as told:
            batch.make_shard("auto", environment)
        assert [fact for fact in facts if fact not in str(told.value)] == [], told.value
