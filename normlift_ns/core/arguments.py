"""Checks of the arguments of public functions, against their annotations.

`check_arguments` decorates every public function and record. Its annotations are the kinds that it accepts. If they
say Tensor, a NumPy array and nested lists of numbers are accepted too and converted. This module does not need torch.
"""

from __future__ import annotations

import builtins
import inspect
import math
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache, wraps
from itertools import chain, repeat
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints, is_typeddict

import numpy as np

from normlift_ns.errors import ArgumentError, InputError
from normlift_ns.options import check_path, short_repr

_T = TypeVar("_T")
_Sizes = dict[str, Any]
"""Lengths of the named axes of the arguments so far."""
_Check = Callable[[str, Any, _Sizes], Any]
"""Function of name, value and sizes; it returns the converted value."""


def check_arguments(target: _T) -> _T:
    """Decorate a function, a dataclass or a NamedTuple, whose arguments are then checked against their annotations.

    >>> @check_arguments
    ... def double(number: int, word: Literal["twice"] = "twice") -> int:
    ...     return 2 * number
    >>> double(1.5)
    Traceback (most recent call last):
        ...
    normlift_ns.errors.ArgumentError: number must be a whole number, got 1.5
    """
    owner, made = cast(Any, target), isinstance(target, type)
    name = "__new__" if made and issubclass(owner, tuple) else "__init__"
    function = getattr(owner, name) if made else owner
    parameters = list(inspect.signature(function).parameters.values())

    @cache
    def checks() -> tuple[list[tuple[str, _Check]], tuple[str, _Check] | None, dict[str, _Check]]:
        hints = get_type_hints(owner, localns=cast(Any, _Names(sys.modules[owner.__module__].__dict__)))
        named = {p.name: _check_of(hints.get(p.name, Any)) for p in parameters}
        ordered = [
            (p.name, named[p.name]) for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
        ]
        more = next(((f"each of *{p.name}", named[p.name]) for p in parameters if p.kind == p.VAR_POSITIONAL), None)
        for p in parameters:
            if p.kind == p.VAR_KEYWORD and p.name in hints:  # Unpack[a TypedDict]
                named |= {key: _check_of(hint) for key, hint in get_type_hints(get_args(hints[p.name])[0]).items()}
        return ordered, more, named

    @wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        ordered, more, named = checks()
        sizes: _Sizes = {}
        places = chain(ordered, repeat(more or ("", _anything)))
        args = tuple([check(name, value, sizes) for (name, check), value in zip(places, args)])
        for name, value in kwargs.items():
            if name in named:
                kwargs[name] = named[name](name, value, sizes)
        return function(*args, **kwargs)

    if not made:
        return cast(_T, checked)
    setattr(owner, name, checked)
    return target


class _Names(dict[str, Any]):
    """Names that annotations may use; those imported for type checkers only stand for anything."""

    def __missing__(self, name: str) -> Any:
        if hasattr(builtins, name):
            raise KeyError(name)
        return Any


def _error(name: str, expected: str, value: Any) -> ArgumentError:
    shown = f"{value.dtype} {tuple(value.shape)}" if hasattr(value, "dtype") and _is_dense(value) else None
    return ArgumentError(f"{name} must be {expected}, got {shown or short_repr(value)}")


def _anything(_name: str, value: Any, _sizes: _Sizes) -> Any:
    return value


def _check_of(hint: Any) -> _Check:
    """Return the check of an annotation; annotations without a rule here accept anything."""
    if hasattr(hint, "dim_str"):
        return _array_check(hint)
    return _plain_check(hint) if get_origin(hint) is None else _generic_check(get_origin(hint), get_args(hint))


def _generic_check(origin: Any, parts: Sequence[Any]) -> _Check:
    if origin in (Union, types.UnionType):
        return _union_check(parts)
    if origin is Literal:
        words = ", ".join(map(str, parts))
        return _instance_check(lambda x: any(type(x) is type(p) and x == p for p in parts), f"one of {words}")
    if origin is Callable:
        return _instance_check(callable, "a function")
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _mapping_check(_check_of(parts[1]))
    if isinstance(origin, type) and issubclass(origin, Iterable):
        return _items_check(origin, parts if origin is tuple else (*parts[:1], ...))
    return _anything


def _plain_check(hint: Any) -> _Check:
    if hint in (int, float):
        return _number_check(hint)
    if hint is Path:
        return lambda name, value, _: check_path(name, value)
    if getattr(hint, "_is_protocol", False):
        members = [m for m in dir(hint) if not m.startswith("_")]
        return _instance_check(
            lambda x: all(hasattr(type(x), m) or m in getattr(x, "__dict__", ()) for m in members), f"a {hint.__name__}"
        )
    if hint in (Any, object) or not isinstance(hint, type) or is_typeddict(hint):
        return _anything
    if (hint.__module__, hint.__name__) == ("torch", "Tensor"):
        return lambda name, value, _: _as_tensor(name, value, "an array")
    kind = {bool: "True or False", str: "a string", type(None): "None"}.get(hint, f"of type {hint.__name__}")
    return _instance_check(lambda value: isinstance(value, hint), kind)


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
        with suppress(OverflowError):  # an integer with hundreds of digits
            if isinstance(value, accepted) and not isinstance(value, bool) and not math.isnan(value):
                return cast(Any, kind)(value)
        raise _error(name, expected, value)

    return check


def _union_check(parts: Sequence[Any]) -> _Check:
    words = tuple(word for part in parts if get_origin(part) is Literal for word in get_args(part))
    others = [part for part in parts if get_origin(part) is not Literal and part is not type(None)]
    checks = [_check_of(part) for part in others if not (part is str and Path in parts)]
    checks += [_generic_check(Literal, words)] if len(words) > 0 else []
    optional = type(None) in parts

    def check(name: str, value: Any, sizes: _Sizes) -> Any:
        if value is None and optional:
            return None
        errors: list[InputError] = []
        for one in checks:
            try:
                return one(name, value, sizes)
            except InputError as error:
                errors.append(error)
        start = f"{name} must be "
        for error in errors:  # of an item
            if len(errors) == 1 or not str(error).startswith(start):
                raise error
        raise _error(name, " or ".join(str(e).removeprefix(start).rpartition(", got ")[0] for e in errors), value)

    return check


def _items_check(origin: type, parts: Sequence[Any]) -> _Check:
    """Return the check of a tuple, a sequence or an iterable, whose items are converted as they come."""
    every, checks = parts[1:] == (...,), [_check_of(part) for part in parts if part is not ...]
    expected = "a list" if every else f"a tuple of {len(parts)}"

    def check(name: str, value: Any, sizes: _Sizes) -> Any:
        listed = isinstance(value, list | tuple)
        accepted = listed or (every and isinstance(value, origin) and not isinstance(value, str | bytes | Mapping))
        if not accepted or getattr(value, "ndim", 1) == 0 or (not every and len(value) != len(parts)):
            hint = f" such as [{short_repr(value)}]" if every and isinstance(value, str) else ""
            raise _error(name, expected + hint, value)
        rows = zip(repeat(checks[0]) if every else checks, value)
        items = (one(f"{name}[{i}]", item, sizes if not every else {}) for i, (one, item) in enumerate(rows))
        if type(value) in (list, tuple, range):
            return tuple(items) if type(value) is tuple else list(items)
        return value if origin is Sequence else items

    return check


def _mapping_check(item: _Check) -> _Check:
    def check(name: str, value: Any, _: _Sizes) -> Any:
        if not isinstance(value, Mapping):
            raise _error(name, "a dictionary", value)
        return value if item is _anything else {key: item(f"{name}[{key!r}]", one, {}) for key, one in value.items()}

    return check


def _array_check(hint: Any) -> _Check:
    """Return the check of a jaxtyping annotation: kind of numbers, number of axes, and their lengths."""
    kind = hint.__name__.partition("[")[0].rstrip("0123456789")
    axes, to_numpy, generic = hint.dim_str.split(), hint.array_type is np.ndarray, hint.array_type is Any
    expected = f"an array of {_KINDS.get(kind, kind)} of shape [{', '.join(axes)}]"
    fixed, wide = [axis for axis in axes if not axis.startswith("*")], any(axis.startswith("*") for axis in axes)

    def check(name: str, value: Any, sizes: _Sizes) -> Any:
        if not (isinstance(value, np.ndarray) and (to_numpy or generic)):
            listed = isinstance(value, list | tuple)
            array = _as_tensor(name, value, expected)
            if listed and kind == "Float" and not array.is_floating_point() and _kind_of(array) == "Int":
                array = array.float()
            if to_numpy and _kind_of(array) in _KINDS:
                array = (array.float() if str(array.dtype) == "torch.bfloat16" else array).detach().cpu().numpy()
            value = array
        shape = tuple(value.shape)
        if _kind_of(value) not in (kind, "Int" if kind == "UInt" and "8" not in hint.__name__ else kind) or (
            len(shape) < len(fixed) if wide else len(shape) != len(fixed)
        ):
            raise _error(name, expected, value)
        ends = len(shape) - len(fixed)
        for axis, length in zip(axes, (shape[:ends], *shape[ends:]) if wide else shape):
            if length != (int(axis) if axis.isdigit() else sizes.setdefault(axis, length)):
                known = "" if axis.isdigit() else f" with {axis} = {sizes[axis]}"
                raise _error(name, expected + known, value)
        return value

    return check


_KINDS = {"Float": "floating-point numbers", "Int": "whole numbers", "UInt": "bytes", "Bool": "True and False"}


def _kind_of(array: Any) -> str:
    name = str(array.dtype).removeprefix("torch.").replace("float8", "8-bit float")
    return next((kind for kind in ("Float", "Int", "Bool") if name.startswith(kind.lower())),
                "Float" if name == "bfloat16" else "UInt" if name.startswith("uint") else name)  # fmt: skip


def _is_dense(value: Any) -> bool:
    """Return whether an array is neither sparse nor nested nor without values."""
    return isinstance(value, np.ndarray) or _layout(value) == ""


def _layout(tensor: Any) -> str:
    """Return what keeps a tensor from being used as an array; "": nothing."""
    if getattr(tensor, "is_nested", False):
        return "nested"
    layout, device = str(getattr(tensor, "layout", "torch.strided")), getattr(tensor, "device", None)
    return "meta" if getattr(device, "type", "") == "meta" else layout.removeprefix("torch.").replace("strided", "")


def _as_tensor(name: str, value: Any, expected: str) -> Any:
    """Return a tensor, a NumPy array or nested lists of numbers as a tensor."""
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(value, torch.Tensor):
        if not _is_dense(value):
            raise ArgumentError(f"{name} must be {expected}, dense and with its values, got a {_layout(value)} tensor")
        return value
    if not isinstance(value, np.ndarray | list | tuple):
        raise _error(name, expected, value)
    import torch  # noqa: PLC0415 (a command-line query does not need it)

    try:
        return torch.as_tensor(np.asarray(value, order="C") if isinstance(value, np.ndarray) else value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise _error(name, expected, value) from None
