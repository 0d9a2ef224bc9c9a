"""Claims: one winner whoever races, and work of the dead is taken over; lines of JSON that several processes write."""

import os
import random
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.io import file_lock as module
from normlift_ns.io.file_lock import (
    ABANDONED,
    Claim,
    ClaimState,
    append_jsonl,
    finish_claim,
    iter_claims,
    read_claim_states,
    read_jsonl,
    read_pulse,
    try_claim,
    write_pulse,
)
from tests.processes import together

PATIENCE = 60.0


class Clock:
    """Seconds that pass while somebody sleeps, and what happens meanwhile."""

    def __init__(self, now: float, meanwhile=lambda now: None) -> None:
        self.now, self.meanwhile, self.begun = now, meanwhile, now

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        self.meanwhile(self.now - self.begun)


def taken(folder: Path, keys: list[str], clock: Clock) -> list[tuple[str, int, float]]:
    """Claims that one takes and finishes, with their numbers and times."""
    found = []
    for mine in iter_claims(folder, keys, {}, PATIENCE, clock=clock, sleep=clock.sleep):
        found.append((mine.key, mine.number, clock.now - clock.begun))
        finish_claim(mine, "done")
    return found


def claimed(folder: Path) -> Claim:
    found = try_claim(folder, "a", 0)
    assert found is not None
    return found


def test_processes_share_work_of_which_each_piece_is_done_once(tmp_path):
    """Races for new claims and for those of the dead, in orders of their own; then work by all until it is done."""
    keys = [f"k{i}" for i in range(20)]

    def work(i: int) -> list[list[str]]:
        mixed = random.Random(i).sample(keys, len(keys))
        won = [[key for key in mixed if try_claim(tmp_path / "race", key, after) is not None] for after in range(3)]
        done = []
        for mine in iter_claims(tmp_path / "work", keys, {}, PATIENCE, sleep=lambda seconds: time.sleep(0.001)):
            done.append(mine.key)
            finish_claim(mine, "done")
        return [*won, done]

    for won in zip(*together(4, work)):
        assert sorted(key for each in won for key in each) == sorted(keys)
    assert read_claim_states(tmp_path / "race") == dict.fromkeys(keys, ClaimState(3, None))
    assert read_claim_states(tmp_path / "work") == dict.fromkeys(keys, ClaimState(1, "done"))


@pytest.mark.parametrize("skew", [-1e6, 0.0, 1e6])
def test_the_work_of_a_dead_owner_is_taken_over_after_the_patience(tmp_path, skew):
    dead = claimed(tmp_path)
    first, (key, number, seconds) = taken(tmp_path, ["a", "b"], Clock(skew))
    assert first == ("b", 1, 0.0) and (key, number) == ("a", 2) and PATIENCE <= seconds <= PATIENCE + 5
    assert not write_pulse(dead, 1)  # which the dead one is told when it comes to life


def test_a_heartbeat_keeps_a_claim_until_it_stops(tmp_path):
    other = claimed(tmp_path)

    def live(seconds: float) -> None:
        if seconds < 1000:
            assert write_pulse(other, int(seconds))

    ((_, _, seconds),) = taken(tmp_path, ["a"], Clock(0.0, live))
    assert 1000 - 5 + PATIENCE <= seconds <= 1000 + PATIENCE + 5


@pytest.mark.parametrize("outcome", ["done", "failed", ABANDONED])
def test_what_another_ends_is_waited_for_and_only_what_was_left_is_taken(outcome, tmp_path):
    other = claimed(tmp_path)
    clock = Clock(0.0, lambda seconds: finish_claim(other, outcome))
    found = taken(tmp_path, ["a"], clock)
    assert [number for _, number, _ in found] == [2] * (outcome == ABANDONED)
    assert 0 < clock.now < PATIENCE / 6 + 5


def test_what_had_ended_before_is_tried_again_by_one(tmp_path):
    finish_claim(claimed(tmp_path), "failed")
    at_start = read_claim_states(tmp_path)
    one = iter_claims(tmp_path, ["a"], at_start, PATIENCE)
    again = next(one)
    assert again.number == 2
    finish_claim(again, "failed")
    assert list(one) == list(iter_claims(tmp_path, ["a"], at_start, PATIENCE)) == []


def test_heartbeats_differ_say_who_writes_them_and_may_fail(tmp_path):
    mine = claimed(tmp_path)
    seen = [read_pulse(mine)]
    for count in (1, 2, 10**11):
        write_pulse(mine, count)
        seen.append(read_pulse(mine))
    assert len(set(seen)) == 4
    assert mine.path.read_text().split()[0] == "100000000000" and len(mine.path.read_text().split()) == 3
    gone = Claim(tmp_path / "gone", "a", 1)
    assert write_pulse(gone, 1) and read_pulse(gone) == b"" and read_claim_states(tmp_path / "gone") == {}


_ATTEMPTS = st.dictionaries(
    st.sampled_from("abc"), st.lists(st.sampled_from([None, "done", "failed", ABANDONED]), min_size=1, max_size=12)
)


@given(_ATTEMPTS, st.randoms())
def test_the_last_attempt_counts_in_whatever_order_files_are_listed(attempts, draw):
    names = ["notes.txt", "a", ".a.1", "a.0", "a.01", "A.1", "a.1.done.x"]
    for key, outcomes in attempts.items():
        for number, outcome in enumerate(outcomes, start=1):
            names += [f"{key}.{number}", *([] if outcome is None else [f"{key}.{number}.{outcome}"])]
    draw.shuffle(names)
    assert module.claim_states(names) == {
        key: ClaimState(len(outcomes), outcomes[-1]) for key, outcomes in attempts.items()
    }


@dataclass(frozen=True)
class Line:
    name: str
    number: float


LINES = [Line('fox "\n\u2028 é 🦊', 1.5), Line("", 2.0), Line("}{", -3.0)]


@given(st.integers(0, 200))
def test_torn_lines_are_left_out(tmp_path_factory, cut):
    folder = tmp_path_factory.mktemp("lines")
    for line in LINES:
        append_jsonl(folder / "a.jsonl", line)
        append_jsonl(folder / "b.jsonl", line)
    whole = (folder / "a.jsonl").read_bytes()
    assert whole.count(b"\n") == len(LINES) and read_jsonl(folder, Line) == LINES * 2
    (folder / "a.jsonl").write_bytes(whole[:cut])
    ends = [i for i, byte in enumerate(whole) if byte == ord("\n")]
    assert read_jsonl(folder, Line) == LINES[: sum(end <= cut for end in ends)] + LINES


def test_what_is_no_line_of_that_kind_is_left_out(tmp_path):
    junk = (b"", b"\n\n", b"\xff\xfe\n", b"null\n", b"[1]\n", b'{"name": 1}\n', b"[" * 100_000 + b"\n", b"\0\n")
    for i, content in enumerate(junk):
        folder = tmp_path / str(i)
        folder.mkdir()
        append_jsonl(folder / "a.jsonl", LINES[0])
        with (folder / "a.jsonl").open("ab") as file:
            file.write(content)
        append_jsonl(folder / "a.jsonl", LINES[1])
        (folder / "notes.txt").write_text('{"name": "x", "number": 1}\n')
        assert read_jsonl(folder, Line) == LINES[:2], content[:20]
    assert read_jsonl(tmp_path / "nowhere", Line) == []


def test_a_line_reaches_the_disk(tmp_path, monkeypatch):
    flushed = []
    monkeypatch.setattr(os, "fsync", lambda number: flushed.append((os.fstat(number).st_ino, os.fstat(number).st_size)))
    append_jsonl(tmp_path / "a.jsonl", LINES[0])
    assert flushed == [((tmp_path / "a.jsonl").stat().st_ino, (tmp_path / "a.jsonl").stat().st_size)]
