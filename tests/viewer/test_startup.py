"""Pages that come before the run is read wait, and those that leave meanwhile are not let in."""

from types import SimpleNamespace

from normlift_ns.viewer import adapter as door_module
from normlift_ns.viewer.adapter import OPENING, Door


def test_pages_wait_until_the_door_opens(monkeypatch):
    monkeypatch.setattr(door_module, "ViserServer", lambda *_: SimpleNamespace(label=lambda text: None))
    told, came, went, door = [[], [], [], []], [], [], Door("", 0)
    pages = [SimpleNamespace(number=i, notice=notices.append) for i, notices in enumerate(told)]
    for page in pages[:3]:
        door._come(page)
    door._go(1)
    assert told == [[OPENING]] * 3 + [[]]
    door.open("label", came.append, went.append)
    assert came == [pages[0], pages[2]]
    assert told[0] == [OPENING, ""]
    door._come(pages[3])
    door._go(0)
    assert came[2:] == [pages[3]]
    assert told[3] == []
    assert went == [0]
