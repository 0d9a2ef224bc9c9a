"""Pages that come before the run is read wait, and those that leave meanwhile are not let in."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from normlift_ns.viewer.serving import door as door_module
from normlift_ns.viewer.serving.door import OPENING, Door


class Waiting:
    def __init__(self, number: int) -> None:
        self.number, self.notices = number, []

    def notice(self, text: str) -> None:
        self.notices.append(text)


@pytest.fixture
def door(monkeypatch) -> Door:
    monkeypatch.setattr(door_module, "Server", lambda *_: SimpleNamespace(label=lambda text: None))
    return Door("", 0)


def test_pages_wait_until_the_door_opens(door):
    pages, came, went = [Waiting(i) for i in range(4)], [], []
    for page in pages[:3]:
        door._come(page)
    door._go(1)
    assert [page.notices for page in pages] == [[OPENING]] * 3 + [[]]
    door.open("label", came.append, went.append)
    assert came == [pages[0], pages[2]]
    assert pages[0].notices == [OPENING, ""]
    door._come(pages[3])
    door._go(0)
    assert came[2:] == [pages[3]]
    assert pages[3].notices == []
    assert went == [0]
