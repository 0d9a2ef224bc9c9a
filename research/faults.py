"""Small faults planted in the package, to measure how many of them the tests find.

    python -m research.faults draw --seed 1 --output faults.json
    python -m research.faults run faults.json --trees ../checkout --tier test --label old
    python -m research.faults table faults.json

`draw` chooses places in every package by a seed, and keeps the faults that pass lint and type checks and can be
imported. `run` plants each fault in another checkout that has a `.venv`, and runs the nearest test files first. The
remaining faults are planted together, and the whole tier runs once. If tests fail, each fault is tried with these tests
alone. A fault is found if a test fails with it and passes without it.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import os
import random
import re
import signal
import subprocess
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from queue import Queue

PACKAGES = (
    "core",
    "rasterization",
    "kernels",
    "encoders",
    "segmentation",
    "data",
    "io",
    "distributed",
    "query",
    "rendering",
    "server",
    "session",
    "viewer",
    "analysis",
    "evaluation",
    "nerfstudio_plugin",
    "cli",
    "demo",
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
    *(
        "fill_",
        "copy_",
        "zero_",
        "clamp_",
        "mul_",
        "add_",
        "div_",
        "sub_",
        "masked_fill_",
        "index_add_",
        "scatter_add_",
    ),
}
CHECKS = re.compile(r"^_?(check|refuse|ensure|require|validate|writable)_?")
SWAPPED: dict[type[ast.cmpop], str] = {
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
BOUNDS: dict[type[ast.cmpop], str] = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}


@dataclass(frozen=True)
class Fault:
    """A change of one file."""

    name: str
    package: str
    kind: str
    file: str
    line: int
    function: str
    patch: str
    found: dict[str, str] | None = None
    """Test that finds the fault, by label of the run; "" if no test finds it."""
    equivalent: str = ""
    """Reason why no test can find the fault, for faults that change nothing."""


Node = ast.expr | ast.stmt
Edit = tuple[str, Node, str]


def edits(tree: ast.Module) -> Iterator[tuple[str, Node, str, str]]:
    """Yield the kind, node, new text and enclosing function of every possible edit."""
    for node, function in _code(tree, ""):
        for kind, place, text in _edits(node):
            yield kind, place, text, function


def _code(node: ast.AST, function: str) -> Iterator[tuple[ast.AST, str]]:
    """Yield the nodes that run, without annotations, docstrings and code for type checkers."""
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


def _number(node: ast.AST | None) -> int | None:
    return node.value if isinstance(node, ast.Constant) and type(node.value) is int else None


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
        if (value := _number(node.right)) is not None:
            yield "off by one", node.right, str(value + 1)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
        yield "swapped sign", node, ast.unparse(node.operand)
    elif isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in BOUNDS:
        if _number(node.comparators[0]) is not None or "len(" in ast.unparse(node) or "shape" in ast.unparse(node):
            text = f"{ast.unparse(node.left)} {BOUNDS[type(node.ops[0])]} {ast.unparse(node.comparators[0])}"
            yield "off by one", node, text
    elif isinstance(node, ast.Slice):
        for bound in (node.lower, node.upper):
            if bound is not None and (value := _number(bound)) is not None:
                yield "off by one", bound, str(value + 1)
    elif isinstance(node, ast.Call):
        yield from _calls(node)
    elif isinstance(node, ast.Subscript) and (value := _number(node.slice)) is not None:
        if isinstance(node.value, ast.Attribute) and node.value.attr == "shape":
            yield "wrong axis", node.slice, str(1 - min(value, 1))
        else:
            yield "off by one", node.slice, str(value + 1)
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
        if word.arg in ("dim", "axis"):
            yield from _other_axis(word.value)
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name == "range":
        for bound in node.args:
            if not _text(bound):
                yield "off by one", bound, f"{ast.unparse(bound)} + 1"
    if name in ("size", "squeeze", "unsqueeze", "flip", "any", "all") and len(node.args) == 1:
        yield from _other_axis(node.args[0])


def _other_axis(node: ast.expr) -> Iterator[Edit]:
    if (value := _axis(node)) is not None:
        yield "wrong axis", node, "1" if value == 0 else "0"


def _axis(node: ast.AST) -> int | None:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        value = _number(node.operand)
        return None if value is None else -value
    return _number(node)


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


def changed(source: str, node: Node, text: str) -> str:
    """Return a source with a node replaced."""
    data = source.encode()
    starts = [0]
    for line in data.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    last, column = node.end_lineno or node.lineno, node.end_col_offset or 0
    start, end = starts[node.lineno - 1] + node.col_offset, starts[last - 1] + column
    return (data[:start] + text.encode() + data[end:]).decode()


def draw(root: Path, seed: int, most: int) -> list[Fault]:
    """Return up to `most` faults per package, at most one per file, that pass lint, types and import."""
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
    """Return the formatted patch of a fault, or "" if lint, types or import fail."""
    module = fault.file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    binaries = root / ".venv/bin"
    checks = (
        (binaries / "ruff", "check", "-q", fault.file),
        (binaries / "python", "-W", "ignore", "-c", f"import {module}"),
        (binaries / "pyrefly", "check", fault.file),
    )
    with planted(root, [fault]):
        subprocess.run([binaries / "ruff", "format", "-q", fault.file], cwd=root, check=True)
        if any(subprocess.run(x, cwd=root, capture_output=True, check=False).returncode != 0 for x in checks):
            return ""
        diff = ["git", "diff", "--", fault.file]
        return subprocess.run(diff, cwd=root, capture_output=True, text=True, check=True).stdout


def replanted(source: str, fault: Fault) -> str:
    """Return the source with a fault, which is found by its lines.

    If they occur several times, the place with most of the surrounding lines counts.
    """
    lines = source.splitlines()
    for hunk in re.split(r"(?m)^@@ .*\n", fault.patch)[1:]:
        rows = [x for x in hunk.splitlines() if x[:1] in ("+", "-", " ")]
        ends = [i for i, x in enumerate(rows) if x[0] != " "]
        first, last = max(0, ends[0] - ("-" not in {x[0] for x in rows})), ends[-1] + 1
        before, after = ([x[1:] for x in rows[first:last] if x[0] != other] for other in "+-")
        around = [x[1:] for x in rows if x[0] != "+"]
        places = [i for i in range(len(lines)) if lines[i : i + len(before)] == before]
        if not places:
            raise LookupError(f"{fault.name}: {fault.file} no longer has the line {before[0].strip()}")
        same = {i: sum(x == y for x, y in zip(around, lines[max(0, i - first) :])) for i in places}
        place = max(places, key=lambda i: (same[i], -abs(i - fault.line)))
        lines[place : place + len(before)] = after
    return "\n".join(lines) + "\n"


def stands(root: Path, fault: Fault) -> bool:
    """Return True if a tree still has the lines of a fault."""
    path = root / fault.file
    try:
        return path.exists() and replanted(path.read_text("utf8"), fault) != ""
    except LookupError as error:
        print(error, flush=True)
        return False


class planted:
    """Context in which a tree contains faults."""

    def __init__(self, root: Path, faults: list[Fault]) -> None:
        self.root, self.faults = root, faults

    def __enter__(self) -> None:
        for fault in self.faults:
            path = self.root / fault.file
            path.write_text(replanted(path.read_text("utf8"), fault), "utf8")

    def __exit__(self, *_: object) -> None:
        subprocess.run(["git", "checkout", "-q", "--", *{x.file for x in self.faults}], cwd=self.root, check=True)


TIERS = ("test", "slow")
TIME_OUT = "time-out"
DEFAULTS = "tests/test_defaults.py"
"""Test of recorded defaults, which names no function."""


def marker(root: Path, tier: str) -> str:
    """Return the marker expression of a tier. Old checkouts have no marker `extra`."""
    extra = " and not extra" if '"extra: ' in (root / "pyproject.toml").read_text("utf8") else ""
    return ("slow" if tier == "slow" else "not slow") + extra


def pytest(root: Path, tier: str, *words: str, limit: float) -> list[str]:
    """Return the names of failing tests; `TIME_OUT` if they do not end, "collection" if none could run."""
    command = [".venv/bin/python", "-m", "pytest", "-q", "--no-header", "-rfE", "-m", marker(root, tier), *words]
    process = subprocess.Popen(
        command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
        env=os.environ | {"CI": "1", "PYTHONPATH": str(root)}, start_new_session=True,
    )  # fmt: skip
    try:
        printed, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return [TIME_OUT]
    failed = re.findall(r"^(?:FAILED|ERROR) (tests/.*?|normlift_ns/.*?)(?: - .*)?$", printed, re.MULTILINE)
    return failed or (["collection"] if process.returncode not in (0, 5) else [])


def nearest(root: Path, fault: Fault, most: int = 8) -> list[str]:
    """Test files that name the function or module of a fault, those of its folder first."""
    stem = Path(fault.file).stem if Path(fault.file).stem != "__init__" else Path(fault.file).parent.name
    names = [x for x in fault.function.split(".") if not x.startswith("_")]
    module = fault.file.removesuffix(".py").replace("/", ".")
    scores: dict[str, float] = {}
    for path in sorted(set(root.glob("tests/**/test_*.py")) - set(root.glob("tests/browser/*.py"))):
        text = path.read_text("utf8")
        score = 4.0 * (module in text) + 2.0 * any(re.search(rf"\b{re.escape(x)}\b", text) for x in names)
        score += 3.0 * (path.stem.removeprefix("test_") in (stem, *names)) + 1.0 * (
            f"tests/{fault.package}/" in path.as_posix()
        )
        score += 0.5 * bool(re.search(rf"\b{re.escape(stem)}\b", text))
        if score > 0:
            scores[path.relative_to(root).as_posix()] = score
    if fault.kind == "wrong default" and (root / DEFAULTS).exists():
        scores[DEFAULTS] = 100.0
    return sorted(scores, key=lambda x: -scores[x])[:most]


def run(faults: list[Fault], trees: list[Path], tier: str, label: str, save: Path, *, together: bool) -> None:
    """Search a test for every fault, first in the nearest files and then in the whole tier, and save the results."""
    found = {x.name: dict(x.found or {}) for x in faults}
    free: Queue[Path] = Queue()
    for tree in trees:
        free.put(tree)
    passes: dict[str, bool] = {}
    several = ("-n", os.environ.get("WORKERS", "2"), "--ignore=tests/browser")

    def keep() -> None:
        save.write_text(json.dumps([asdict(replace(x, found=found[x.name])) for x in faults], indent=1) + "\n")

    def first(fault: Fault, words: list[str], limit: float) -> str:
        """Return the first test that fails with a fault and passes without it, or ""."""
        tree = free.get()
        try:
            with planted(tree, [fault]):
                failed = pytest(tree, tier, *words, limit=limit)
            return next((x for x in failed if passes_without(tree, x, words, limit)), "")
        finally:
            free.put(tree)

    def passes_without(tree: Path, test: str, words: Sequence[str], limit: float) -> bool:
        words = words if test in (TIME_OUT, "collection") else [test]
        name = " ".join(words)
        if name not in passes:
            passes[name] = not pytest(tree, tier, *words, limit=limit)
        return passes[name]

    def look(fault: Fault, words: list[str], limit: float = 300) -> None:
        test = first(fault, words, limit)
        print(fault.name, fault.file, fault.kind, "->", test, flush=True)
        if test:
            found[fault.name][label] = test
            keep()

    missing = [x for x in faults if label not in found[x.name] and not x.equivalent and stands(trees[0], x)]
    with ThreadPoolExecutor(len(trees)) as pool:
        if not together:
            list(pool.map(lambda x: look(x, ["--maxfail=3", *nearest(trees[0], x)]), missing))
        rest = [x for x in missing if label not in found[x.name]]
        fails = set(pytest(trees[0], tier, *several, limit=5400)) if rest else set()
        while rest:
            with planted(trees[0], rest):
                failed = [x for x in pytest(trees[0], tier, *several, limit=5400) if x not in fails]
            print(f"{len(rest)} together: {len(failed)} tests fail", *failed, sep="\n", flush=True)
            files: dict[str, list[str]] = {}
            for test in failed:
                files.setdefault(test.split("::", maxsplit=1)[0], []).append(test)
            tests = [test for some in files.values() for test in some[:4]]
            before = len(rest)
            list(pool.map(lambda x, words=tests: look(x, ["-x", *words]), rest if tests else []))
            rest = [x for x in rest if label not in found[x.name]]
            if len(rest) == before:
                break
    for fault in rest:
        found[fault.name][label] = ""
    keep()


def load(path: Path) -> list[Fault]:
    """Return the faults of a file."""
    return [Fault(**x) for x in json.loads(path.read_text("utf8"))]


COLUMNS = {
    "make test of 0.2": ("make test of 0.2",),
    "make test": ("make test",),
    "and make test-slow": ("make test", "make test-slow"),
}
"""Labels of the runs that count, by column of the table."""


def table(faults: list[Fault]) -> str:
    """Return a table of the faults found, by package and by run. Equivalent faults are counted separately."""
    lines = [f"| package | faults | equivalent | {' | '.join(COLUMNS)} |", f"|---|{'---:|' * (len(COLUMNS) + 2)}"]
    for package in [*PACKAGES, "all"]:
        here = [x for x in faults if package in (x.package, "all")]
        real = [x for x in here if not x.equivalent]
        counts = [sum(any((x.found or {}).get(y) for y in labels) for x in real) for labels in COLUMNS.values()]
        if here:
            row = ["top level" if package == "." else package, len(here), len(here) - len(real), *counts]
            lines.append(f"| {' | '.join(map(str, row))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description="Plant small faults in the package, and measure how many the tests find."
    )
    actions = parser.add_subparsers(dest="action", required=True)
    drawing = actions.add_parser("draw")
    drawing.add_argument("--seed", type=int, required=True)
    drawing.add_argument("--most", type=int, default=5)
    drawing.add_argument("--output", type=Path, required=True)
    running = actions.add_parser("run")
    running.add_argument("faults", type=Path)
    running.add_argument("--trees", type=Path, nargs="+", default=[Path()])
    running.add_argument("--tier", choices=TIERS, default="test")
    running.add_argument("--label", required=True)
    running.add_argument("--together", action="store_true")
    showing = actions.add_parser("table")
    showing.add_argument("faults", type=Path)
    given = parser.parse_args()
    if given.action == "draw":
        drawn = draw(Path().resolve(), given.seed, given.most)
        given.output.write_text(json.dumps([asdict(x) for x in drawn], indent=1) + "\n")
    elif given.action == "run":
        trees = [x.resolve() for x in given.trees]
        run(load(given.faults), trees, given.tier, given.label, given.faults, together=given.together)
    else:
        print(table(load(given.faults)))
