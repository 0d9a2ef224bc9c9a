"""The viewer with viser 1.x, which cannot be installed beside nerfstudio 1.1.5: in an environment of its own.

NORMLIFT_VISER1: the Python of an environment that has it. Without, one is made, which takes a minute; it sees all other
packages of this one but nerfstudio.
"""

from __future__ import annotations

import os
import subprocess
import sysconfig
import venv
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.browser.person import RED, YELLOW, covers, hue_mask, middle, needs_chromium
from tests.browser.server import copied
from tests.browser.viewer import Own, own_viewer

if TYPE_CHECKING:
    from playwright.sync_api import Browser

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.extra


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment with viser 1.x before all other packages of this one."""
    if "NORMLIFT_VISER1" in os.environ:
        return Path(os.environ["NORMLIFT_VISER1"])
    folder = tmp_path_factory.mktemp("viser1")
    venv.create(folder, with_pip=True, symlinks=True)
    found = folder / "bin" / "python"
    inside = "import sysconfig; print(sysconfig.get_path('purelib'))"
    packages = subprocess.run([found, "-c", inside], capture_output=True, text=True, check=True).stdout.strip()
    hidden = 'import sys; sys.modules["nerfstudio"] = None'  # as where it is not installed
    (Path(packages) / "others.pth").write_text(f"{sysconfig.get_path('purelib')}\n{hidden}\n")
    done = subprocess.run(
        [found, "-m", "pip", "install", "-q", "viser>=1,<2"], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        pytest.skip(f"viser 1.x cannot be installed here: {done.stderr[-300:]}")
    return found


def test_the_adapter_knows_viser_1(python: Path) -> None:
    words = [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/viewer/test_adapter.py"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:]


@needs_chromium
def test_a_person_before_viser_1(python: Path, lifted: Path, browser: Browser, tmp_path: Path) -> None:
    with own_viewer(copied(lifted, tmp_path), tmp_path / "view.log", python=python) as address:
        own = Own(browser, address)
        own.page.locator(".mantine-Notification-closeButton").first.click()  # that it draws in software
        photo = own.sees(lambda seen: hue_mask(seen, *YELLOW).sum() > 1000, "the room")
        yellow = hue_mask(photo, *YELLOW)
        own.ask("red, zebra; yellow", key=True)
        both = own.selects(lambda count: count > 0, "an answer")
        own.says(r"⚠\s+zebra")
        own.arm("Select")
        own.click(middle(yellow))
        own.selects(lambda count: 0 < count < both, "the connected object")
        own.sees(lambda seen: covers(seen, yellow), "it is drawn")
        own.click_holding("Shift", middle(hue_mask(photo, *RED)))
        own.leave()
