"""Which backend suits a job, whatever is installed."""

import importlib.util
import threading
from importlib import metadata
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from normlift_ns.core import device
from normlift_ns.errors import InputError
from normlift_ns.rasterization.rasterize import _fastest, choose_backend

ON_GPU: Any = SimpleNamespace(
    scene=SimpleNamespace(means=SimpleNamespace(device=torch.device("cuda"), is_cuda=True, dtype=torch.float32)),
    dtype=torch.float32,
    is_2d=False,
    weight_power=1,
)


@pytest.fixture(autouse=True)
def _asked_anew():
    device.has_triton.cache_clear()
    yield
    device.has_triton.cache_clear()


def install(monkeypatch: pytest.MonkeyPatch, triton: str | None) -> None:
    """Makes it look as if that version of Triton was installed; None: none, "": one of a distribution without name."""
    monkeypatch.setattr(device, "find_spec", lambda name: None if triton is None else importlib.util.find_spec("json"))

    def version(name: str) -> str:
        assert name == "triton"
        if triton is None or triton == "":
            raise metadata.PackageNotFoundError(name)
        return triton

    monkeypatch.setattr(device, "version", version)


def test_before_triton_3_a_gpu_rasterizes_with_stock_gsplat(monkeypatch):
    """A Triton without version is taken."""
    for triton in ("3.0.0", "3.6.0", "", "2.1.0", "2.3.1", None):
        install(monkeypatch, triton)
        device.has_triton.cache_clear()
        taken = triton in ("3.0.0", "3.6.0", "")
        assert (device.has_triton(), _fastest(ON_GPU)) == (taken, "triton" if taken else "gsplat"), triton
        if not taken:
            with pytest.raises(InputError, match=r"Triton 3, .*PyTorch 2\.4"):
                choose_backend("triton", ON_GPU)


def test_jobs_that_gsplat_cannot_compute_use_torch_without_triton(monkeypatch):
    install(monkeypatch, None)
    for change in ({"is_2d": True}, {"weight_power": 2}):
        assert _fastest(SimpleNamespace(**{**vars(ON_GPU), **change})) == "torch", change


def test_a_gpu_that_cannot_start_is_told_of_where_it_is_wanted(monkeypatch):
    told = []
    monkeypatch.setattr(threading, "excepthook", told.append)
    before = set(threading.enumerate())
    device.init_cuda("cuda:99")
    for thread in set(threading.enumerate()) - before:
        thread.join()
    assert told == []
