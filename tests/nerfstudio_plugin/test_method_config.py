from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import fields, replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins import registry

from normlift_ns.demo.run import splatfacto_config
from normlift_ns.method_configs import entry
from normlift_ns.method_configs.lerf_ovs import lerf_ovs_method
from normlift_ns.method_configs.normlift import normlift_method
from normlift_ns.method_configs.scannet import scannet_method
from normlift_ns.nerfstudio_plugin.model import NormLiftModelConfig
from normlift_ns.scenes.nerfstudio.config import SUPPORTED_METHODS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())


def test_nerfstudio_discovers_the_method_by_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    group = "nerfstudio.method_configs"
    declared = PROJECT["project"]["entry-points"][group]
    points = EntryPoints(EntryPoint(name, value, group) for name, value in declared.items())
    monkeypatch.setattr(registry, "entry_points", lambda group: points.select(group=group))
    monkeypatch.delenv("NERFSTUDIO_METHOD_CONFIGS", raising=False)
    methods, descriptions = registry.discover_methods()
    ours = (normlift_method, lerf_ovs_method, scannet_method)
    assert methods == {method.config.method_name: method.config for method in ours}
    assert descriptions == {method.config.method_name: method.description for method in ours}
    assert set(methods) == set(declared)
    assert set(methods) <= set(SUPPORTED_METHODS)
    assert all(method.config.viewer.websocket_host == "127.0.0.1" for method in ours)


def test_it_trains_as_splatfacto_does() -> None:
    ours, theirs = normlift_method.config, method_configs["splatfacto"]
    assert isinstance(theirs, TrainerConfig)
    different = {f.name for f in fields(TrainerConfig) if getattr(ours, f.name) != getattr(theirs, f.name)}
    assert different == {"method_name", "pipeline", "viewer"}
    assert replace(ours.viewer, websocket_host=theirs.viewer.websocket_host) == theirs.viewer
    assert ours.viewer.websocket_host == "127.0.0.1"
    assert ours.pipeline.datamanager == theirs.pipeline.datamanager
    assert ours.pipeline.model == NormLiftModelConfig.upgrade(theirs.pipeline.model)  # type: ignore[arg-type]


def test_the_demo_is_a_run_of_splatfacto() -> None:
    ours, theirs = splatfacto_config(), method_configs["splatfacto"]
    assert ours.viewer.websocket_host == "127.0.0.1"
    assert replace(ours, viewer=theirs.viewer) == theirs


@pytest.mark.slow
@pytest.mark.parametrize("first", ["normlift_ns.method_configs.normlift", "nerfstudio.configs.method_configs"])
def test_it_is_imported_in_any_order_and_pulls_in_no_encoder(first: str) -> None:
    """nerfstudio imports it while it is being imported itself; an error there would break every ns-* command."""
    program = (
        f"import {first}, sys\n"
        "import nerfstudio.configs.method_configs, normlift_ns.method_configs.normlift\n"
        "print(sorted({'open_clip', 'numba', 'torchmetrics.image.lpip', 'open3d'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().endswith("[]")


NOT_NERFSTUDIOS = ["open_clip", "numba", "safetensors", "xxhash", "plyfile", "docstring_parser", "prompt_toolkit"]
NOT_NERFSTUDIOS += ["msgspec", "scipy", "skimage", "cv2", "transformers", "triton", "gsplat", "torchmetrics"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs fork")
@pytest.mark.parametrize("missing", NOT_NERFSTUDIOS)
def test_nerfstudio_lists_its_methods_whatever_is_missing(missing: str, tmp_path: Path) -> None:
    """In a child of this process, where nerfstudio is imported: all of ours is imported anew without one package, and
    without checks of shapes."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            for name in [name for name in sys.modules if name.split(".")[0] in ("normlift_ns", missing)]:
                del sys.modules[name]
            sys.meta_path[:] = [finder for finder in sys.meta_path if "jaxtyping" not in type(finder).__module__]
            sys.modules[missing] = None  # type: ignore[assignment]  # importing it is an ImportError
            sys.stderr = (tmp_path / "err").open("w")
            group = "nerfstudio.method_configs"
            declared = PROJECT["project"]["entry-points"][group]
            points = EntryPoints(EntryPoint(name, value, group) for name, value in declared.items())
            registry.entry_points = lambda group: points.select(group=group)  # type: ignore[attr-defined]
            methods, _ = registry.discover_methods()
            sys.stderr.flush()
            told = (tmp_path / "err").read_text()
            assert set(methods) == set(declared) or (methods == {} and told.count("cannot be used") == len(declared))
            assert methods != {} or missing in told
            (tmp_path / "methods").write_text(" ".join(methods))
            code = 0
        finally:
            os._exit(code)
    assert os.waitpid(pid, 0)[1] == 0
    if missing in ("open_clip", "numba", "docstring_parser", "prompt_toolkit", "skimage", "transformers"):
        assert "normlift" in (tmp_path / "methods").read_text()  # which they are not needed for


def test_an_error_of_any_kind_is_told_and_leaves_other_methods(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(name: str) -> None:
        raise OSError("libcuda.so: cannot open shared object file")

    monkeypatch.setattr(entry, "import_module", broken)
    assert entry._method("scannet") is None
    assert "scannet cannot be used (OSError: libcuda.so: cannot" in capsys.readouterr().err
