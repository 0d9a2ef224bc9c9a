"""Imports go one way and in no circle; the package imports nothing heavy; nerfstudio is known to few."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import normlift_ns

ROOT = Path(normlift_ns.__file__).parent
LAYERS = (
    ("errors",),
    ("registry",),
    ("options",),
    ("io", "kernels"),
    ("core",),
    ("rasterization", "encoders", "segmentation"),
    ("data", "progress"),
    ("evidence_collection",),
    ("analysis",),
    ("query",),
    ("rendering",),
    ("exports",),
    ("session", "lifted_run"),
    ("pipeline",),
    ("planning", "viewer", "distributed"),
    ("nerfstudio_plugin",),
    ("method_configs", "plugin"),
    ("evaluation", "demo"),
    ("__init__",),
    ("server",),
    ("cli",),
    ("scripts",),
)
"""From the ground up: a module imports from its own package and from lower layers only."""
BESIDE = {"encoders", "segmentation"}
"""Two packages of one layer, whose modules may import each other."""
FLOOR = {name: floor for floor, names in enumerate(LAYERS) for name in names}
BASE = {"torch", "numpy", "scipy", "jaxtyping", "safetensors"}
TENSORS = {"torch", "jaxtyping"}
FOREIGN = {
    **dict.fromkeys(("errors", "registry", "options", "plugin", "scripts"), frozenset()),
    **dict.fromkeys(("progress",), frozenset({"torch"})),
    **dict.fromkeys(("pipeline",), TENSORS),
    "io": BASE | {"xxhash", "msgspec"},
    "kernels": TENSORS | {"triton"},
    "core": BASE,
    "rasterization": TENSORS | {"numpy", "numba", "gsplat", "typing_extensions"},
    "encoders": BASE | {"xxhash", "open_clip", "PIL", "huggingface_hub", "torchvision", "skimage"},
    "segmentation": BASE | {"skimage", "PIL", "cv2", "huggingface_hub", "torchvision", "h5py"},
    "data": BASE | {"msgspec", "zstandard", "cv2", "PIL", "plyfile", "yaml", "nerfstudio", "typing_extensions"},
    "distributed": TENSORS,
    "evidence_collection": TENSORS | {"xxhash"},
    "analysis": BASE | {"trimesh", "PIL", "plyfile"},
    "query": BASE | {"msgspec"},
    "exports": BASE | {"plyfile"},
    "rendering": TENSORS | {"numpy", "matplotlib", "PIL", "cv2"},
    "session": BASE,
    "lifted_run": TENSORS | {"numpy", "PIL"},
    "planning": TENSORS,
    "viewer": TENSORS | {"numpy", "PIL"},
    "server": BASE | {"xxhash", "msgspec", "PIL", "anyio", "starlette", "uvicorn", "mcp", "pydantic"},
    "nerfstudio_plugin": BASE | {"nerfstudio", "gsplat", "torchmetrics", "yaml", "viser"},
    "method_configs": {"nerfstudio"},
    "evaluation": BASE | {"cv2", "msgspec", "matplotlib", "plyfile"},
    "demo": BASE | {"nerfstudio", "matplotlib", "PIL"},
    "cli": TENSORS | {"numpy", "PIL", "plyfile", "tyro", "rich", "prompt_toolkit"},
}
"""What is not of this package and not of Python, by layer."""
KNOW_NERFSTUDIO = ("nerfstudio_plugin", "method_configs", "data/nerfstudio/dataset_views.py", "demo/capture.py")
UNIX_ONLY = {"resource", "fcntl", "termios", "tty", "pty", "pwd", "grp", "triton"}
FOR_A_GPU = ("kernels", "rasterization/triton", "rasterization/gsplat")
"""May import Triton when they are loaded."""


def module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")


def imports(path: Path, modules: set[str]) -> Iterator[tuple[str, bool]]:
    """Modules that a file imports, wherever it does, and whether while it is itself imported."""

    def walk(node: ast.AST, now: bool) -> Iterator[tuple[str, bool]]:
        if isinstance(node, ast.Import):
            yield from ((alias.name, now) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} uses a relative import"
            found = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from ((name if name in modules else node.module or "", now) for name in found)
        typing = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        later = typing or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, ast.expr):
                yield from walk(child, now and not later)

    text = path.read_text("utf8")
    assert not re.search(r"^\S.*\bsignal\.SIG(KILL|HUP|ALRM|USR)", text, re.MULTILINE), f"{path}: not on Windows"
    yield from walk(ast.parse(text), True)


def test_imports_go_downwards_in_no_circle_and_only_the_plugin_knows_nerfstudio():
    files = {module(path): path for path in sorted(ROOT.rglob("*.py")) if path != ROOT / "__init__.py"}
    needs: dict[str, set[str]] = {}
    wrong = []
    for here, path in files.items():
        place = path.relative_to(ROOT).as_posix()
        layer = place.split("/")[0].removesuffix(".py")
        found = list(imports(path, set(files)))
        needs[here] = {name for name, _ in found} & set(files) - {here}
        for name, now in found:
            top, *rest = name.split(".")
            if top == "normlift_ns":
                there = rest[0] if len(rest) > 0 else "__init__"  # the face of the package, which hands names on
                right = there == layer or FLOOR[there] < FLOOR[layer] or {there, layer} == BESIDE
            else:
                right = top in sys.stdlib_module_names or top in FOREIGN[layer]
                right &= top != "nerfstudio" or place.startswith(KNOW_NERFSTUDIO)
                right &= top not in UNIX_ONLY or not now or place.startswith(FOR_A_GPU)
            if not right:
                wrong.append(f"{here} imports {name}")
    assert wrong == []
    while leaves := {name for name, needed in needs.items() if len(needed) == 0}:
        needs = {name: needed - leaves for name, needed in needs.items() if name not in leaves}
    assert needs == {}, "these import each other in a circle"


STAGES = """
import sys
HEAVY = {"torch", "numpy", "nerfstudio", "scipy", "open_clip", "gsplat", "numba", "matplotlib", "triton", "viser"}
def check(stage, names):
    assert not (found := names & set(sys.modules)), (stage, found)
import normlift_ns
normlift_ns.__version__
check("version", HEAVY)
from normlift_ns.cli import batch, check as _, demo, evaluate, export, lift, query, serve, view
check("scripts", HEAVY)
from normlift_ns.encoders.open_clip import has_local_clip_weights
has_local_clip_weights("ViT-B-16", "laion2b_s34b_b88k")
check("weights", HEAVY | {"transformers", "skimage"})
missing = ["--load-config", "nowhere/config.yml"]
mistakes = [
    (lift, missing), (lift, ["--load-config", "config.yml", "--encoder", "color", "--vote-sigma-d", "nan"]),
    (lift, ["--load-config", "config.yml", "--encoder", "color", "--output-dir", "config.yml"]),
    (query, [*missing, "--text", "a"]),
    (query, ["--load-config", "config.yml", "--text", "a", "--output-json", "no.txt/x"]),
    (export, ["--load-config", "config.yml", "--output-dir", "config.yml"]), (view, missing),
    (evaluate, ["--load-config", "config.yml", "--protocol", "masks", "--labels", "nowhere"]), (batch, ["nowhere.txt"]),
]
for command, words in mistakes:
    sys.argv = ["command", *words]
    try:
        command.entrypoint()
    except SystemExit as stop:
        assert stop.code == 1, (words, stop.code)
    else:
        sys.exit(f"{words} were accepted")
    check(words, HEAVY)
normlift_ns.lift, normlift_ns.render
check("functions", HEAVY - {"torch", "numpy", "scipy"})
import normlift_ns.pipeline, normlift_ns.encoders.build as build
build.make_source(normlift_ns.SourceOptions(encoder="color")).text(["red"])
check("colours", {"nerfstudio", "open_clip", "gsplat", "torchvision", "sympy", "torch._dynamo", "scipy.stats", "viser"})
"""


def test_help_and_mistakes_load_nothing_heavy_nor_does_a_lift_load_what_it_does_not_need(tmp_path):
    (tmp_path / "config.yml").write_text("method_name: splatfacto\n")
    done = subprocess.run([sys.executable, "-c", STAGES], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr and done.stderr.count("Error\n") == 9
