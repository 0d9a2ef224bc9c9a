"""ns-normlift-view, before it serves anything; mistakes are in test_early.py."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

from normlift_ns.scripts import view


def test_a_port_that_is_taken_is_told(monkeypatch, capsys):
    doors: list[tuple[str, int]] = []

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    def door(host: str, port: int) -> SimpleNamespace:
        doors.append((host, port))
        return SimpleNamespace(server=SimpleNamespace(port=7010))

    monkeypatch.setattr("normlift_ns.viewer.serving.door.Door", door)
    monkeypatch.setattr(view, "check_lifted", lambda *_: None)
    monkeypatch.setattr(view.NormLiftView, "open", interrupted)
    for host, port in (("127.0.0.1", 7008), ("0.0.0.0", 7010)):
        view.NormLiftView(Path("config.yml"), host=host, port=port).main()
    taken, *lines = capsys.readouterr().out.splitlines()
    assert "7008" in taken and len(lines) == 4
    assert "http://127.0.0.1:7010" in lines[0] and lines[:2] == lines[2:]
    assert doors == [("127.0.0.1", 7008), ("0.0.0.0", 7010)]
    assert view.NormLiftView(Path("config.yml")).host == "127.0.0.1"
