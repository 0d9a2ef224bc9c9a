"""Imports go one way and in no circle; the package imports nothing heavy; nerfstudio is known to few."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import normlift_ns

ROOT = Path(normlift_ns.__file__).parent
LAYERS = (
    ("errors",),
    ("crash",),
    ("ranges",),
    ("options",),
    ("kernels",),
    ("core",),
    ("raster", "encoders"),
    ("colors", "observing", "objects", "insight", "stages", "rehearsal", "scenes", "selection", "text_encoders"),
    ("question",),
    ("team",),
    ("lifting", "asking", "segmenting"),
    ("runs", "session", "planning"),
    ("quick", "viewer"),
    ("lifted_run", "nerfstudio_plugin"),
    ("together",),
    ("front_door", "method_configs", "plugin"),
    ("evaluation", "demo"),
    ("__init__",),
    ("scripts",),
)
"""From the ground up: a module imports from its own package and from lower layers only."""
FLOOR = {name: floor for floor, names in enumerate(LAYERS) for name in names}
BASE = {"torch", "numpy", "scipy", "jaxtyping", "safetensors"}
FOREIGN = {
    "errors": set(),
    "crash": set(),
    "ranges": set(),
    "options": set(),
    "kernels": {"torch", "jaxtyping", "triton"},
    "core": BASE | {"xxhash", "msgspec"},
    "raster": {"torch", "numpy", "jaxtyping", "numba", "gsplat"},
    "encoders": BASE | {"xxhash", "open_clip", "skimage", "PIL", "huggingface_hub", "torchvision"},
    "colors": {"torch", "jaxtyping", "matplotlib"},
    "observing": {"torch", "jaxtyping", "xxhash"},
    "objects": BASE | {"trimesh", "plyfile"},
    "insight": BASE,
    "team": {"torch", "jaxtyping"},
    "lifting": {"torch", "jaxtyping"},
    "stages": {"torch"},
    "rehearsal": {"torch"},
    "scenes": BASE | {"msgspec", "cv2", "PIL", "plyfile", "yaml"},
    "selection": {"numpy", "jaxtyping"},
    "text_encoders": set(),
    "question": {"numpy", "jaxtyping"},
    "quick": {"numpy", "scipy", "jaxtyping"},
    "asking": {"torch", "jaxtyping"},
    "segmenting": {"torch", "jaxtyping"},
    "runs": BASE | {"plyfile", "msgspec"},
    "planning": {"torch", "jaxtyping"},
    "session": BASE,
    "viewer": {"torch", "numpy", "jaxtyping", "matplotlib", "PIL", "msgspec", "viser"},
    "nerfstudio_plugin": BASE | {"nerfstudio", "gsplat", "torchmetrics", "yaml", "viser"},
    "lifted_run": {"torch", "numpy", "jaxtyping"},
    "together": {"torch", "jaxtyping"},
    "front_door": {"torch", "jaxtyping"},
    "method_configs": {"nerfstudio"},
    "plugin": set(),
    "evaluation": BASE | {"cv2", "msgspec", "matplotlib"},
    "demo": BASE | {"nerfstudio", "matplotlib", "PIL"},
    "scripts": {
        "torch",
        "numpy",
        "jaxtyping",
        "PIL",
        "plyfile",
        "tyro",
        "rich",
        "docstring_parser",
        "yaml",
        "prompt_toolkit",
    },
}
"""What is not of this package and not of Python, by layer."""
KNOW_NERFSTUDIO = ("nerfstudio_plugin", "method_configs", "demo/run.py")
FILES = sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")
MOST_MODULES = 19


def layer(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")


MODULES = {module(file) for file in FILES}


@cache
def imports(path: Path) -> tuple[tuple[str, bool], ...]:
    """Modules that a file imports, wherever it does, and whether while it is itself imported."""
    return tuple(_imports(path))


def _imports(path: Path) -> Iterator[tuple[str, bool]]:
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        for child in ast.iter_child_nodes(node):
            child.parent = node  # type: ignore[attr-defined]
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} uses a relative import"
            found = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else node.module or "" for name in found]
        parent, now = node, True
        while parent is not tree:
            parent = parent.parent  # type: ignore[attr-defined]
            typing = isinstance(parent, ast.If) and ast.unparse(parent.test) == "TYPE_CHECKING"
            now &= not (typing or isinstance(parent, ast.FunctionDef))
        yield from ((name, now) for name in names)


@pytest.mark.parametrize("path", FILES, ids=module)
def test_imports_go_downwards(path):
    here = layer(path)
    for name, _ in imports(path):
        top, *rest = name.split(".")
        if top == "normlift_ns":
            there = rest[0] if len(rest) > 0 else "__init__"  # the face of the package, which hands names on
            assert there == here or FLOOR[there] < FLOOR[here], f"{module(path)} imports {name} from above"
        elif top not in sys.stdlib_module_names:
            assert top in FOREIGN[here], f"{module(path)} imports {name}"


@pytest.mark.parametrize("path", FILES, ids=module)
def test_only_the_plugin_knows_nerfstudio(path):
    known = path.relative_to(ROOT).as_posix().startswith(KNOW_NERFSTUDIO)
    found = [name for name, _ in imports(path) if name.split(".")[0] == "nerfstudio"]
    assert known or found == []


def test_no_modules_import_each_other_in_a_circle():
    arrows = {module(path): {name for name, _ in imports(path)} for path in FILES}
    open_modules = {name: arrows[name] & set(arrows) - {name} for name in arrows}
    while leaves := [name for name, needs in open_modules.items() if len(needs) == 0]:
        for name in leaves:
            del open_modules[name]
        for needs in open_modules.values():
            needs -= set(leaves)
    assert open_modules == {}


def test_no_folder_is_crowded():
    folders = {path.parent for path in FILES}
    crowded = {str(f.relative_to(ROOT)): n for f in folders if (n := len(list(f.glob("*.py")))) > MOST_MODULES}
    assert crowded == {}


def loaded(code: str, names: set[str]) -> str:
    """Which of the modules a program has imported."""
    program = f"import sys; {code}; print(sorted({names!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return done.stdout.strip().splitlines()[-1]


def test_importing_the_package_costs_nothing():
    heavy = {"torch", "numpy", "nerfstudio", "scipy", "open_clip", "gsplat", "numba", "matplotlib", "triton"}
    assert loaded("import normlift_ns; normlift_ns.__version__", heavy) == "[]"
    assert loaded("import normlift_ns.scripts.lift", heavy) == "[]"
    assert (
        loaded("import normlift_ns; normlift_ns.lift, normlift_ns.render", heavy - {"torch", "numpy", "scipy"}) == "[]"
    )
    others = {"nerfstudio", "open_clip", "gsplat", "torchvision", "sympy", "torch._dynamo", "scipy.stats", "viser"}
    lifting = "import normlift_ns.front_door, normlift_ns.encoders.build as b; from normlift_ns import SourceOptions"
    assert loaded(f"{lifting}; b.make_source(SourceOptions(encoder='colour')).text(['red'])", others) == "[]"


def test_public_names_exist_and_have_docstrings_with_examples():
    assert set(normlift_ns.__all__) <= set(dir(normlift_ns))
    for name in normlift_ns.__all__:
        member = getattr(normlift_ns, name)
        if not isinstance(member, tuple):
            assert ">>>" in member.__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = normlift_ns.nothing
