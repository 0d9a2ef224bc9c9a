"""Check docstrings, comments, messages and names for patterns of prose that a program can find.

    python -m tests.prose [FILE …]

It finds docstrings that begin with a question word, "is no X" for "is not an X", clauses that begin with "where" for
"if", and British spelling. `ALLOWED` lists the exceptions with their reasons.
"""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
QUESTION = re.compile(r"(What|Who|Whose|Whether|Where|How|Which|Why)\b")
IS_NO = re.compile(r"(?<![Tt]here )\b(?:is|are) no (?!longer\b|more\b|less\b|larger\b|smaller\b|other\b)[a-z{]")
WHERE = re.compile(r"(?:^Where|[.;:] [Ww]here) [a-z]")
BRITISH = re.compile(
    r"(?<![A-Za-z])(?i:(?:dis|un)?colour|neighbour|centre|(?:un)?labell|grey|(?:centi|milli|kilo)?metre|behaviour|"
    r"favour|honour|licence|programmes?(?![a-z])|(?:re)?model(?:led|ling)|travell|cancel(?:led|ling)|catalogue|artefact|"
    r"judgement|practise|defence|whilst|amongst|towards|analys(?:e|ed|er|ing)(?![a-z])|"
    r"(?![a-z]*(?:wis|nois|prais|precis|prom|exercis|vis|compris|surpris|expertis|concis|disguis|premis))"
    r"[a-z]{4,}is(?:e[drs]?|ing|ations?)(?![a-z]))[a-z]*"
)
ALLOWED = {
    r"""--encoder colour\b|["']colour["']|\bcolour:""": "name of an encoder, in options and in lifted runs",
    r"^((make|write)_catalogue|catalogue(_to_json)?|Catalogue(Object)?)$|\.catalogue\(": "Python names",
    r"`(make_)?catalogue`": "the same names in docstrings",
    r'\bmetres_per_unit\b|"metre"': "old name of an option, and JSON value of the catalog of objects",
    r'^"?centre"?$': "JSON key of the coverage report",
    r'"grey"|\bgrey[- ]green\b': "spelling of the XKCD color survey",
}


def texts(source: str) -> Iterator[tuple[int, str, str]]:
    """Yield the line, kind (docstring, string, name or comment) and text of everything that people read in a module."""
    seen, names = set[int](), dict[str, int]()
    for node in ast.walk(ast.parse(source)):
        line = getattr(node, "lineno", 1)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            seen.add(id(node.value))
            yield line, "docstring", node.value.value
        if isinstance(node, ast.JoinedStr):
            seen.update(map(id, node.values))
            yield line, "string", "".join(str(x.value) if isinstance(x, ast.Constant) else "{}" for x in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in seen:
            yield line, "string", node.value if " " in node.value else f'"{node.value}"'
    comments = re.findall(r"# *(.*)", source)
    if not (BRITISH.search(source) or any(IS_NO.search(x) or WHERE.search(x) for x in comments)):
        return  # tokens take most of the time
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], "comment", token.string.lstrip("# ")
        elif token.type == tokenize.NAME:
            names.setdefault(token.string, token.start[0])
    yield from ((line, "name", name) for name, line in names.items())


def problems(source: str) -> Iterator[tuple[int, str]]:
    """Yield the line and a description of each finding in a module."""
    for line, kind, text in texts(source):
        flat = " ".join(text.split())
        if kind == "docstring" and QUESTION.match(flat):
            yield line, f"docstring begins with {flat.split()[0]}"
        if kind != "name":
            yield from ((line, f'"{found[0]}…": write "is not a"') for found in IS_NO.finditer(flat))
            yield from ((line, f'"{found[0]}…": write "if" or "when"') for found in WHERE.finditer(flat))
        for found in BRITISH.finditer(re.sub("|".join(ALLOWED), "", flat)):
            yield line, f"British spelling in {kind}: {found[0]}"


def main(arguments: Sequence[str]) -> int:
    """Print all findings; return the exit code, 1 if there are any."""
    files = [Path(word).resolve() for word in arguments] or sorted((ROOT / "normlift_ns").rglob("*.py"))
    names = {name: ROOT / name for name in (str(file.relative_to(ROOT)) for file in files)}
    found = [f"{name}:{line}: {x}" for name, file in names.items() for line, x in problems(file.read_text("utf8"))]
    print("\n".join(found), end="\n" if found else "")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
