"""Reference of every option of every command, with defaults and ranges, from the code: python -m research.reference

The command writes docs/options.md. A test compares the page with the code, and its flags with the help of the commands.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from normlift_ns.cli.batch import NormLiftBatch
from normlift_ns.cli.check import NormLiftCheck
from normlift_ns.cli.common import OUTPUT_FLAGS_HELP, field_docstrings, first_paragraph
from normlift_ns.cli.evaluate import NormLiftEval
from normlift_ns.cli.export import NormLiftExport
from normlift_ns.cli.lift import NormLift
from normlift_ns.cli.query import NormLiftQuery
from normlift_ns.cli.serve import NormLiftServe
from normlift_ns.cli.view import NormLiftView
from normlift_ns.cli.weights import NormLiftWeights
from normlift_ns.options import OPTION_RANGES, VOTE_FLAGS, RefineConfig

PAGE = Path(__file__).parents[1] / "docs" / "options.md"
COMMANDS: dict[str, type] = {
    "ns-normlift": NormLift,
    "ns-normlift-check": NormLiftCheck,
    "ns-normlift-weights": NormLiftWeights,
    "ns-normlift-query": NormLiftQuery,
    "ns-normlift-view": NormLiftView,
    "ns-normlift-serve": NormLiftServe,
    "ns-normlift-export": NormLiftExport,
    "ns-normlift-batch": NormLiftBatch,
    "ns-normlift-eval": NormLiftEval,
}
HEAD = """# Options of every command

This page is generated from the code: `python -m research.reference`. `--help` prints the same texts, without loading
torch.

{flags} Options that are True or False are written `--refine False`, as in nerfstudio; `--save-query` alone means
`--save-query True`. Commands reject values that are out of range before they load anything.

`ns-train normlift` has the options of `ns-normlift` too, as `--pipeline.source.…`, `--pipeline.lift.…` and
`--pipeline.queries` ([training and lifting in one](train.md)).
"""
_TABLE = "\n| option | default | values | what it does |\n|---|---|---|---|\n"
_KINDS = {Path: "a path", str: "a text", bool: "`True`, `False`"}


def page() -> str:
    """Return the whole page."""
    return HEAD.format(flags=_text(OUTPUT_FLAGS_HELP)) + "".join(
        section(name, command) for name, command in COMMANDS.items()
    )


def section(name: str, command: type) -> str:
    """Return the options of one command, or of a command that inherits those of ns-normlift, only its own."""
    inherited = {field.name for field in dataclasses.fields(NormLift)} if command is not NormLift else set()
    inherits = issubclass(command, NormLift) and command is not NormLift
    fields = [f for f in dataclasses.fields(command) if not (inherits and f.name in inherited)]
    hints = get_type_hints(command, include_extras=True)
    groups = [f.name for f in fields if dataclasses.is_dataclass(_bare(hints[f.name]))]
    told = f"\n## {name}\n\n{_text(first_paragraph(command))}\n"
    if inherits:
        told += "\nIt takes all options of [ns-normlift](#ns-normlift), and this one:\n"
    told += _TABLE + "".join(_rows(command, [f.name for f in fields if f.name not in groups]))
    return told + "".join(_group(name, _bare(hints[group])) for group in groups)


def _group(command: str, options: Any) -> str:
    title = options.__name__.removesuffix("Options").removesuffix("Config")
    hints = get_type_hints(options, include_extras=True)
    names = [field.name for field in dataclasses.fields(options)]
    inner = [name for name in names if dataclasses.is_dataclass(_bare(hints[name]))]
    told = f"\n### {command}: {title}\n\n{_text(first_paragraph(options))}\n" + _TABLE
    told += "".join(_rows(options, [name for name in names if name not in inner]))
    return told + "".join(_group(command, _bare(hints[name])) for name in inner)


def _rows(options: Any, names: list[str]) -> Iterator[str]:
    hints = get_type_hints(options, include_extras=True)
    fields = {field.name: field for field in dataclasses.fields(options)}
    texts: dict[str, str] = {}
    for part in filter(dataclasses.is_dataclass, reversed(options.__mro__)):
        texts |= field_docstrings(part)
    for name in names:
        text = _text(texts[name])
        flag = VOTE_FLAGS[name] if options is RefineConfig and name in VOTE_FLAGS else name
        shown = f"`--{flag.replace('_', '-')}`"
        for part in get_args(hints[name])[1:]:  # a place on the command line has no flag
            shown = f"`{part.metavar}`" if getattr(part, "metavar", None) else shown
        cells = (shown, _default(fields[name]), _values(name, _bare(hints[name])), text)
        yield f"| {' | '.join(cells)} |\n"


def _text(text: str) -> str:
    """Return a docstring in one line of Markdown, with flags as code."""
    line = " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
    return re.sub(r"(?<![\w-])--[a-z][a-z0-9-]*", r"`\g<0>`", line)


def _default(field: dataclasses.Field[Any]) -> str:
    value = field.default
    if value is dataclasses.MISSING:
        return "required"
    if value is None or value == ():
        return ""
    return f"`{value:,}`" if type(value) is int and value > 9999 else f"`{value}`"


def _values(name: str, hint: Any) -> str:
    """Return the accepted values of an option, in words."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Literal:
        return ", ".join(f"`{word}`" for word in parts)
    if origin in (Union, types.UnionType):
        kinds = [part for part in parts if part is not type(None)]
        words = [f"`{word}`" for kind in kinds if get_origin(kind) is Literal for word in get_args(kind)]
        rest = [_values(name, kind) for kind in kinds if get_origin(kind) is not Literal]
        return ", ".join(words + rest)
    if origin is tuple:
        inner = _values(name, parts[0])
        return {"a text": "texts", "a path": "paths"}.get(inner, f"any of {inner}")
    if hint in (int, float):
        words = OPTION_RANGES[name].description
        return words if words.startswith("a ") else f"a {'whole ' if hint is int else ''}number, {words}"
    return _KINDS[hint]


def _bare(hint: Any) -> Any:
    """Return a type without its annotations for tyro."""
    return _bare(get_args(hint)[0]) if get_origin(hint) is Annotated else hint


if __name__ == "__main__":
    PAGE.write_text(page(), "utf8")
    sys.stdout.write(f"Written: {PAGE}\n")
