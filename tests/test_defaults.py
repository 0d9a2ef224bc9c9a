"""Numbers and flags that are defaults of public functions and dataclasses, or public constants.

Changing one is a decision, so that it must be recorded; functions keep the tests of what their defaults do.

After a wanted change: NORMLIFT_WRITE=1 .venv/bin/pytest tests/test_defaults.py
"""

import ast
import json
import os
from collections.abc import Iterator
from pathlib import Path

import normlift_ns

ROOT, FILE = Path(normlift_ns.__file__).parent, Path(__file__).with_suffix(".json")


def plain(node: ast.AST | None) -> bool:
    """Whether an expression is made of numbers and flags alone."""
    parts = [x for x in ast.walk(node) if isinstance(x, ast.Constant | ast.Name | ast.Call)] if node else []
    return len(parts) > 0 and all(
        isinstance(x, ast.Constant) and isinstance(x.value, bool | int | float) for x in parts
    )


def defaults(body: list[ast.stmt], prefix: str) -> Iterator[tuple[str, str]]:
    for node in body:
        if isinstance(node, ast.ClassDef):
            yield from defaults(node.body, f"{prefix}.{node.name}")
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            args = node.args
            pairs = [*zip([*args.posonlyargs, *args.args][::-1], args.defaults[::-1])]
            pairs += zip(args.kwonlyargs, args.kw_defaults)
            yield from ((f"{prefix}.{node.name}({x.arg})", ast.unparse(v)) for x, v in pairs if plain(v))
        elif isinstance(node, ast.Assign | ast.AnnAssign) and plain(node.value):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            yield f"{prefix}.{ast.unparse(target)}", ast.unparse(node.value)


def test_defaults_are_the_recorded_ones():
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        names = defaults(ast.parse(path.read_text("utf8")).body, module)
        found |= {name: value for name, value in names if "._" not in name.replace("(_", "._")}
    assert len(found) > 300
    if "NORMLIFT_WRITE" in os.environ:
        FILE.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", "utf8")
    recorded = json.loads(FILE.read_text("utf8"))
    assert {k: v for k, v in found.items() if recorded.get(k) != v} == {}
    assert set(recorded) == set(found)
