"""What every option may be: one table of ranges, and the types that the options declare. Imports nothing heavy.

Options are dataclasses that call `check_options` when they are made, so that a mistake shows before anything is
loaded, in the commands as in `ns-train normlift` and in Python.
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

_LARGEST_WHOLE, _LARGEST = 2**31 - 1, 1e30
"""Bounds of whole numbers and of all others without a bound of their own: larger ones overflow in int32 and float32."""
_SMALLEST = 1e-6
"""Of numbers that something is divided by."""
LONGEST_TEXT = 10_000
"""Characters of a text. CLIP reads some 70 words of it."""
_SHOWN = 60


@dataclass(frozen=True)
class Range:
    """Least and greatest value, and how a message says that."""

    low: float
    high: float
    words: str


def _at_least(low: int, high: int = _LARGEST_WHOLE) -> Range:
    return Range(low, high, f"at least {low}" if high == _LARGEST_WHOLE else f"in {low}..{high}")


_POSITIVE = Range(_SMALLEST, _LARGEST, f"positive, at least {_SMALLEST:g}")
_NOT_NEGATIVE = Range(0.0, _LARGEST, "not negative")
_SHARE = Range(0.0, 1.0, "in 0..1")
_ANY = Range(-_LARGEST, _LARGEST, "finite")

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
    "consensus_least": _SHARE,
    "tolerance": Range(1e-9, _LARGEST, "positive, at least 1e-09"),
    "load_step": _at_least(0),
    # 2D features
    "region_count": _at_least(1, 2**20),
    "regions_background": Range(-_LARGEST_WHOLE, _LARGEST_WHOLE, "a value of 32 bits"),
    "test_every": _at_least(2),
    # questions
    "threshold": _ANY,
    "min_reliability": _SHARE,
    "segment_views": _at_least(1),
    # objects
    "reach": _POSITIVE,
    "min_size": _at_least(1),
    "floater_limit": _ANY,
    "metres_per_unit": _POSITIVE,
    "transfer_distance": _POSITIVE,
    # evaluation
    "min_opacity": _SHARE,
    "margin": _ANY,
    "purity": _SHARE,
    "min_weight": _NOT_NEGATIVE,
    # the viewer
    "port": Range(1, 65535, "a number of a port, 1..65535"),
    "most_drawn": _at_least(1, 10**7),
    # many captures
    "patience": Range(1.0, 86400.0, "in 1..86400"),
    # the demo
    "num_gaussians": _at_least(2000, 10**8),
    "views": _at_least(3, 10**5),
}
"""Every option that is a number, by its name. nan and infinity are in no range."""

_flags: ContextVar[bool] = ContextVar("flags", default=False)


@contextmanager
def named_as_flags() -> Iterator[None]:
    """Messages within name an option as a command's flag, --sigma-d; else they name the field, sigma_d."""
    token = _flags.set(True)
    try:
        yield
    finally:
        _flags.reset(token)


def option_name(name: str) -> str:
    """How a message names an option.

    >>> option_name("sigma_d")
    'sigma_d'
    >>> with named_as_flags():
    ...     option_name("sigma_d")
    '--sigma-d'
    """
    return f"--{name.replace('_', '-')}" if _flags.get() else name


def check_options(options: Any) -> None:
    """Checks every field of a dataclass of options by its declared type and its range; lists become tuples, texts
    paths and whole numbers floats where the field wants that.

    Raises:
        InputError: a value of another type or out of its range.
    """
    for name, hint in _hints(type(options)).items():
        object.__setattr__(options, name, _checked(name, getattr(options, name), hint))


def check_number(name: str, value: Any, kind: type[int] | type[float] = float) -> Any:
    """A number that `RANGES` knows, as int or float.

    Raises:
        InputError: no number, nan, infinite, or out of its range.

    >>> check_number("min_size", 20, int), check_number("reach", 4)
    (20, 4.0)
    """
    whole = kind is int
    if isinstance(value, bool) or not isinstance(value, Integral if whole else Real):
        raise _mistake(name, f"a {'whole ' if whole else ''}number", value)
    bounds, number = RANGES[name], cast(Any, value)
    if not bounds.low <= number <= bounds.high:  # nan is in no range
        beyond = number > bounds.high and not bounds.words.startswith("in ")
        most = "finite" if number == math.inf else f"at most {bounds.high:{',' if whole else 'g'}}"
        raise _mistake(name, most if beyond else bounds.words, value)
    return kind(number)


def check_bool(name: str, value: object) -> None:
    """Raises InputError for anything but True and False: "False" would count as true."""
    if not isinstance(value, bool):
        raise _mistake(name, "True or False", value)


def check_device(device: Any) -> str:
    """The device as a text: auto, cpu, cuda, or cuda:1 for the second.

    Raises:
        InputError: another one.

    >>> check_device("cuda:0")
    'cuda:0'
    """
    if not re.fullmatch(r"auto|cpu|cuda(:\d{1,3})?", str(device), re.ASCII):
        raise InputError(f"--device must be auto, cpu or cuda, got {shown(str(device))}")
    return str(device)


def check_texts(name: str, texts: Sequence[str]) -> None:
    """Checks what is asked for.

    Args:
        name: of the option.
    Raises:
        InputError: a text that is empty, repeated, too long, or holds what is no character.
    """
    if isinstance(texts, str):
        raise InputError(f"{option_name(name)} must be a list of texts, got the single text {shown(texts)}")
    seen: set[str] = set()
    for number, text in enumerate(texts, start=1):
        which = f"text {number} of {len(texts)} of {option_name(name)}"
        if not isinstance(text, str):
            raise InputError(f"{which} must be a text, got {shown(text)}")
        if text.strip() == "":
            raise InputError(f"{which} is empty ({shown(text)}); remove it, or say in words what to look for")
        if len(text) > LONGEST_TEXT:
            raise InputError(f"{which} has {len(text):,} characters; give at most {LONGEST_TEXT:,}")
        if "\0" in text or not _is_unicode(text):
            raise InputError(f"{which} holds a character that no text has ({shown(text)}); remove it")
        if text in seen:
            raise InputError(f"{which}, {shown(text)}, is given twice; give every text once")
        seen.add(text)


def shown(value: object) -> str:
    """A value as a message shows it: short, and whatever its repr does.

    >>> shown("x" * 100)[-5:], shown(10**5000)
    ('xxx …', 'a number of type int')
    """
    try:
        text = repr(value)
    except Exception:  # of any foreign object, and of whole numbers of thousands of digits
        return f"a number of type {type(value).__name__}" if isinstance(value, Real) else type(value).__name__
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]} …"


@cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _mistake(name: str, expected: str, value: object) -> InputError:
    return InputError(f"{option_name(name)} must be {expected}, got {shown(value)}")


def _checked(name: str, value: Any, hint: Any) -> Any:
    """The value in the type of the field."""
    origin, choices = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in choices:
            return None
        kinds = [choice for choice in choices if choice is not type(None)]
        words = [word for kind in kinds if get_origin(kind) is Literal for word in get_args(kind)]
        others = [kind for kind in kinds if get_origin(kind) is not Literal]
        if len(others) == 0:  # Rule | Literal["auto"]
            return _one_of(name, value, words)
        return value if isinstance(value, str) and value in words else _checked(name, value, others[0])
    if origin is Literal:
        return _one_of(name, value, choices)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise _mistake(name, "a list", value)
        return tuple(_checked(name, part, choices[0]) for part in value)
    return _plain(name, value, hint)


def _plain(name: str, value: Any, hint: type) -> Any:
    if hint in (int, float):
        return check_number(name, value, hint)
    if hint is Path:
        return check_path(name, value)
    if not isinstance(value, hint):
        raise _mistake(name, {bool: "True or False", str: "a text"}.get(hint, f"of type {hint.__name__}"), value)
    if hint is str and ("\0" in value or not _is_unicode(value)):
        raise InputError(f"{option_name(name)} holds a character that no text has ({shown(value)}); remove it")
    return value


def _one_of(name: str, value: object, choices: Sequence[Any]) -> Any:
    for choice in choices:
        if type(value) is type(choice) and value == choice:
            return choice
    raise InputError(f"{option_name(name)} must be one of {', '.join(map(str, choices))}; got {shown(value)}")


def check_path(name: str, value: object) -> Path:
    """A path from a text or a path.

    Args:
        name: of the option.
    Raises:
        InputError: something else, or a text that is no path.

    >>> check_path("data", "fox").name
    'fox'
    """
    if not isinstance(value, str | os.PathLike) or not isinstance(os.fspath(value), str):
        raise _mistake(name, "a path", value)
    if "\0" in os.fspath(value):
        raise InputError(f"{option_name(name)} is no path, it holds a NUL character ({shown(os.fspath(value))})")
    return Path(value)


def _is_unicode(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
