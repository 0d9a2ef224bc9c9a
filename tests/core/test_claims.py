"""Claims: one winner whoever races, and work of the dead is taken over, by the watcher's own clock."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from normlift_ns.core.disk.claims import (
    BEATS,
    LEFT,
    NEW,
    Claim,
    State,
    beat,
    claim,
    claims,
    end,
    free,
    read_pulse,
    read_states,
    states,
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


def race(tmp_path: Path, after: int) -> list[int]:
    """How many of 12 processes get each of 40 claims, in orders of their own."""

    def take(i: int) -> list[int]:
        keys = list(range(40))
        random.Random(i).shuffle(keys)
        return [key for key in keys if claim(tmp_path, f"k{key}", after) is not None]

    won = together(12, take)
    return [sum(key in each for each in won) for key in range(40)]


def test_one_process_gets_a_claim(tmp_path):
    assert race(tmp_path, 0) == [1] * 40
    assert read_states(tmp_path) == {f"k{key}": State(1, None) for key in range(40)}


def test_one_process_takes_the_work_of_the_dead_over(tmp_path):
    assert race(tmp_path, 0) == race(tmp_path, 1) == race(tmp_path, 2) == [1] * 40
    assert set(read_states(tmp_path).values()) == {State(3, None)}


def test_all_work_is_done_once_by_processes_that_share_it(tmp_path):
    keys = [f"k{i}" for i in range(60)]

    def work(i: int) -> list[str]:
        done = []
        for mine in claims(tmp_path, keys, {}, PATIENCE):
            done.append(mine.key)
            end(mine, "done")
        return done

    done = together(8, work)
    assert sorted(key for each in done for key in each) == sorted(keys)
    assert read_states(tmp_path) == {key: State(1, "done") for key in keys}


@pytest.mark.parametrize("skew", [-1e6, 0.0, 1e6])
def test_the_work_of_a_dead_owner_is_taken_over_after_the_patience(tmp_path, skew):
    dead = claim(tmp_path, "a", 0)
    assert dead is not None
    clock, taken = Clock(skew), []
    for mine in claims(tmp_path, ["a", "b"], {}, PATIENCE, clock=clock, sleep=clock.sleep):
        taken.append((mine.key, mine.number, clock.now - skew))
        end(mine, "done")
    assert taken[0] == ("b", 1, 0.0)
    ((key, number, seconds),) = taken[1:]
    assert (key, number) == ("a", 2) and PATIENCE <= seconds <= PATIENCE + 5
    assert not beat(dead, 1)  # which the dead one is told when it comes to life


def test_a_heartbeat_keeps_a_claim_until_it_stops(tmp_path):
    other = claim(tmp_path, "a", 0)
    assert other is not None

    def live(seconds: float) -> None:
        if seconds < 1000:
            assert beat(other, int(seconds))

    clock, taken = Clock(0.0, live), []
    for mine in claims(tmp_path, ["a"], {}, PATIENCE, clock=clock, sleep=clock.sleep):
        taken.append(clock.now)
        end(mine, "done")
    assert len(taken) == 1 and 1000 - 5 + PATIENCE <= taken[0] <= 1000 + PATIENCE + 5


@pytest.mark.parametrize(("outcome", "taken"), [("done", 0), ("failed", 0), (LEFT, 1)])
def test_what_another_ends_is_waited_for_and_only_what_was_left_is_taken(outcome, taken, tmp_path):
    other = claim(tmp_path, "a", 0)
    assert other is not None
    clock = Clock(0.0, lambda seconds: end(other, outcome))
    found = list(claims(tmp_path, ["a"], {}, PATIENCE, clock=clock, sleep=clock.sleep)) if taken == 0 else None
    if found is None:
        found = [next(claims(tmp_path, ["a"], {}, PATIENCE, clock=clock, sleep=clock.sleep))]
    assert [mine.number for mine in found] == [2] * taken
    assert clock.now < PATIENCE / BEATS + 5


def test_what_had_ended_before_is_tried_again_by_one(tmp_path):
    first = claim(tmp_path, "a", 0)
    assert first is not None
    end(first, "failed")
    at_start = read_states(tmp_path)
    one = claims(tmp_path, ["a"], at_start, PATIENCE)
    again = next(one)
    assert again.number == 2
    end(again, "failed")
    assert list(one) == list(claims(tmp_path, ["a"], at_start, PATIENCE)) == []


def test_heartbeats_that_cannot_be_written_are_no_errors(tmp_path):
    gone = Claim(tmp_path / "gone", "a", 1)
    assert beat(gone, 1) and read_pulse(gone) == b"" and read_states(tmp_path / "gone") == {}


def test_heartbeats_differ_and_say_who_writes_them(tmp_path):
    mine = claim(tmp_path, "a", 0)
    assert mine is not None
    seen = [read_pulse(mine)]
    for count in (1, 2, 10**11):
        beat(mine, count)
        seen.append(read_pulse(mine))
    assert len(set(seen)) == 4
    assert mine.path.read_text().split()[0] == "100000000000" and len(mine.path.read_text().split()) == 3


_ATTEMPTS = st.dictionaries(
    st.sampled_from("abc"), st.lists(st.sampled_from([None, "done", "failed", LEFT]), min_size=1, max_size=12)
)


@settings(deadline=None)
@given(_ATTEMPTS, st.randoms())
def test_the_last_attempt_counts_in_whatever_order_files_are_listed(attempts, draw):
    names = ["notes.txt", "a", ".a.1", "a.0", "a.01", "A.1", "a.1.done.x"]
    for key, outcomes in attempts.items():
        for number, outcome in enumerate(outcomes, start=1):
            names += [f"{key}.{number}", *([] if outcome is None else [f"{key}.{number}.{outcome}"])]
    draw.shuffle(names)
    assert states(names) == {key: State(len(outcomes), outcomes[-1]) for key, outcomes in attempts.items()}


def test_what_is_free():
    assert free(NEW, NEW) and free(State(1, LEFT), NEW) and free(State(2, "done"), State(2, "done"))
    assert not any(free(State(2, outcome), State(1, outcome)) for outcome in ("done", "failed"))
    assert not free(State(1, None), State(1, None))
