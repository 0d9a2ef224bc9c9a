"""Selection of the images that were held out of the training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from normlift_ns.errors import InputError


def held_out_names(names: Sequence[str], *, test_every: int | None, holdout: Sequence[str]) -> frozenset[str]:
    """Return the names of the images that the training did not use.

    Args:
        names: sorted names of all images.
        test_every: hold out every n-th image, starting with the first, as gsplat's trainer does, and Inria's with
            --eval.
        holdout: image names, with or without folder and suffix; or a text file with one name per line; or a fraction
            below 1. As in ns-train's dataparser, the training images are then evenly spaced, and the rest is held out.
    Raises:
        ValueError: if no image has one of the names, or both options are given.
    """
    if test_every is not None and len(holdout) > 0:
        raise InputError("--test-every and --holdout both select held-out images; give only one of them")
    if test_every is not None:
        if test_every < 2:
            raise InputError(f"--test-every must be at least 2, got {test_every}; omit it if nothing was held out")
        return frozenset(names[::test_every])
    fraction = _fraction(holdout)
    if fraction is not None:
        trained = np.linspace(0, len(names) - 1, int(np.ceil(len(names) * (1 - fraction))), dtype=int)
        return frozenset(np.delete(np.array(names, dtype=object), trained).tolist())
    requested = list(holdout)
    if len(requested) == 1 and requested[0].endswith(".txt"):
        requested = _read_names(Path(requested[0]))
    return frozenset(name for request in requested for name in _matching(request, names))


def _fraction(holdout: Sequence[str]) -> float | None:
    if len(holdout) != 1:
        return None
    try:
        fraction = float(holdout[0])
    except ValueError:
        return None
    if fraction.is_integer() and not 0 <= fraction <= 1:
        return None  # an image name
    if not 0 < fraction < 1:
        raise InputError(
            f"--holdout {holdout[0]} is not a fraction: expected a number between 0 and 1, such as 0.1, or image names"
        )
    return fraction


def _read_names(file: Path) -> list[str]:
    """Read image names from a text file, one per line."""
    if not file.is_file():
        raise InputError(f"--holdout names the file {file}, which does not exist. Expected one image name per line.")
    try:
        names = [line.strip() for line in file.read_text("utf-8-sig").splitlines()]
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is not UTF-8 text ({error}). Expected one image name per line.") from error
    if not any(names):
        raise InputError(f"{file} is empty. Expected the names of the held-out images, one per line.")
    return [name for name in names if name != ""]


def _matching(requested: str, names: Sequence[str]) -> list[str]:
    path = Path(requested)
    for short in (lambda name: name, lambda name: name.name, lambda name: name.with_suffix(""), lambda name: name.stem):
        matches = [name for name in names if str(short(Path(name))) == str(path)]
        if len(matches) > 1:
            raise InputError(
                f"--holdout {requested} matches {len(matches)} images: {', '.join(matches)}. Give full names."
            )
        if matches:
            return matches
    matches = [name for name in names if path.as_posix().endswith(f"/{name}")]
    if len(matches) != 1:
        raise InputError(
            f"--holdout names {requested}, but no image has this name; there are {len(names)}, "
            f"{names[0]} to {names[-1]}"
        )
    return matches
