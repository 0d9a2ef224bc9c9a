"""Who is gone is noticed; who is slow is waited for."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from normlift_ns.errors import InputError
from normlift_ns.team import heart as module
from normlift_ns.team.heart import Heart, Lost
from normlift_ns.team.launch import rank_of, told


class Store:
    """A store in a dictionary, as torch's is."""

    def __init__(self) -> None:
        self.values: dict[str, bytes] = {}
        self.gone = False

    def set(self, key: str, value: str) -> None:
        if self.gone:
            raise RuntimeError("Broken pipe")
        self.values[key] = value.encode()

    def get(self, key: str) -> bytes:
        return self.values[key]

    def check(self, keys: list[str]) -> bool:
        return all(key in self.values for key in keys)

    def add(self, key: str, more: int) -> int:
        self.values[key] = str(int(self.values.get(key, b"0")) + more).encode()
        return int(self.values[key])

    def wait(self, keys: list[str], patience: Any) -> None:
        until = time.monotonic() + patience.total_seconds()
        while not self.check(keys) and time.monotonic() < until:
            time.sleep(0.01)


HEARTS: list[Heart] = []


@pytest.fixture(autouse=True)
def fast(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Heartbeats of milliseconds; signals are noted. All hearts are stopped in the end: one that is not ends the
    process."""
    sent: list[int] = []
    monkeypatch.setattr(module, "BEAT", 0.02)
    monkeypatch.setattr(module, "PATIENCE", 0.4)
    monkeypatch.setattr("normlift_ns.team.heart.os.kill", lambda pid, number: sent.append(number))
    yield sent
    for one in HEARTS:
        one._stop.set()
    HEARTS.clear()


def team(size: int) -> tuple[Store, list[Heart]]:
    store = Store()
    hearts = [Heart(store, rank, size, lambda lost: None) for rank in range(size)]
    HEARTS.extend(hearts)
    for one in hearts:
        one.start()
    return store, hearts


def test_a_slow_process_is_waited_for(fast: list[int]) -> None:
    _, hearts = team(3)
    time.sleep(1)  # more than twice the patience, in which nothing else happens
    assert [one.lost for one in hearts] == [None] * 3
    for one in reversed(hearts):
        one.stop(well=True)
    assert fast == []


def test_a_heartbeat_that_stands_still_is_noticed_by_all_others() -> None:
    _, hearts = team(3)
    time.sleep(0.1)
    hearts[1]._stop.set()  # as if it had been killed
    found = [hearts[r].wait_for_a_loss() for r in (0, 2)]
    assert [lost is not None and (lost.rank, lost.failed) for lost in found] == [(1, False)] * 2
    assert "process" in found[0].place  # type: ignore[union-attr]


def test_one_that_ends_well_is_not_missed(fast: list[int]) -> None:
    _, hearts = team(2)
    hearts[1].stop(well=True)
    time.sleep(0.8)
    assert hearts[0].lost is None and fast == []
    hearts[0].stop(well=True)


def test_one_that_fails_says_so_and_only_the_first_one_speaks() -> None:
    _, hearts = team(3)
    assert hearts[2].stop(well=False)
    for r in (0, 1):
        lost = hearts[r].wait_for_a_loss()
        assert lost is not None and (lost.rank, lost.failed) == (2, True)
        assert not hearts[r].stop(well=False)


def test_a_process_that_does_not_wait_is_asked_to_end(fast: list[int]) -> None:
    store, hearts = team(2)
    hearts[1]._stop.set()
    store.values["end/1"] = b"failed"
    time.sleep(0.3)
    assert fast == [15]
    hearts[0].stop(well=False)


def test_a_store_that_is_gone_is_process_0() -> None:
    store, hearts = team(2)
    time.sleep(0.1)
    store.gone = True
    lost = hearts[1].wait_for_a_loss()
    assert lost is not None and lost.rank == 0
    assert threading.active_count() < 50


@pytest.mark.parametrize("change", [{"RANK": "x"}, {"RANK": "2"}, {"WORLD_SIZE": "-1"}])
def test_an_environment_that_cannot_be(change: dict[str, str]) -> None:
    good = {"RANK": "1", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}
    assert rank_of(good) == (1, 2)
    assert rank_of(good | {"RANK": "0", "WORLD_SIZE": "1"}) is None
    with pytest.raises(InputError, match="torchrun"):
        rank_of(good | change)


def test_what_people_are_told() -> None:
    text = told(Lost(1, False, "there, process 7"))
    assert text.startswith("Process 1 (there, process 7) is gone") and "start the command again" in text
