import os
import sys
from dataclasses import fields, replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from normlift_ns.data.nerfstudio.config import SUPPORTED_METHODS
from tests.conftest import project

NAMES = {"normlift", "normlift-lerf-ovs", "normlift-scannet"}


def discovered() -> tuple[dict[str, Any], dict[str, str]]:
    from nerfstudio.plugins import registry  # noqa: PLC0415

    group = "nerfstudio.method_configs"
    points = EntryPoints(EntryPoint(*item, group) for item in project()["entry-points"][group].items())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "entry_points", lambda group: points.select(group=group))
        patch.delenv("NERFSTUDIO_METHOD_CONFIGS", raising=False)
        return registry.discover_methods()


def test_nerfstudio_discovers_the_method_by_its_entry_point() -> None:
    from normlift_ns.method_configs import entry  # noqa: PLC0415

    methods, descriptions = discovered()
    ours = (entry.normlift_method, entry.lerf_ovs_method, entry.scannet_method)
    assert methods == {method.config.method_name: method.config for method in ours}
    assert descriptions == {method.config.method_name: method.description for method in ours}
    assert set(methods) == NAMES <= set(SUPPORTED_METHODS)
    assert all(method.config.viewer.websocket_host == "127.0.0.1" for method in ours)


def test_it_trains_as_splatfacto_does_and_the_demo_is_a_run_of_splatfacto(nerfstudio: Any) -> None:
    from normlift_ns.demo.capture import splatfacto_config  # noqa: PLC0415
    from normlift_ns.method_configs.normlift import normlift_method  # noqa: PLC0415
    from normlift_ns.nerfstudio_plugin.model import NormLiftModelConfig  # noqa: PLC0415

    ours, theirs = normlift_method.config, nerfstudio.method_configs["splatfacto"]
    different = {f.name for f in fields(theirs) if getattr(ours, f.name) != getattr(theirs, f.name)}
    assert different == {"method_name", "pipeline", "viewer"}
    assert replace(ours.viewer, websocket_host=theirs.viewer.websocket_host) == theirs.viewer
    assert ours.pipeline.datamanager == theirs.pipeline.datamanager
    values = {name: value for name, value in vars(theirs.pipeline.model).items() if name != "_target"}
    assert ours.pipeline.model == NormLiftModelConfig(**values)
    demo = splatfacto_config()
    assert demo.viewer.websocket_host == "127.0.0.1"
    assert replace(demo, viewer=theirs.viewer) == theirs


NOT_NEEDED = ["open_clip", "numba", "prompt_toolkit", "skimage", "transformers", "gsplat", "triton"]
NOT_NEEDED += ["scipy", "torchmetrics"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs fork")
@pytest.mark.parametrize("missing", [NOT_NEEDED, ["safetensors"], ["cv2"]], ids=["not needed", "safetensors", "cv2"])
def test_nerfstudio_lists_its_methods_whatever_is_missing(missing: list[str], tmp_path: Path) -> None:
    """In a child of this process, where all of ours is imported anew without some packages and checks of shapes."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            for name in [name for name in sys.modules if name.split(".")[0] in ("normlift_ns", *missing)]:
                del sys.modules[name]
            sys.meta_path[:] = [finder for finder in sys.meta_path if "jaxtyping" not in type(finder).__module__]
            sys.modules.update(dict.fromkeys(missing))  # type: ignore[arg-type]  # importing them is an ImportError
            sys.stderr = (tmp_path / "err").open("w")
            methods, _ = discovered()
            sys.stderr.flush()
            (tmp_path / "methods").write_text(" ".join(methods))
            code = 0
        finally:
            os._exit(code)
    assert os.waitpid(pid, 0)[1] == 0
    methods, told = set((tmp_path / "methods").read_text().split()), (tmp_path / "err").read_text()
    assert methods == (NAMES if missing is NOT_NEEDED else set())
    assert told == "" if missing is NOT_NEEDED else told.count(missing[0]) == len(NAMES)


def test_an_error_of_any_kind_is_told_and_leaves_other_methods(monkeypatch, capsys) -> None:
    from normlift_ns.method_configs import entry  # noqa: PLC0415

    broken = Mock(side_effect=OSError("libcuda.so: cannot open shared object file"))
    monkeypatch.setattr(entry, "import_module", broken)
    assert entry._load_method("scannet") is None
    assert "scannet cannot be used (OSError: libcuda.so: cannot" in capsys.readouterr().err
