"""Shards hold every capture exactly once, and the environment says which is whose."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from normlift_ns.errors import InputError
from normlift_ns.scripts.captures.shards import ALL, Shard, make_shard


def array(task: int, count: int, least: int = 0, step: int = 1) -> dict[str, str]:
    """The variables of a task of a Slurm array."""
    numbers = {"ID": task, "COUNT": count, "MIN": least, "MAX": least + step * (count - 1), "STEP": step}
    return {f"SLURM_ARRAY_TASK_{name}": str(number) for name, number in numbers.items()}


def held(parts: list[Shard], size: int) -> list[int]:
    """How many parts hold each entry of a list; no part is larger than another by more than one."""
    sizes = [sum(map(part.holds, range(size))) for part in parts]
    assert max(sizes) - min(sizes) <= 1
    return [sum(part.holds(position) for part in parts) for position in range(size)]


@given(st.integers(1, 50), st.integers(0, 200))
def test_shards_hold_everything_exactly_once(count, size):
    words = held([make_shard(f"{i}/{count}", {}) for i in range(1, count + 1)], size)
    ranks = held([make_shard("auto", {"RANK": str(i), "WORLD_SIZE": str(count)}) for i in range(count)], size)
    assert words == ranks == [1] * size


@given(st.integers(1, 12), st.integers(0, 5), st.integers(1, 4), st.integers(1, 4), st.integers(0, 100))
def test_tasks_of_an_array_and_ranks_within_them_hold_everything_exactly_once(count, least, step, ranks, size):
    parts = [
        make_shard("auto", array(least + i * step, count, least, step) | {"RANK": str(r), "WORLD_SIZE": str(ranks)})
        for i in range(count)
        for r in range(ranks)
    ]
    assert held(parts, size) == [1] * size


def test_what_the_environment_says():
    assert make_shard("auto", {}) == make_shard("none", array(1, 3)) == ALL
    assert make_shard("auto", array(5, 4, least=4)) == Shard(1, 4)
    assert make_shard("auto", {"SLURM_ARRAY_TASK_ID": "2", "SLURM_ARRAY_TASK_COUNT": "3"}) == Shard(2, 3)
    assert make_shard("3/3", array(1, 5)) == Shard(2, 3)


def test_shards_and_environments_that_cannot_be():
    for word in ("", "1", "0/3", "4/3", "-1/3", "1/3/2", "a/b", "٣/٣", "1/99999999", " 1/2"):
        with pytest.raises(InputError, match="--shard must be i/n"):
            make_shard(word, {})
    for environment, *facts in (
        ({"RANK": "0"}, "RANK is set", "WORLD_SIZE is not"),
        ({"WORLD_SIZE": "2"}, "WORLD_SIZE is set", "RANK is not"),
        ({"RANK": "2", "WORLD_SIZE": "2"}, "RANK is 2", "WORLD_SIZE, 2"),
        ({"RANK": "x", "WORLD_SIZE": "2"}, "RANK", "at least 0", "'x'"),
        ({"RANK": "0", "WORLD_SIZE": "0"}, "WORLD_SIZE", "at least 1", "'0'"),
        ({"SLURM_ARRAY_TASK_ID": "1"}, "SLURM_ARRAY_TASK_ID is set", "SLURM_ARRAY_TASK_COUNT is not"),
        (array(7, 3, least=1), "SLURM_ARRAY_TASK_ID is 7", "3 tasks", "from 1"),
        (array(3, 2, least=0, step=2), "without gaps"),
        (array(0, 2, least=1), "without gaps"),
    ):
        with pytest.raises(InputError) as told:
            make_shard("auto", environment)
        assert [fact for fact in facts if fact not in str(told.value)] == [], told.value
