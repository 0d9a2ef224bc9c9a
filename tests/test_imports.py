"""Imports go one way, and the package imports nothing heavy."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import normlift_ns

ROOT = Path(normlift_ns.__file__).parent
BASE = {"torch", "numpy", "scipy", "jaxtyping", "safetensors"}
ALLOWED = {
    "kernels": {"torch", "jaxtyping", "triton"},
    "core": BASE | {"normlift_ns.kernels", "normlift_ns.core"},
    "raster": BASE | {"numba", "gsplat", "normlift_ns.kernels", "normlift_ns.core", "normlift_ns.raster"},
    "encoders": BASE
    | {
        "open_clip",
        "matplotlib",
        "skimage",
        "PIL",
        "huggingface_hub",
        "torchvision",
        *(f"normlift_ns.{x}" for x in ("core", "encoders")),
    },
    "demo": BASE | {"nerfstudio", "matplotlib", "PIL", *(f"normlift_ns.{x}" for x in ("core", "raster", "demo"))},
    "plugin": BASE
    | {"nerfstudio", "gsplat", "torchmetrics", "yaml", "matplotlib", "plyfile"}
    | {f"normlift_ns.{x}" for x in ("core", "raster", "encoders", "plugin")},
    "evaluation": BASE
    | {"cv2", "plyfile", "skimage", "matplotlib"}
    | {f"normlift_ns.{x}" for x in ("core", "raster", "encoders", "plugin", "evaluation")},
}


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} uses a relative import"
            names |= {
                f"{node.module}.{alias.name}" if node.module == "normlift_ns" else node.module or ""
                for alias in node.names
            }
    return names


@pytest.mark.parametrize("layer", ALLOWED)
def test_imports_go_downwards(layer):
    files = sorted((ROOT / layer).rglob("*.py"))
    assert len(files) > 3
    for path in files:
        for name in imported(path):
            if name.split(".")[0] in sys.stdlib_module_names:
                continue
            parts = name.split(".")
            prefixes = {".".join(parts[: i + 1]) for i in range(len(parts))}
            assert prefixes & ALLOWED[layer], f"{path.relative_to(ROOT)} imports {name}"


def test_importing_the_package_is_light():
    heavy = ("nerfstudio", "gsplat", "open_clip", "numba", "matplotlib", "triton")
    code = f"import normlift_ns, sys; print([m for m in {heavy!r} if m in sys.modules])"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    )


def test_public_names_exist_and_have_docstrings():
    for name in normlift_ns.__all__:
        member = getattr(normlift_ns, name)
        assert isinstance(member, tuple) or member.__doc__, name
