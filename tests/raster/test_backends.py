"""Which backend suits a job, whatever is installed."""

from __future__ import annotations

import importlib.util
from importlib import metadata
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from normlift_ns.core import gpu
from normlift_ns.errors import InputError
from normlift_ns.raster.backends import _fastest, choose_backend

ON_GPU: Any = SimpleNamespace(
    scene=SimpleNamespace(means=SimpleNamespace(device=torch.device("cuda"), is_cuda=True, dtype=torch.float32)),
    dtype=torch.float32,
)


@pytest.fixture(autouse=True)
def _asked_anew():
    gpu.has_triton.cache_clear()
    yield
    gpu.has_triton.cache_clear()


def install(monkeypatch: pytest.MonkeyPatch, triton: str | None) -> None:
    """Makes it look as if that version of Triton was installed; None: none, "": one of a distribution without name."""
    monkeypatch.setattr(gpu, "find_spec", lambda name: None if triton is None else importlib.util.find_spec("json"))

    def version(name: str) -> str:
        assert name == "triton"
        if triton is None or triton == "":
            raise metadata.PackageNotFoundError(name)
        return triton

    monkeypatch.setattr(gpu, "version", version)


@pytest.mark.parametrize(
    ("triton", "backend"),
    [("2.1.0", "gsplat"), ("2.3.1", "gsplat"), (None, "gsplat"), ("3.0.0", "triton"), ("3.6.0", "triton")],
)
def test_before_triton_3_a_gpu_rasterizes_with_stock_gsplat(monkeypatch, triton, backend):
    install(monkeypatch, triton)
    assert _fastest(ON_GPU) == backend
    if backend == "gsplat":
        with pytest.raises(InputError, match=r"needs Triton 3, which comes with PyTorch 2\.4"):
            choose_backend("triton", ON_GPU, pictures=False)


def test_a_triton_without_version_is_taken(monkeypatch):
    install(monkeypatch, "")
    assert gpu.has_triton()
