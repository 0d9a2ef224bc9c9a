"""The viewer with viser 1.x, which cannot be installed beside nerfstudio 1.1.5: in an environment of its own.

NORMLIFT_VISER1: the Python of an environment that has it. Without, one is made, which takes a minute; it sees all other
packages of this one but nerfstudio.
"""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import numpy as np
import pytest

from tests.browser.own_viewer import Own, own_viewer
from tests.browser.viewer import CHROMIUM, chromium, hue_mask, iou, middle

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow
PURPLE = (0.79, 0.6)


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
    done = subprocess.run([python, "-c", "import nerfstudio"], capture_output=True, text=True, check=False)
    assert "ModuleNotFoundError" in done.stderr
    words = [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/viewer/test_adapter.py"]
    done = subprocess.run(
        words, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-3000:]
    assert "failed" not in done.stdout


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: install Debian's package chromium")
def test_a_person_before_viser_1(python: Path, demo_run: Path, pictures: Path, tmp_path: Path) -> None:
    assert Path(sys.executable) != python
    with own_viewer(demo_run, tmp_path / "view.log", python=python) as address, chromium() as browser:
        own = Own(browser, address)
        own.says("The run stores these prompts")
        own.page.locator(".mantine-Notification-closeButton").first.click()  # that it draws in software
        photo = own.picture()
        purple = hue_mask(photo, *PURPLE)
        own.ask("red, zebra; purple", key=True)
        own.until(lambda: own.selected() > 0, "an answer")
        assert "contains no colour name" in own.text()
        own.page.screenshot(path=pictures / "viser1_asked.png")
        both = own.selected()
        own.press("Select")
        own.says("Click on an object.")
        own.page.mouse.click(*middle(purple))
        own.until(lambda: 0 < own.selected() < both, "the connected object")
        own.until(lambda: iou(np.ptp(own.picture().astype(int), axis=2) > 60, purple) > 0.6, "it is drawn")
        box = own.selected()
        own.press("Hide")
        own.until(lambda: hue_mask(own.picture(), *PURPLE).sum() < 50, "hidden")
        own.page.screenshot(path=pictures / "viser1_hidden.png")
        own.page.reload()
        own.ready()
        own.until(lambda: own.selected() == box, "a reload keeps the selection")
        own.press("Undo")
        own.press("Undo")
        own.until(lambda: own.selected() == both, "and the history")
        own.page.keyboard.down("Shift")
        own.says("Click on objects.")
        own.page.mouse.click(*middle(hue_mask(photo, 0.0, 0.9)))
        own.page.keyboard.up("Shift")
        own.until(lambda: "Click on" not in own.text(), "released")
        own.page.screenshot(path=pictures / "viser1_shift.png")
        assert own.problems == []
