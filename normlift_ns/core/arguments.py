"""Runtime checks of public functions' arguments against their annotations.

`check_arguments` decorates the functions, dataclasses and NamedTuples of the public API. Arguments that are annotated
as tensors may also be NumPy arrays or nested lists of numbers, which are converted. This module imports torch only to
convert such arguments.
"""

from __future__ import annotations

import builtins
import inspect
import math
import re
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial, wraps
from itertools import chain, repeat
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints, is_typeddict

import numpy as np

from normlift_ns.errors import ArgumentError, InputError
from normlift_ns.options import check_path, short_repr

_T = TypeVar("_T")
_Sizes = dict[str, Any]
"""Length of each named axis in the arguments checked so far."""
_Check = Callable[[str, Any, _Sizes], Any]
"""Function that takes the name and value of an argument and the known axis lengths, and returns the converted value."""


def check_arguments(target: _T) -> _T:
    """Decorate a function, dataclass or NamedTuple to check its arguments against their annotations on every call.

    >>> @check_arguments
    ... def double(number: int, word: Literal["twice"] = "twice") -> int:
    ...     return 2 * number
    >>> double(1.5)
    Traceback (most recent call last):
        ...
    normlift_ns.errors.ArgumentError: number must be a whole number, got 1.5
    """
    owner, made = cast(Any, target), isinstance(target, type)
    name = "__new__" if issubclass(owner if made else int, tuple) else "__init__"
    function = getattr(owner, name) if made else owner
    checks = cache(partial(_checks_of, owner, function))

    @wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        positions, named = checks()
        sizes: _Sizes = {}
        args = tuple([check(name, value, sizes) for (name, check), value in zip(positions(), args)])
        for name, value in kwargs.items():
            if name in named:
                kwargs[name] = named[name](name, value, sizes)
        return function(*args, **kwargs)

    if not made:
        return cast(_T, checked)
    setattr(owner, name, checked)
    return target


def _checks_of(owner: Any, function: Any) -> tuple[Callable[[], Iterable[tuple[str, _Check]]], dict[str, _Check]]:
    """Return a function that yields (name, check) pairs for positional arguments, and a dictionary of all checks."""
    hints = get_type_hints(owner, localns=cast(Any, _Names(sys.modules[owner.__module__].__dict__)))
    named, ordered, more = dict[str, _Check](), list[tuple[str, _Check]](), ("", _anything)
    for p in inspect.signature(function).parameters.values():
        if p.kind == p.VAR_KEYWORD and p.name in hints:  # **kwargs: Unpack[TypedDict]
            named |= {key: _check_of(hint) for key, hint in get_type_hints(get_args(hints[p.name])[0]).items()}
            continue
        named[p.name] = _check_of(hints.get(p.name, Any))
        if p.kind == p.VAR_POSITIONAL:
            more = (f"each of *{p.name}", named[p.name])
        elif p.kind < p.VAR_POSITIONAL:
            ordered.append((p.name, named[p.name]))
    return lambda: chain(ordered, repeat(more)), named


def check_rows(name: str, rows: Any, size: int, low: int = 0) -> None:
    """Raise InputError unless all row indices are in low..size - 1.

    Args:
        size: Number of rows.
        low: Smallest valid index; -1 if missing rows are marked by -1.
    """
    if rows.numel() == 0:
        return
    first, last = map(int, rows.aminmax())
    if first < low or last >= size:
        expected = f"in {low}..{size - 1}" if size > low else "empty"
        raise InputError(f"{name} must be {expected}, got {first if first < low else last}")


class _Names(dict[str, Any]):
    """Namespace for evaluating annotations. Names that are imported only for type checkers resolve to Any."""

    def __missing__(self, name: str) -> Any:
        if hasattr(builtins, name):
            raise KeyError(name)
        return Any


def _error(name: str, expected: str, value: Any) -> ArgumentError:
    shown = f"{value.dtype} {tuple(value.shape)}" if _layout(value) == "" else short_repr(value)
    return ArgumentError(f"{name} must be {expected}{';' if 'one of ' in expected else ','} got {shown}")


def _anything(_name: str, value: Any, _sizes: _Sizes) -> Any:
    return value


def _check_of(hint: Any) -> _Check:
    """Return the check for an annotation. Annotations without a rule accept any value."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is None:
        return _ArrayCheck(hint) if hasattr(hint, "dim_str") else _plain_check(hint)
    if origin in _GENERIC:
        return _GENERIC[origin](parts)
    if issubclass(origin, Mapping):
        return _mapping_check(_check_of(parts[1]))
    return _list_check(origin, parts[0]) if issubclass(origin, Iterable) else _anything


def _plain_check(hint: Any) -> _Check:
    if hint in (int, float):
        return _number_check(hint)
    if hint is Path:
        return lambda name, value, _: check_path(name, value)
    if getattr(hint, "_is_protocol", False):
        members = {m for m in dir(hint) if not m.startswith("_")}
        return _instance_check(
            lambda x: members <= {*dir(type(x)), *getattr(x, "__dict__", ())}, f"an implementation of {hint.__name__}"
        )
    if hint in (Any, object) or not isinstance(hint, type) or is_typeddict(hint):
        return _anything
    if (hint.__module__, hint.__name__) == ("torch", "Tensor"):
        return lambda name, value, _: as_tensor(name, value, "an array")
    label = f"of type {'torch.' * (hint.__module__ == 'torch')}{hint.__name__}"
    kind = {bool: "True or False", str: "a string", type(None): "None"}.get(hint, label)
    return _instance_check(lambda value: isinstance(value, hint), kind)


def _literal_check(words: Sequence[Any]) -> _Check:
    typed = [(type(word), word) for word in words]
    expected = f"one of {', '.join(map(str, words))}" if len(words) != 1 else repr(words[0])
    return _instance_check(lambda value: (type(value), value) in typed, expected)


def _instance_check(accepts: Callable[[Any], bool], expected: str) -> _Check:
    def check(name: str, value: Any, _: _Sizes) -> Any:
        if not accepts(value):
            raise _error(name, expected, value)
        return value

    return check


def _number_check(kind: type) -> _Check:
    accepted, expected = (Integral, "a whole number") if kind is int else (Real, "a number")

    def check(name: str, value: Any, _: _Sizes) -> Any:
        if type(value) is kind and (kind is int or not math.isnan(value)):
            return value
        try:
            if isinstance(value, accepted) and not isinstance(value, bool) and not math.isnan(value):
                return cast(Any, kind)(value)
        except OverflowError:  # an integer that is too large for a float
            raise _error(name, "a number that fits into float64", value) from None
        raise _error(name, expected, value)

    return check


def _union_check(parts: Sequence[Any]) -> _Check:
    words = [word for part in parts if get_origin(part) is Literal for word in get_args(part)]
    others = [part for part in parts if get_origin(part) is not Literal and part is not type(None)]
    checks = [_check_of(part) for part in others if part is not str or Path not in parts]
    checks += [_literal_check(words)] * (len(words) > 0)
    return partial(_check_any, checks, type(None) in parts)


def _check_any(checks: Sequence[_Check], optional: bool, name: str, value: Any, sizes: _Sizes) -> Any:
    if value is None and optional:
        return None
    expected, start = list[str](), f"{name} must be "
    for check in checks:
        try:
            return check(name, value, sizes)
        except InputError as error:
            if len(checks) == 1 or not str(error).startswith(start):  # an error about one item of the value
                raise
            expected.append(re.split("[,;] got ", str(error).removeprefix(start))[0])
    raise _error(name, " or ".join(dict.fromkeys(expected)), value)


def _list_check(origin: type, hint: Any) -> _Check:
    """Return the check for a sequence or an iterable.

    Items of lists, tuples and ranges are checked immediately. Items of other values are not checked if the annotation
    is a Sequence, else they are checked lazily.
    """
    item = _check_of(hint)

    def check(name: str, value: Any, _: _Sizes) -> Any:
        accepted = isinstance(value, origin | list | tuple) and not isinstance(value, str | bytes | Mapping)
        if not accepted or getattr(value, "ndim", 1) == 0:
            such = f" such as [{short_repr(value)}]" if isinstance(value, str) else ""
            raise _error(name, "a list" + such, value)
        items = (item(f"{name}[{i}]", one, {}) for i, one in enumerate(value))
        if isinstance(value, list | tuple | range):
            return tuple(items) if isinstance(value, tuple) or origin is tuple else list(items)
        return value if origin is Sequence else items

    return check


def _tuple_check(parts: Sequence[Any]) -> _Check:
    if parts[1:] == (...,):
        return _list_check(tuple, parts[0])
    checks = [_check_of(part) for part in parts]

    def check(name: str, value: Any, sizes: _Sizes) -> Any:
        if not isinstance(value, list | tuple) or len(value) != len(checks):
            raise _error(name, f"a tuple of {len(checks)} items", value)
        return tuple(one(f"{name}[{i}]", item, sizes) for i, (one, item) in enumerate(zip(checks, value)))

    return check


def _mapping_check(item: _Check) -> _Check:
    def check(name: str, value: Any, _: _Sizes) -> Any:
        if not isinstance(value, Mapping):
            raise _error(name, "a dictionary", value)
        return value if item is _anything else {key: item(f"{name}[{key!r}]", one, {}) for key, one in value.items()}

    return check


def _function_check(parts: Sequence[Any]) -> _Check:
    """Return the check for a function.

    It checks the number of parameters. If the function must return an array, every call checks the arguments and the
    result.
    """
    arguments, result = [_check_of(hint) for hint in parts[0]], _check_of(parts[1])

    def check(name: str, value: Any, sizes: _Sizes) -> Any:
        try:
            inspect.signature(value if callable(value) else lambda: 0).bind(*arguments)
        except TypeError:
            count = f"{len(arguments)} argument{'s' * (len(arguments) != 1)}"
            raise _error(name, f"a function of {count}", value) from None
        except ValueError:  # some built-in functions have no signature
            pass

        def call(*args: Any) -> Any:
            known = dict(sizes)
            for one, arg in zip(arguments, args):
                one(name, arg, known)
            return result(f"the result of {name}", value(*args), known)

        return call if isinstance(result, _ArrayCheck) else value

    return check


class _ArrayCheck:
    """Check for a jaxtyping annotation: data type, number of axes, and length of every axis."""

    def __init__(self, hint: Any) -> None:
        self.kind, axes = hint.__name__.partition("[")[0].rstrip("0123456789"), hint.dim_str.split()
        self.kinds = {self.kind, "Int"} if self.kind == "UInt" and "8" not in hint.__name__ else {self.kind}
        self.expected = f"an array of {_KINDS.get(self.kind, self.kind)} of shape [{', '.join(axes)}]"
        self.axes, self.wide = axes, axes[:1] != [] and axes[0].startswith("*")  # *n stands for any number of axes
        self.to_numpy, self.numpy = hint.array_type is np.ndarray, hint.array_type in (np.ndarray, Any)

    def __call__(self, name: str, value: Any, sizes: _Sizes) -> Any:
        """Return the value as a tensor, or as a NumPy array if the annotation requires it.

        NumPy arrays are not converted if the annotation accepts them.
        """
        value = value if self.numpy and isinstance(value, np.ndarray) else self._convert(name, value)
        shape, more = tuple(value.shape), len(value.shape) - len(self.axes)
        if _kind_of(value.dtype) not in self.kinds or (more < -1 if self.wide else more != 0):
            raise _error(name, self.expected, value)
        for axis, length in zip(self.axes, (shape[: more + 1], *shape[more + 1 :]) if self.wide else shape):
            if length != (int(axis) if axis.isdigit() else sizes.setdefault(axis, length)):
                known = "" if axis.isdigit() else f" with {axis} = {sizes[axis]}"
                raise _error(name, self.expected + known, value)
        return value

    def _convert(self, name: str, value: Any) -> Any:
        array = as_tensor(name, value, self.expected)
        if self.kind == "Float" and isinstance(value, list | tuple) and _kind_of(array.dtype) == "Int":
            array = array.float()
        if not self.to_numpy or _kind_of(array.dtype) not in _KINDS:
            return array
        return (array.float() if str(array.dtype) == "torch.bfloat16" else array).detach().cpu().numpy()


_GENERIC: dict[Any, Callable[[Sequence[Any]], _Check]] = {
    Union: _union_check, types.UnionType: _union_check, Literal: _literal_check, tuple: _tuple_check,
    Callable: _function_check,
}  # fmt: skip
_KINDS = {"Float": "floating-point numbers", "Int": "whole numbers", "UInt": "bytes", "Bool": "True and False"}


@cache
def _kind_of(dtype: Any) -> str:
    """Return "Float", "Int", "UInt" or "Bool", or the name of any other dtype."""
    name = str(dtype).removeprefix("torch.").replace("bfloat", "float").replace("float8", "8-bit float")
    return next((kind for kind in _KINDS if name.startswith(kind.lower())), name)


def _layout(value: Any) -> str | None:
    """Return the layout of a tensor if it is unsupported, "" for a usable tensor or array, or None for other values."""
    torch = sys.modules.get("torch")
    if torch is None or not isinstance(value, torch.Tensor):
        return "" if isinstance(value, np.ndarray) else None
    layout = "nested" if value.is_nested else "meta" if value.is_meta else str(value.layout)
    return layout.removeprefix("torch.").removeprefix("strided")


def as_tensor(name: str, value: Any, expected: str) -> Any:
    """Convert a tensor, array or nested list to a tensor, or raise ArgumentError with `expected` in the message."""
    if not isinstance(value, np.ndarray | list | tuple):
        if (layout := _layout(value)) is None:
            raise _error(name, expected, value)
        if layout != "":
            raise ArgumentError(f"{name} must be {expected}, got a {layout} tensor; pass a dense tensor with data")
        return value.resolve_neg()
    import torch  # noqa: PLC0415 (a command-line query does not need it)

    try:
        return torch.as_tensor(np.asarray(value, order="C") if isinstance(value, np.ndarray) else value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise _error(name, expected, value) from None
