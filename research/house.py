"""Figures of the code base: size, names with two meanings, long signatures, complex functions, and imports of a
command.

python -m research.house python -m research.house --names           the names that several modules define python -m
research.house --reach cli.query the modules that a command can load, including lazily
"""

from __future__ import annotations

import argparse
import ast
import io
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "normlift_ns"
MANY = 8
"""Largest usual number of parameters, without `self` and `cls`. Kernels and their launchers can have more."""
KNOT = 15
"""Cyclomatic complexity above which a function is hard to follow."""
KERNELS = ("normlift_ns.kernels", "normlift_ns.rasterization.numba")
ALIASES = ("normlift_ns.plugin.", "normlift_ns.scripts.")
"""Packages of modules for old paths, which only re-export names."""
BRANCHES = (ast.If, ast.IfExp, ast.For, ast.AsyncFor, ast.While, ast.ExceptHandler, ast.Assert, ast.comprehension)
SAME = {
    "entrypoint",  # of every command
    "main",
    "KIND",
    "FORMAT",  # of every file format
    "check",  # entry point of a command, and of every backend
    "composite",  # of every backend, and its kernels
    "in_flight",
    "views_evidence",
    "lift",  # entry point of the command, and the function that it runs
    "normlift_method",  # entry points of nerfstudio, and the methods that they load
    "lerf_ovs_method",
    "scannet_method",
    "NormLiftModelConfig",  # classes in config.yml, and stand-ins that read it without nerfstudio
    "NormLiftPipelineConfig",
    "segment_sum",  # on any device, and its kernel
    "T",  # type variables
    "coverage_of",  # functions, and routes of the HTTP API that call them
    "export",
    "query",
    "render",
    "select",
}
"""Names that several modules define on purpose with one meaning."""


def module_name(path: Path) -> str:
    """Return the dotted module name of a file of the package."""
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def is_alias(name: str) -> bool:
    """Return True if a module only keeps an old path importable."""
    return f"{name}.".startswith(ALIASES)


def code_lines(source: str) -> int:
    """Return the number of lines with code, without blank lines, comments and docstrings."""
    skip = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    lines = {
        line
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type not in skip
        for line in range(token.start[0], token.end[0] + 1)
    }
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def public_names(tree: ast.Module) -> Iterator[str]:
    """Yield the public names that a module defines at its top level."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            names = [node.name]
        elif isinstance(node, ast.Assign):
            names = [x.id for x in node.targets if isinstance(x, ast.Name)]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names = [node.target.id]
        else:
            names = []
        yield from (name for name in names if not name.startswith("_"))


def functions(tree: ast.Module) -> Iterator[tuple[ast.FunctionDef | ast.AsyncFunctionDef, bool]]:
    """Yield the functions of a module, each with True if it is a method."""
    for node in ast.walk(tree):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                yield child, isinstance(node, ast.ClassDef)


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef, method: bool) -> int:
    """Return the number of parameters, without `self` and `cls`."""
    given = function.args
    count = len([*given.posonlyargs, *given.args, *given.kwonlyargs]) + bool(given.vararg) + bool(given.kwarg)
    static = any(isinstance(x, ast.Name) and x.id == "staticmethod" for x in function.decorator_list)
    return count - (method and not static)


def complexity(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the cyclomatic complexity, which is one more than the number of branches (McCabe)."""
    count = 1
    for node in ast.walk(function):
        count += isinstance(node, BRANCHES)
        count += len(node.values) - 1 if isinstance(node, ast.BoolOp) else 0
        count += len(node.ifs) if isinstance(node, ast.comprehension) else 0
        count += len(node.cases) if isinstance(node, ast.Match) else 0
    return count


def imported(tree: ast.Module, modules: set[str]) -> set[str]:
    """Return the modules of this package that a module imports, at its start or lazily, without imports for types
    alone."""
    found: set[str] = set()

    def walk(node: ast.AST) -> None:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        names: list[str] = []
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            names = [f"{node.module}.{x.name}" for x in node.names]
            names = [name if name in modules else node.module for name in names]
        elif isinstance(node, ast.Import):
            names = [x.name for x in node.names]
        found.update(name for name in names if name in modules)
        for child in ast.iter_child_nodes(node):
            walk(child)

    walk(tree)
    return found


def reachable(start: str, needs: dict[str, set[str]]) -> set[str]:
    """Return all modules that a module can load."""
    seen, todo = set(), [start]
    while todo:
        name = todo.pop()
        if name not in seen:
            seen.add(name)
            parents = {".".join(name.split(".")[:k]) for k in range(1, name.count(".") + 1)}
            todo += [x for x in needs.get(name, set()) | (parents & set(needs))]
    return seen


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--names", action="store_true")
    parser.add_argument("--reach", default="cli.query")
    flags = parser.parse_args()
    sources = {module_name(path): path.read_text("utf8") for path in sorted(PACKAGE.rglob("*.py"))}
    trees = {name: ast.parse(source) for name, source in sources.items()}
    own = {name for name in trees if not is_alias(name)}
    lines = {name: code_lines(sources[name]) for name in own}
    print(f"modules: {len(own)}, and {len(trees) - len(own)} aliases for old paths")
    print(f"lines of code: {sum(lines.values()):,}; the largest modules:")
    for name in sorted(own, key=lambda x: -lines[x])[:5]:
        print(f"  {lines[name]:5} {name}")
    homes: dict[str, list[str]] = defaultdict(list)
    for name in sorted(own):
        for public in sorted(set(public_names(trees[name])) - SAME):
            homes[public].append(name)
    twice = {public: where for public, where in homes.items() if len(where) > 1}
    print(f"public names in several modules: {len(twice)}")
    if flags.names:
        for public, where in sorted(twice.items()):
            print(f"  {public}: {', '.join(where)}")
    found = [(name, *x) for name in sorted(own) for x in functions(trees[name])]
    long = [(parameters(f, m), name, f.name) for name, f, m in found if parameters(f, m) > MANY]
    print(f"functions of more than {MANY} parameters: {len(long)}; of these outside kernels:")
    for count, name, function in long:
        if not name.startswith(KERNELS):
            print(f"  {count:3} {name}.{function}")
    knots = sorted(((complexity(f), name, f.name) for name, f, _ in found if complexity(f) > KNOT), reverse=True)
    print(f"functions of complexity above {KNOT}: {len(knots)}")
    for count, name, function in knots:
        print(f"  {count:3} {name}.{function}")
    needs = {name: imported(tree, set(trees)) for name, tree in trees.items()}
    reach = reachable(f"normlift_ns.{flags.reach}", needs)
    print(f"modules that {flags.reach} can load: {len(reach)}")
    if flags.names:
        print(*(f"  {name}" for name in sorted(reach)), sep="\n")


if __name__ == "__main__":
    main()
