"""Shards of a capture list: the part of a numbered worker."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from normlift_ns.errors import InputError
from normlift_ns.ranges import shown

_MAX_SHARDS = 10**6
_TASK_ID, _TASK_COUNT, _TASK_MIN, _TASK_STEP = (f"SLURM_ARRAY_TASK_{name}" for name in ("ID", "COUNT", "MIN", "STEP"))


@dataclass(frozen=True)
class Shard:
    """One of `count` parts of a list."""

    index: int
    """Number of the part, from 0."""
    count: int

    def holds(self, position: int) -> bool:
        """Return whether a position in the list, from 0, belongs to this part; each belongs to exactly one part.

        >>> [position for position in range(7) if Shard(1, 3).holds(position)]
        [1, 4]
        """
        return position % self.count == self.index


ALL = Shard(0, 1)


def make_shard(word: str, environment: Mapping[str, str]) -> Shard:
    """Return the part that --shard or the environment selects.

    In a Slurm array whose tasks have several ranks (RANK, WORLD_SIZE), each rank of each task has its own part.

    Args:
        word: auto for the part in the environment, none for the whole list, or i/n for the i-th of n parts, i from 1.
        environment: Environment variables.
    Raises:
        InputError: The word is invalid, variables contradict each other, or a Slurm array has gaps.

    >>> make_shard("2/3", {}), make_shard("auto", {"RANK": "0", "WORLD_SIZE": "4"}), make_shard("auto", {})
    (Shard(index=1, count=3), Shard(index=0, count=4), Shard(index=0, count=1))
    """
    if word == "none":
        return ALL
    if word == "auto":
        task, rank = _slurm_shard(environment), _rank_shard(environment)
        return Shard(task.index * rank.count + rank.index, task.count * rank.count)
    match = re.fullmatch(r"(\d{1,7})/(\d{1,7})", word, re.ASCII)
    if match is None or not 1 <= int(match[1]) <= int(match[2]) <= _MAX_SHARDS:
        raise InputError(
            f"--shard must be auto, none, or i/n for the i-th of n parts, from 1/n to n/n; got {shown(word)}. For the "
            "second of four workers, give --shard 2/4."
        )
    return Shard(int(match[1]) - 1, int(match[2]))


def _slurm_shard(environment: Mapping[str, str]) -> Shard:
    if _TASK_ID not in environment:
        return ALL
    if _TASK_COUNT not in environment:
        raise InputError(f"{_TASK_ID} is set, but {_TASK_COUNT} is not. Set both, or give the part with --shard i/n.")
    task, count = _integer(environment, _TASK_ID, 0), _integer(environment, _TASK_COUNT, 1)
    first, step = _integer(environment, _TASK_MIN, 0, "0"), _integer(environment, _TASK_STEP, 1, "1")
    index, remainder = divmod(task - first, step)
    if remainder != 0 or not 0 <= index < count:
        raise InputError(
            f"{_TASK_ID} is {task}, but expected {count} tasks from {first} on, without gaps. Submit an array without "
            "gaps, such as sbatch -a 0-7; or give --shard none, with which workers claim captures in a shared folder."
        )
    return Shard(index, count)


def _rank_shard(environment: Mapping[str, str]) -> Shard:
    present = [name for name in ("RANK", "WORLD_SIZE") if name in environment]
    if len(present) == 0:
        return ALL
    if len(present) == 1:
        missing = "RANK" if present == ["WORLD_SIZE"] else "WORLD_SIZE"
        raise InputError(f"{present[0]} is set, but {missing} is not. Set both, or give the part with --shard i/n.")
    rank, count = _integer(environment, "RANK", 0), _integer(environment, "WORLD_SIZE", 1)
    if rank >= count:
        raise InputError(f"RANK is {rank}, but must be less than WORLD_SIZE, {count}. Set both, or give --shard i/n.")
    return Shard(rank, count)


def _integer(environment: Mapping[str, str], name: str, least: int, default: str = "") -> int:
    text = environment.get(name, default)
    if not re.fullmatch(r"\d{1,7}", text, re.ASCII) or int(text) < least:
        raise InputError(
            f"{name} must be a whole number, at least {least}, got {shown(text)}. Set it, or give the part with "
            "--shard i/n."
        )
    return int(text)
