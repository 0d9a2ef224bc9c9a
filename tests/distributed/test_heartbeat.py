"""Who is gone is noticed; who is slow is waited for."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import pytest
from torch.distributed import HashStore

from normlift_ns.distributed import heartbeat, launch
from normlift_ns.distributed.heartbeat import HEARTBEAT_TIMEOUT, Heartbeat
from normlift_ns.distributed.launch import rank_and_world_size
from normlift_ns.errors import InputError

ENVIRONMENT = {"RANK": "1", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}


class Store(HashStore):
    """A store of one process, which can be gone."""

    gone = False

    def set(self, key: str, value: str) -> None:
        if self.gone:
            raise RuntimeError("Broken pipe")
        super().set(key, value)


def until(found: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not found():
        assert time.monotonic() < end
        time.sleep(0.001)


class World:
    """A team, its clock, and what it does to this process."""

    def __init__(self) -> None:
        self.store, self.hearts, self.now = Store(), [], 0.0
        self.signals, self.exits, self.words, self.threads = [], [], [], []

    def team(self, size: int) -> list[Heartbeat]:
        self.hearts = [Heartbeat(self.store, rank, size, self.words.append) for rank in range(size)]
        for one in self.hearts:
            before = set(threading.enumerate())
            one.start()
            self.threads += set(threading.enumerate()) - before
        self.pass_by(0)
        return self.hearts

    def kill(self, rank: int) -> None:
        """Its heart stands still."""
        self.hearts[rank]._stop.set()
        self.threads[rank].join(60)
        self.pass_by(0)

    def pass_by(self, seconds: float) -> None:
        """Time passes, and then all who are well have beaten, and have heard all the others."""
        self.now += seconds
        for _ in range(2):
            alive = [f"beat/{one.rank}" for one in self.hearts if not one._stop.is_set() and one.failure is None]
            before = {key: self.store.get(key) for key in alive}
            until(lambda before=before: all(self.store.get(key) != beat for key, beat in before.items()))


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    """All hearts are stopped in the end: one that is not ends the process."""
    assert (heartbeat.HEARTBEAT_INTERVAL, HEARTBEAT_TIMEOUT, heartbeat._GRACE) == (2, 30, 10)
    found = World()
    monkeypatch.setattr(heartbeat, "HEARTBEAT_INTERVAL", 0.002)
    monkeypatch.setattr(heartbeat, "time", SimpleNamespace(monotonic=lambda: found.now))
    monkeypatch.setattr(os, "kill", lambda pid, number: found.signals.append(number))
    monkeypatch.setattr(os, "_exit", found.exits.append)
    yield found
    for one in found.hearts:
        one._stop.set()


def test_a_slow_process_is_waited_for_and_one_that_ends_well_is_not_missed(world: World) -> None:
    hearts = world.team(3)
    hearts[2].stop(well=True)
    for _ in range(4):
        world.pass_by(0.95 * HEARTBEAT_TIMEOUT)
    assert [one.failure for one in hearts] == [None] * 3
    for one in hearts[1::-1]:
        one.stop(well=True)
    assert world.signals == []


def test_a_heartbeat_that_stands_still_is_noticed_by_all_others(world: World) -> None:
    hearts = world.team(3)
    world.kill(1)
    hearts[0]._waiting = hearts[2]._waiting = True
    world.pass_by(0.4 * HEARTBEAT_TIMEOUT)
    world.pass_by(0.5 * HEARTBEAT_TIMEOUT)
    assert hearts[0].failure is hearts[2].failure is None
    world.now += 0.2 * HEARTBEAT_TIMEOUT
    found = [hearts[r].wait_for_failure() for r in (0, 2)]
    assert [lost is not None and (lost.rank, lost.reported) for lost in found] == [(1, False)] * 2
    assert str(os.getpid()) in found[0].host and world.signals == []  # type: ignore[union-attr]


def test_one_that_fails_says_so_and_only_the_first_one_speaks(world: World) -> None:
    hearts = world.team(3)
    hearts[0]._waiting = hearts[1]._waiting = True
    assert hearts[2].stop(well=False)
    for r in (0, 1):
        lost = hearts[r].wait_for_failure()
        assert lost is not None and (lost.rank, lost.reported) == (2, True)
        assert not hearts[r].stop(well=False)


def test_a_process_that_does_not_wait_is_asked_to_end_and_then_ended(world: World, monkeypatch) -> None:
    monkeypatch.setattr(heartbeat, "_GRACE", 0.01)
    world.team(2)
    world.kill(1)
    world.store.set("end/1", "failed")
    until(lambda: len(world.exits) > 0)
    assert (world.signals, world.exits) == ([15], [1])
    assert [(lost.rank, lost.reported) for lost in world.words] == [(1, True)]


def test_a_store_that_is_gone_is_process_0(world: World) -> None:
    hearts = world.team(2)
    hearts[0]._waiting = True
    world.store.gone = True
    lost = hearts[1].wait_for_failure()
    assert lost is not None and (lost.rank, lost.reported) == (0, False)
    assert hearts[1].stop(well=False)  # to nobody, and it reports the loss


def test_where_the_store_is_gone_process_0_has_reported_its_error(world: World) -> None:
    hearts = world.team(2)
    world.kill(0)
    world.kill(1)  # before it can notice
    world.store.gone = True
    assert not hearts[1].stop(well=False)
    assert hearts[0].stop(well=False)


def test_an_environment_that_cannot_be_or_needs_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    assert rank_and_world_size(ENVIRONMENT | {"RANK": "0", "WORLD_SIZE": "1"}) is None
    for change in ({"RANK": "x"}, {"RANK": "2"}, {"RANK": "-1"}, {"WORLD_SIZE": "-1"}):
        with pytest.raises(InputError, match="torchrun"):
            rank_and_world_size(ENVIRONMENT | change)

    def connect(rank: int, size: int, backend: str, log: Any) -> Any:
        raise ConnectionError(f"{rank} of {size} by {backend}")

    monkeypatch.setattr(launch, "_connect", connect)
    for name, value in (ENVIRONMENT | {"LOCAL_RANK": "1", "TORCH_CPP_LOG_LEVEL": "ERROR"}).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ConnectionError, match="1 of 2 by gloo"), launch.distributed_context("cpu", print):
        pass
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    with pytest.raises(InputError, match="GPU"), launch.distributed_context("auto", print):
        pass


def test_waiting_for_other_processes_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(launch, "_JOIN_TIMEOUT", timedelta(seconds=0.15))
    monkeypatch.setattr(launch, "_QUIET_WAIT", 0.05)
    with pytest.raises(TimeoutError, match="process 0"):
        launch._wait(lambda: False, "process 0", said.append)
    assert len(said) == 1
