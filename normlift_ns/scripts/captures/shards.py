"""Which captures of a list are this worker's, where somebody has numbered the workers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from normlift_ns.errors import InputError
from normlift_ns.ranges import shown

_MOST = 10**6
_ARRAY, _COUNT, _LEAST, _STEP = (f"SLURM_ARRAY_TASK_{name}" for name in ("ID", "COUNT", "MIN", "STEP"))


@dataclass(frozen=True)
class Shard:
    """One part of a list in so many parts."""

    index: int
    """From 0."""
    count: int

    def holds(self, position: int) -> bool:
        """Whether an entry of the list, counted from 0, is in this part; every entry is in exactly one.

        >>> [position for position in range(7) if Shard(1, 3).holds(position)]
        [1, 4]
        """
        return position % self.count == self.index


ALL = Shard(0, 1)


def make_shard(word: str, environment: Mapping[str, str]) -> Shard:
    """The part that --shard or the environment names.

    Tasks of a Slurm array and ranks within them (RANK, WORLD_SIZE) count together: each rank of each task has a part.

    Args:
        word: auto: as the environment says; none: all; or i/n, the i-th of n parts, i from 1.
    Raises:
        InputError: another word; variables that contradict each other; a Slurm array with gaps.

    >>> make_shard("2/3", {}), make_shard("auto", {"RANK": "0", "WORLD_SIZE": "4"}), make_shard("auto", {})
    (Shard(index=1, count=3), Shard(index=0, count=4), Shard(index=0, count=1))
    """
    if word == "none":
        return ALL
    if word == "auto":
        task, rank = _of_slurm(environment), _of_ranks(environment)
        return Shard(task.index * rank.count + rank.index, task.count * rank.count)
    match = re.fullmatch(r"(\d{1,7})/(\d{1,7})", word, re.ASCII)
    if match is None or not 1 <= int(match[1]) <= int(match[2]) <= _MOST:
        raise InputError(
            f"--shard must be i/n, the i-th of n parts, from 1/n to n/n; auto; or none. Got {shown(word)}. For the "
            "second of four workers give --shard 2/4."
        )
    return Shard(int(match[1]) - 1, int(match[2]))


def _of_slurm(environment: Mapping[str, str]) -> Shard:
    if _ARRAY not in environment:
        return ALL
    if _COUNT not in environment:
        raise InputError(f"{_ARRAY} is set, but {_COUNT} is not. Set both, or say which part with --shard i/n.")
    task, count = _number(environment, _ARRAY, 0), _number(environment, _COUNT, 1)
    index, rest = divmod(task - _number(environment, _LEAST, 0, "0"), _number(environment, _STEP, 1, "1"))
    if rest != 0 or not 0 <= index < count:
        raise InputError(
            f"{_ARRAY} is {task}, which is none of {count} tasks without gaps from {environment.get(_LEAST, '0')} on. "
            "Submit an array without gaps, such as sbatch -a 0-7; or give --shard none, by which workers claim "
            "captures in a folder that they share."
        )
    return Shard(index, count)


def _of_ranks(environment: Mapping[str, str]) -> Shard:
    given = [name for name in ("RANK", "WORLD_SIZE") if name in environment]
    if len(given) == 0:
        return ALL
    if len(given) == 1:
        missing = "RANK" if given == ["WORLD_SIZE"] else "WORLD_SIZE"
        raise InputError(f"{given[0]} is set, but {missing} is not. Set both, or say which part with --shard i/n.")
    rank, count = _number(environment, "RANK", 0), _number(environment, "WORLD_SIZE", 1)
    if rank >= count:
        raise InputError(f"RANK is {rank}, expected less than WORLD_SIZE, {count}. Set both, or give --shard i/n.")
    return Shard(rank, count)


def _number(environment: Mapping[str, str], name: str, least: int, default: str = "") -> int:
    text = environment.get(name, default)
    if not re.fullmatch(r"\d{1,7}", text, re.ASCII) or int(text) < least:
        raise InputError(
            f"{name} must be a whole number, at least {least}, got {shown(text)}. Set it, or say which part with "
            "--shard i/n."
        )
    return int(text)
