"""Which photographs were held out of the training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np


def held_out_names(names: Sequence[str], *, test_every: int | None, holdout: Sequence[str]) -> frozenset[str]:
    """Names of the photographs that the training did not see.

    Args:
        names: of all photographs, sorted.
        test_every: every n-th is held out, from the first on, as in gsplat's trainer and in Inria's with --eval.
        holdout: names, with or without folder and suffix; or one text file with a name per line; or one share below
            1, as ns-train's dataparser holds out the photographs that its evenly spaced training set leaves over.
    Raises:
        ValueError: a name that no photograph has, or both ways at once.
    """
    if test_every is not None and len(holdout) > 0:
        raise ValueError("--test-every and --holdout both say which photographs are held out; give one of them")
    if test_every is not None:
        if test_every < 2:
            raise ValueError(f"--test-every must be at least 2, got {test_every}; --views all holds nothing out")
        return frozenset(names[::test_every])
    share = _share(holdout)
    if share is not None:
        trained = np.linspace(0, len(names) - 1, int(np.ceil(len(names) * (1 - share))), dtype=int)
        return frozenset(np.delete(np.array(names, dtype=object), trained).tolist())
    wanted = list(holdout)
    if len(wanted) == 1 and wanted[0].endswith(".txt") and Path(wanted[0]).is_file():
        wanted = [line.strip() for line in Path(wanted[0]).read_text("utf8").splitlines() if line.strip() != ""]
    return frozenset(name for want in wanted for name in _matching(want, names))


def _share(holdout: Sequence[str]) -> float | None:
    if len(holdout) != 1:
        return None
    try:
        share = float(holdout[0])
    except ValueError:
        return None
    return share if 0 < share < 1 else None


def _matching(wanted: str, names: Sequence[str]) -> list[str]:
    path = Path(wanted)
    found = [
        name
        for name in names
        if wanted in (name, Path(name).name, Path(name).stem, Path(name).with_suffix("").as_posix())
    ]
    if not found:
        raise ValueError(
            f"--holdout names {path}, but no photograph is called so; there are {len(names)}, {names[0]} to {names[-1]}"
        )
    return found
