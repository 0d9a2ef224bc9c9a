from __future__ import annotations

import subprocess
import sys
from dataclasses import fields, replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins import registry

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
