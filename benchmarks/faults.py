"""Small faults planted in the package, to see whether the tests find them.

    python -m benchmarks.faults draw --seed 1 --output faults.json
    python -m benchmarks.faults run faults.json --tree ../checkout --tier test
    python -m benchmarks.faults table faults.json

`draw` takes places by a seed, some in every package, and keeps those that pass lint, types and import. `run` plants them
one at a time in another checkout that has a `.venv`, and runs the nearest test files first; those that remain are
planted together, and the whole tier runs once. Where a test fails then, each fault is tried with that test alone. So a
fault counts as found if a test fails that passes without it.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import os
import random
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

PACKAGES = (
    "core",
    "raster",
    "kernels",
    "encoders",
    "scenes",
    "runs",
    "session",
    "viewer",
    "objects",
    "insight",
    "evaluation",
    "nerfstudio_plugin",
    "scripts",
    ".",  # modules at the top
)
KINDS = (
    "off by one",
    "swapped sign",
    "dropped check",
    "wrong axis",
    "wrong default",
    "missing call",
    "inverted condition",
)
CALLS = {
    *("flush", "fsync", "close", "synchronize", "join", "wait", "clear", "discard", "unlink", "release", "set", "put"),
    *("notify", "notify_all", "update", "cancel", "shutdown", "truncate", "remove", "add", "sort", "start", "stop"),
    *("fill_", "copy_", "zero_", "clamp_", "mul_", "add_", "div_", "sub_", "masked_fill_", "index_add_", "scatter_add_"),
}
CHECKS = re.compile(r"^_?(check|refuse|ensure|require|validate|writable)_?")
SWAPPED = {
    ast.Lt: ">=",
    ast.GtE: "<",
    ast.Gt: "<=",
    ast.LtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.In: "not in",
    ast.NotIn: "in",
}
BOUNDS = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}


@dataclass(frozen=True)
class Fault:
    """One change of one file."""

    name: str
    package: str
    kind: str
    file: str
    line: int
    function: str
    patch: str
    found: dict[str, str] | None = None
    """By tier, the test that finds it, or "" if none does."""
    equivalent: str = ""
    """Why no test can find it, for faults that change nothing."""


Edit = tuple[str, ast.AST, str]


def edits(tree: ast.Module) -> Iterator[tuple[str, ast.AST, str, str]]:
    """Every kind, node, new text and name of the function around it."""
    for node, function in _code(tree, ""):
        for kind, place, text in _edits(node):
            yield kind, place, text, function


def _code(node: ast.AST, function: str) -> Iterator[tuple[ast.AST, str]]:
    """Nodes that run: no annotations, no docstrings, nothing for types alone."""
    yield node, function
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        function = f"{function}.{node.name}".lstrip(".")
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr | ast.Assert):
                continue
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                continue
            yield from _code(child, function)


def _number(node: ast.AST | None) -> bool:
    return isinstance(node, ast.Constant) and type(node.value) is int


def _text(node: ast.AST) -> bool:
    return isinstance(node, ast.JoinedStr | ast.List | ast.Tuple | ast.Set) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


def _edits(node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
        sides = [ast.unparse(x) for x in (node.left, node.right)]
        if not _text(node.left) and not _text(node.right):
            sign = "-" if isinstance(node.op, ast.Add) else "+"
            right = f"({sides[1]})" if isinstance(node.right, ast.BinOp) else sides[1]
            yield "swapped sign", node, f"({sides[0]} {sign} {right})"
        if _number(node.right):
            yield "off by one", node.right, str(node.right.value + 1)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
        yield "swapped sign", node, ast.unparse(node.operand)
    elif isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in BOUNDS:
        if _number(node.comparators[0]) or "len(" in ast.unparse(node) or "shape" in ast.unparse(node):
            text = f"{ast.unparse(node.left)} {BOUNDS[type(node.ops[0])]} {ast.unparse(node.comparators[0])}"
            yield "off by one", node, text
    elif isinstance(node, ast.Slice):
        for bound in (node.lower, node.upper):
            if _number(bound):
                yield "off by one", bound, str(bound.value + 1)
    elif isinstance(node, ast.Call):
        yield from _calls(node)
    elif isinstance(node, ast.Subscript) and _number(node.slice):
        if isinstance(node.value, ast.Attribute) and node.value.attr == "shape":
            yield "wrong axis", node.slice, str(1 - min(node.slice.value, 1))
        else:
            yield "off by one", node.slice, str(node.slice.value + 1)
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        called = node.value.func
        name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
        if CHECKS.match(name):
            yield "dropped check", node, "pass"
        elif name in CALLS and isinstance(called, ast.Attribute):
            yield "missing call", node, "pass"
    elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        pairs = zip(reversed(node.args.args), reversed(node.args.defaults))
        for _, default in [*pairs, *zip(node.args.kwonlyargs, node.args.kw_defaults)]:
            yield from _default(default)
    elif isinstance(node, ast.ClassDef):
        for line in node.body:
            if isinstance(line, ast.AnnAssign):
                yield from _default(line.value)
    elif isinstance(node, ast.If) and len(node.orelse) == 0 and isinstance(node.body[0], ast.Raise):
        yield "dropped check", node, "pass"
    if isinstance(node, ast.If | ast.IfExp | ast.While):
        yield "inverted condition", node.test, _inverted(node.test)


def _calls(node: ast.Call) -> Iterator[Edit]:
    for word in node.keywords:
        if word.arg in ("dim", "axis") and (value := _axis(word.value)) is not None:
            yield "wrong axis", word.value, "1" if value == 0 else "0"
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name == "range":
        for bound in node.args:
            if not _text(bound):
                yield "off by one", bound, f"{ast.unparse(bound)} + 1"
    if name in ("size", "squeeze", "unsqueeze", "flip", "any", "all") and len(node.args) == 1:
        if (value := _axis(node.args[0])) is not None:
            yield "wrong axis", node.args[0], "1" if value == 0 else "0"


def _axis(node: ast.AST) -> int | None:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and _number(node.operand):
        return -node.operand.value
    return node.value if _number(node) else None


def _default(node: ast.AST | None) -> Iterator[Edit]:
    if not isinstance(node, ast.Constant):
        return
    if isinstance(node.value, bool):
        yield "wrong default", node, str(not node.value)
    elif isinstance(node.value, int):
        yield "wrong default", node, str(node.value + 1)
    elif isinstance(node.value, float):
        yield "wrong default", node, repr(node.value * 1.5 if node.value != 0 else 0.5)


def _inverted(test: ast.expr) -> str:
    if isinstance(test, ast.Compare) and len(test.ops) == 1:
        return f"{ast.unparse(test.left)} {SWAPPED[type(test.ops[0])]} {ast.unparse(test.comparators[0])}"
    if isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not):
        return ast.unparse(test.operand)
    return f"not ({ast.unparse(test)})"


def changed(source: str, node: ast.AST, text: str) -> str:
    """A source with a node replaced."""
    data = source.encode()
    starts = [0]
    for line in data.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    start, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
    return (data[:start] + text.encode() + data[end:]).decode()


def draw(root: Path, seed: int, most: int) -> list[Fault]:
    """So many faults of every package, at most one in a file, that pass lint, types and import."""
    chance, faults, spent = random.Random(seed), [], set()
    for package in PACKAGES:
        folder = root / "normlift_ns" / package
        files = sorted(folder.glob("*.py") if package == "." else folder.rglob("*.py"))
        places: dict[str, list[Fault]] = {kind: [] for kind in KINDS}
        for file in files:
            source, name = file.read_text("utf8"), file.relative_to(root).as_posix()
            for kind, node, text, function in edits(ast.parse(source)):
                after = changed(source, node, text)
                lines = difflib.unified_diff(
                    source.splitlines(keepends=True), after.splitlines(keepends=True), f"a/{name}", f"b/{name}"
                )
                places[kind].append(Fault("", package, kind, name, node.lineno, function, "".join(lines)))
        order = list(KINDS)
        chance.shuffle(order)
        for kind in order:
            chance.shuffle(places[kind])
        taken: list[Fault] = []
        while len(taken) < most and any(places.values()):
            kind = order[0]
            order = [*order[1:], kind]
            while places[kind]:
                fault = places[kind].pop()
                if fault.file not in spent and (patch := passed(root, fault)):
                    taken.append(replace(fault, patch=patch))
                    spent.add(fault.file)
                    break
        faults += taken
        print(package, len(taken), flush=True)
    return [replace(fault, name=f"F{i + 1:02}") for i, fault in enumerate(faults)]


def passed(root: Path, fault: Fault) -> str:
    """The formatted patch of a fault, or "" if lint, types or import have something against it."""
    module = fault.file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    binaries = root / ".venv/bin"
    checks = (
        (binaries / "ruff", "check", "-q", fault.file),
        (binaries / "python", "-W", "ignore", "-c", f"import {module}"),
        (binaries / "basedpyright", fault.file),
    )
    with planted(root, [fault]):
        subprocess.run([binaries / "ruff", "format", "-q", fault.file], cwd=root, check=True)
        if any(subprocess.run(x, cwd=root, capture_output=True, check=False).returncode != 0 for x in checks):
            return ""
        return subprocess.run(["git", "diff", "--", fault.file], cwd=root, capture_output=True, text=True).stdout


class planted:  # noqa: N801
    """Applies the patches of faults to a tree, and takes them back."""

    def __init__(self, root: Path, faults: list[Fault]) -> None:
        self.root, self.files, self.patch = root, {x.file for x in faults}, "".join(x.patch for x in faults)

    def __enter__(self) -> None:
        subprocess.run(["git", "apply", "-"], input=self.patch, text=True, cwd=self.root, check=True)

    def __exit__(self, *_: object) -> None:
        subprocess.run(["git", "checkout", "-q", "--", *self.files], cwd=self.root, check=True)


TIERS = {"test": "not slow", "slow": "slow"}


def pytest(root: Path, marker: str, *words: str, limit: float) -> tuple[list[str], str]:
    """Runs tests; the names of those that fail, and what was printed. A time-out is a failure by the name of time-out."""
    report = root / ".venv/faults.xml"
    report.unlink(missing_ok=True)
    command = [".venv/bin/python", "-m", "pytest", "-q", "--no-header", "-m", marker, f"--junitxml={report}", *words]
    try:
        done = subprocess.run(
            command, cwd=root, capture_output=True, text=True, timeout=limit, check=False, env=os.environ | {"CI": "1"}
        )
    except subprocess.TimeoutExpired:
        return ["time-out"], ""
    if done.returncode == 5:  # no tests
        return [], done.stdout
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+(?:\[.*?\])?)(?: - |$)", done.stdout, re.MULTILINE)
    if done.returncode != 0 and len(failed) == 0:
        failed = ["collection"]
    return failed, done.stdout


def nearest(root: Path, fault: Fault, most: int = 8) -> list[str]:
    """Test files that name the function or module of a fault, those of its folder first."""
    stem = Path(fault.file).stem if Path(fault.file).stem != "__init__" else Path(fault.file).parent.name
    names = [x for x in fault.function.split(".") if not x.startswith("_")]
    module = fault.file.removesuffix(".py").replace("/", ".")
    scores: dict[str, float] = {}
    for path in sorted(root.glob("tests/**/test_*.py")):
        text = path.read_text("utf8")
        score = 4.0 * (module in text) + 2.0 * any(re.search(rf"\b{re.escape(x)}\b", text) for x in names)
        score += 3.0 * (path.stem == f"test_{stem}") + 1.0 * (f"tests/{fault.package}/" in path.as_posix())
        score += 0.5 * bool(re.search(rf"\b{re.escape(stem)}\b", text))
        if score > 0:
            scores[path.relative_to(root).as_posix()] = score
    return sorted(scores, key=lambda x: -scores[x])[:most]


def run(faults: list[Fault], root: Path, tier: str, label: str, save: Path) -> list[Fault]:
    """Looks for every fault with the nearest files, then for the rest with the whole tier."""
    marker, found = TIERS[tier], {x.name: dict(x.found or {}) for x in faults}

    def keep() -> None:
        save.write_text(json.dumps([asdict(replace(x, found=found[x.name])) for x in faults], indent=1) + "\n")

    workers = os.environ.get("WORKERS", "2")
    baseline: dict[str, bool] = {}

    def truly(failed: list[str]) -> list[str]:
        """Those that pass without a fault."""
        for name in failed:
            if name not in baseline and name not in ("time-out", "collection"):
                baseline[name] = len(pytest(root, marker, name, limit=900)[0]) == 0
        return [name for name in failed if baseline.get(name, True)]

    for fault in faults:
        if label in found[fault.name] or fault.equivalent:
            continue
        files = nearest(root, fault)
        with planted(root, [fault]):
            failed, _ = pytest(root, marker, "-x", "-n", workers, "--dist", "loadfile", *files, limit=900)
        failed = truly(failed)
        if failed:
            found[fault.name][label] = failed[0]
            keep()
        print(fault.name, fault.file, fault.kind, "->", failed[:1], flush=True)
    rest = [x for x in faults if label not in found[x.name] and not x.equivalent]
    known: set[str] = set()
    while rest:
        with planted(root, rest):
            failed, out = pytest(root, marker, "-n", workers, "--dist", "loadfile", limit=5400)
        failed = [x for x in truly(failed) if x not in known]
        print(f"{len(rest)} together: {len(failed)} fail", failed[:20], out[-300:] if "collection" in failed else "")
        if not failed:
            break
        blamed = False
        for fault in rest:
            with planted(root, [fault]):
                alone, _ = pytest(root, marker, "-x", *[x for x in failed if x != "time-out"][:40], limit=1800)
            if alone:
                found[fault.name][label], blamed = alone[0], True
                print(fault.name, fault.file, fault.kind, "->", alone[:1], flush=True)
                keep()
        known |= set(failed) if not blamed else set()
        rest = [x for x in rest if label not in found[x.name]]
    for fault in rest:
        found[fault.name][label] = ""
    keep()
    return [replace(x, found=found[x.name]) for x in faults]


def load(path: Path) -> list[Fault]:
    """The faults of a file."""
    return [Fault(**x) for x in json.loads(path.read_text("utf8"))]


def table(faults: list[Fault]) -> str:
    """Found of all, by package and by what was run."""
    labels = sorted({label for x in faults for label in x.found or {}})
    lines = [f"| package | faults | {' | '.join(labels)} |", f"|---|---:|{'---:|' * len(labels)}"]
    real = [x for x in faults if not x.equivalent]
    for package in [*PACKAGES, "all"]:
        here = [x for x in real if package in (x.package, "all")]
        counts = [sum(bool((x.found or {}).get(label)) for x in here) for label in labels]
        lines.append(f"| {package} | {len(here)} | {' | '.join(map(str, counts))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    actions = parser.add_subparsers(dest="action", required=True)
    drawing = actions.add_parser("draw")
    drawing.add_argument("--seed", type=int, required=True)
    drawing.add_argument("--most", type=int, default=5)
    drawing.add_argument("--output", type=Path, required=True)
    running = actions.add_parser("run")
    running.add_argument("faults", type=Path)
    running.add_argument("--tree", type=Path, default=Path())
    running.add_argument("--tier", choices=TIERS, default="test")
    running.add_argument("--label", required=True)
    showing = actions.add_parser("table")
    showing.add_argument("faults", type=Path)
    given = parser.parse_args()
    if given.action == "draw":
        drawn = draw(Path().resolve(), given.seed, given.most)
        given.output.write_text(json.dumps([asdict(x) for x in drawn], indent=1) + "\n")
    elif given.action == "run":
        run(load(given.faults), given.tree.resolve(), given.tier, given.label, given.faults)
    else:
        print(table(load(given.faults)))
    sys.exit()
