"""A small demo room, trained and lifted, for the tests of the commands and for the examples that open a run."""

from __future__ import annotations

import gc
import inspect
import os
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

    from normlift_ns.demo import DemoRoom

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # threads without work leave the core to the other process
if "PYTEST_XDIST_WORKER" in os.environ:  # another process tests beside this one; both read when torch is imported
    os.environ.setdefault("OMP_NUM_THREADS", "1")

gc.disable()  # until all is imported: what imports make stays, and looking through it takes a quarter of the time
_STACK = inspect.stack


def _functions(context: int = 1) -> list[SimpleNamespace]:
    """Who calls whom, without the lines of source, whose search takes nine seconds where nerfstudio lists methods."""
    found, frame = [], inspect.currentframe()
    while frame is not None and (frame := frame.f_back) is not None:
        found.append(SimpleNamespace(function=frame.f_code.co_name))
    return found


inspect.stack = _functions  # type: ignore[assignment]  # until all is imported


def pytest_collection_finish() -> None:
    """What was imported is left alone by the collector from here on."""
    inspect.stack = _STACK
    gc.freeze()
    gc.enable()


def pytest_unconfigure() -> None:
    """Python ends as usual; some libraries complain of what is left."""
    gc.unfreeze()


# Imports stand inside the fixtures: the other tests need not wait for them.
_OPENS_A_RUN = re.compile(r"\b(open_run|open_scene|lift_run)\(config\b")


@pytest.fixture(scope="session")
def room() -> DemoRoom:
    """The room itself."""
    from benchmarks.plain_room import plain_room  # noqa: PLC0415

    return plain_room(6000)


@pytest.fixture(scope="session")
def trained(room: DemoRoom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of a run of stock splatfacto in the room."""
    from normlift_ns.demo import write_capture, write_splatfacto_run  # noqa: PLC0415

    folder = tmp_path_factory.mktemp("room")
    write_capture(room, folder / "room", views=12, held_out=2, width=160, height=120)
    return write_splatfacto_run(room, folder / "room", folder / "outputs")


@pytest.fixture(scope="session")
def lifted(trained: Path) -> Path:
    """config.yml of the lifted run."""
    from normlift_ns.scripts import lift  # noqa: PLC0415
    from tests.scripts.conftest import QUICK, run_entry  # noqa: PLC0415

    with pytest.MonkeyPatch.context() as monkeypatch:
        flags = ("--load-config", trained, *QUICK, "--timestamp", "one", "--queries", "red", "yellow")
        assert run_entry(monkeypatch, lift.entrypoint, *flags) == 0
    return trained.parents[2] / "normlift" / "one" / "config.yml"


@pytest.fixture
def opened(lifted: Path, tmp_path: Path, doctest_namespace: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """What examples that open a run work with: its `config`, a `folder` to write to, and silence from nerfstudio."""
    from nerfstudio.utils.rich_utils import CONSOLE  # noqa: PLC0415

    monkeypatch.setitem(doctest_namespace, "config", lifted)
    monkeypatch.setitem(doctest_namespace, "folder", tmp_path)
    monkeypatch.setattr(CONSOLE, "quiet", True)


@pytest.fixture(autouse=True)
def _gradients() -> Iterator[None]:
    """No test leaves torch without gradients: the next that trains in the same process would fail in its place."""
    yield
    torch = sys.modules.get("torch")
    if torch is not None and not torch.is_grad_enabled():
        torch.set_grad_enabled(True)
        pytest.fail("gradients are switched off after this test")


@pytest.fixture(autouse=True)
def _examples(request: pytest.FixtureRequest) -> None:
    item = request.node
    if isinstance(item, pytest.DoctestItem) and any(_OPENS_A_RUN.search(x.source) for x in item.dtest.examples):
        request.getfixturevalue("opened")
