"""Which photographs were held out of the training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from normlift_ns.errors import InputError


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
        raise InputError("--test-every and --holdout both say which photographs are held out; give one of them")
    if test_every is not None:
        if test_every < 2:
            raise InputError(
                f"--test-every must be at least 2, got {test_every}; leave it out where nothing was held out"
            )
        return frozenset(names[::test_every])
    share = _share(holdout)
    if share is not None:
        trained = np.linspace(0, len(names) - 1, int(np.ceil(len(names) * (1 - share))), dtype=int)
        return frozenset(np.delete(np.array(names, dtype=object), trained).tolist())
    wanted = list(holdout)
    if len(wanted) == 1 and wanted[0].endswith(".txt"):
        wanted = _listed(Path(wanted[0]))
    return frozenset(name for want in wanted for name in _matching(want, names))


def _share(holdout: Sequence[str]) -> float | None:
    if len(holdout) != 1:
        return None
    try:
        share = float(holdout[0])
    except ValueError:
        return None
    if share.is_integer() and not 0 <= share <= 1:
        return None  # the name of a photograph
    if not 0 < share < 1:
        raise InputError(
            f"--holdout {holdout[0]} is no share: expected a number between 0 and 1, such as 0.1, or names"
        )
    return share


def _listed(file: Path) -> list[str]:
    """Names in a text file, one per line."""
    if not file.is_file():
        raise InputError(
            f"--holdout names {file}, and there is no such file. Expected one name of a photograph per line."
        )
    try:
        names = [line.strip() for line in file.read_text("utf-8-sig").splitlines()]
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is no UTF-8 text ({error}). Expected one name of a photograph per line.") from error
    if not any(names):
        raise InputError(f"{file} is empty. Expected the names of the photographs that were held out, one per line.")
    return [name for name in names if name != ""]


def _matching(wanted: str, names: Sequence[str]) -> list[str]:
    path = Path(wanted)
    for short in (lambda name: name, lambda name: name.name, lambda name: name.with_suffix(""), lambda name: name.stem):
        found = [name for name in names if str(short(Path(name))) == str(path)]
        if len(found) > 1:
            raise InputError(f"--holdout {wanted} fits {len(found)} photographs: {', '.join(found)}. Give whole names.")
        if found:
            return found
    found = [name for name in names if path.as_posix().endswith(f"/{name}")]
    if len(found) != 1:
        raise InputError(
            f"--holdout names {wanted}, but no photograph is called so; there are {len(names)}, "
            f"{names[0]} to {names[-1]}"
        )
    return found
