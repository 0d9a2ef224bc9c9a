"""Validation of options: one table of ranges, and the declared types. Imports no heavy package.

Options are dataclasses that call `check_options` in `__post_init__`. Wrong values are therefore reported before
anything is loaded, in the commands, in `ns-train normlift` and in Python.
"""

from __future__ import annotations

import math
import os
import re
import types
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from normlift_ns.errors import InputError

_MAX_INT, _MAX_FLOAT = 2**31 - 1, 1e30
"""Default bounds of integers and floats: larger numbers overflow in int32 and float32."""
_MIN_DIVISOR = 1e-6
"""Smallest value of options that the code divides by."""
LONGEST_TEXT = 10_000
"""Largest number of characters in a prompt. CLIP reads about 70 words of it."""
_MAX_SHOWN = 60
"""Largest number of characters of a value in a message."""


@dataclass(frozen=True)
class Range:
    """Smallest and largest value of an option, and their description in messages."""

    low: float
    high: float
    words: str


def _at_least(low: int, high: int = _MAX_INT) -> Range:
    return Range(low, high, f"at least {low}" if high == _MAX_INT else f"in {low}..{high}")


_POSITIVE = Range(_MIN_DIVISOR, _MAX_FLOAT, f"positive, at least {_MIN_DIVISOR:g}")
_NOT_NEGATIVE = Range(0.0, _MAX_FLOAT, "not negative")
_FRACTION = Range(0.0, 1.0, "in 0..1")
_FINITE = Range(-_MAX_FLOAT, _MAX_FLOAT, "finite")

RANGES: dict[str, Range] = {
    # the vote
    "k": _at_least(1),
    "num_devices": _at_least(1, 4096),
    "sigma_d": _POSITIVE,
    "tau": Range(-1.0, 1.0, "in -1..1"),
    "gamma": _POSITIVE,
    "delta": _NOT_NEGATIVE,
    "prior": _NOT_NEGATIVE,
    # the lift
    "max_views": _at_least(1),
    "lift_downscale": _at_least(1),
    "beta": _NOT_NEGATIVE,
    "consensus_power": _NOT_NEGATIVE,
    "consensus_sample": _at_least(1),
    "consensus_least": _FRACTION,
    "tolerance": Range(1e-9, _MAX_FLOAT, "positive, at least 1e-09"),
    "load_step": _at_least(0),
    # 2D features
    "region_count": _at_least(1, 2**20),
    "regions_background": Range(-_MAX_INT, _MAX_INT, "a 32-bit integer"),
    "test_every": _at_least(2),
    # queries
    "threshold": _FINITE,
    "min_reliability": _FRACTION,
    "segment_views": _at_least(1),
    # objects
    "reach": _POSITIVE,
    "min_size": _at_least(1),
    "floater_limit": _FINITE,
    "metres_per_unit": _POSITIVE,
    "transfer_distance": _POSITIVE,
    # evaluation
    "min_opacity": _FRACTION,
    "margin": _FINITE,
    "purity": _FRACTION,
    "min_weight": _NOT_NEGATIVE,
    # the viewer
    "port": Range(1, 65535, "a port number, 1..65535"),
    "most_drawn": _at_least(1, 10**7),
    # batches
    "patience": Range(1.0, 86400.0, "in 1..86400"),
    # the demo
    "num_gaussians": _at_least(2000, 10**8),
    "views": _at_least(3, 10**5),
}
"""Range of every numeric option, by name. No range contains nan or infinity."""

_show_flags: ContextVar[bool] = ContextVar("flags", default=False)


@contextmanager
def named_as_flags() -> Iterator[None]:
    """Let messages name options as flags (--sigma-d) instead of fields (sigma_d)."""
    token = _show_flags.set(True)
    try:
        yield
    finally:
        _show_flags.reset(token)


def option_name(name: str) -> str:
    """Return the name of an option for a message.

    >>> option_name("sigma_d")
    'sigma_d'
    >>> with named_as_flags():
    ...     option_name("sigma_d")
    '--sigma-d'
    """
    return f"--{name.replace('_', '-')}" if _show_flags.get() else name


def check_options(options: Any) -> None:
    """Check every field of an options dataclass against its declared type and its range.

    Lists become tuples, strings become paths and integers become floats if the field declares that type.

    Raises:
        InputError: A value has the wrong type or is out of range.
    """
    for name, hint in _hints(type(options)).items():
        object.__setattr__(options, name, _convert(name, getattr(options, name), hint))


def check_number(name: str, value: Any, kind: type[int] | type[float] = float) -> Any:
    """Return the value of a numeric option in `RANGES` as int or float.

    Raises:
        InputError: The value is not a number, not finite, or out of range.

    >>> check_number("min_size", 20, int), check_number("reach", 4)
    (20, 4.0)
    """
    integer = kind is int
    if isinstance(value, bool) or not isinstance(value, Integral if integer else Real):
        raise _error(name, f"a {'whole ' if integer else ''}number", value)
    bounds, number = RANGES[name], cast(Any, value)
    if not bounds.low <= number <= bounds.high:  # also true for nan
        too_large = number > bounds.high and not bounds.words.startswith("in ")
        limit = "finite" if number == math.inf else f"at most {bounds.high:{',' if integer else 'g'}}"
        raise _error(name, limit if too_large else bounds.words, value)
    return kind(number)


def check_bool(name: str, value: object) -> None:
    """Raise InputError unless the value is True or False; the string "False" would be truthy."""
    if not isinstance(value, bool):
        raise _error(name, "True or False", value)


def check_device(device: Any) -> str:
    """Return the name of a device: auto, cpu, cuda, or cuda:1 for the second GPU.

    Raises:
        InputError: The device has another name.

    >>> check_device("cuda:0")
    'cuda:0'
    """
    if not re.fullmatch(r"auto|cpu|cuda(:\d{1,3})?", str(device), re.ASCII):
        raise InputError(f"--device must be auto, cpu or cuda, got {shown(str(device))}")
    return str(device)


def check_texts(name: str, texts: Sequence[str]) -> None:
    """Check a list of prompts.

    Args:
        name: Name of the option.
        texts: The prompts.
    Raises:
        InputError: A prompt is empty, repeated, too long, or contains an invalid character.
    """
    if isinstance(texts, str):
        raise InputError(f"{option_name(name)} must be a list of prompts, got the single prompt {shown(texts)}")
    previous: set[str] = set()
    for number, text in enumerate(texts, start=1):
        label = f"prompt {number} of {len(texts)} in {option_name(name)}"
        if not isinstance(text, str):
            raise InputError(f"{label} must be a string, got {shown(text)}")
        if text.strip() == "":
            raise InputError(f"{label} is empty ({shown(text)}); remove it, or write what to search for")
        if len(text) > LONGEST_TEXT:
            raise InputError(f"{label} has {len(text):,} characters; give at most {LONGEST_TEXT:,}")
        if "\0" in text or not _is_unicode(text):
            raise InputError(f"{label} contains an invalid character ({shown(text)}); remove it")
        if text in previous:
            raise InputError(f"{label}, {shown(text)}, is a duplicate; give every prompt once")
        previous.add(text)


def shown(value: object) -> str:
    """Return a short description of a value for a message, even if its repr fails.

    >>> shown("x" * 100)[-5:], shown(10**5000)
    ('xxx …', 'a number of type int')
    """
    try:
        text = repr(value)
    except Exception:  # the repr of unknown objects, or of integers with thousands of digits
        return f"a number of type {type(value).__name__}" if isinstance(value, Real) else type(value).__name__
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]} …"


@cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _error(name: str, expected: str, value: object) -> InputError:
    return InputError(f"{option_name(name)} must be {expected}, got {shown(value)}")


def _convert(name: str, value: Any, hint: Any) -> Any:
    """Return the value in the declared type of the field."""
    origin, choices = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in choices:
            return None
        kinds = [choice for choice in choices if choice is not type(None)]
        words = [word for kind in kinds if get_origin(kind) is Literal for word in get_args(kind)]
        others = [kind for kind in kinds if get_origin(kind) is not Literal]
        if len(others) == 0:  # Rule | Literal["auto"]
            return _check_choice(name, value, words)
        return value if isinstance(value, str) and value in words else _convert(name, value, others[0])
    if origin is Literal:
        return _check_choice(name, value, choices)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise _error(name, "a list", value)
        return tuple(_convert(name, item, choices[0]) for item in value)
    return _convert_scalar(name, value, hint)


def _convert_scalar(name: str, value: Any, hint: type) -> Any:
    if hint in (int, float):
        return check_number(name, value, hint)
    if hint is Path:
        return check_path(name, value)
    if not isinstance(value, hint):
        raise _error(name, {bool: "True or False", str: "a string"}.get(hint, f"of type {hint.__name__}"), value)
    if hint is str and ("\0" in value or not _is_unicode(value)):
        raise InputError(f"{option_name(name)} contains an invalid character ({shown(value)}); remove it")
    return value


def _check_choice(name: str, value: object, choices: Sequence[Any]) -> Any:
    for choice in choices:
        if type(value) is type(choice) and value == choice:
            return choice
    raise InputError(f"{option_name(name)} must be one of {', '.join(map(str, choices))}; got {shown(value)}")


def check_path(name: str, value: object) -> Path:
    """Return a string or a path as a path.

    Args:
        name: Name of the option.
        value: The string or path.
    Raises:
        InputError: The value is neither, or contains a NUL character.

    >>> check_path("data", "fox").name
    'fox'
    """
    if not isinstance(value, str | os.PathLike) or not isinstance(os.fspath(value), str):
        raise _error(name, "a path", value)
    if "\0" in os.fspath(value):
        raise InputError(
            f"{option_name(name)} is not a valid path: it contains a NUL character ({shown(os.fspath(value))})"
        )
    return Path(value)


def _is_unicode(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
