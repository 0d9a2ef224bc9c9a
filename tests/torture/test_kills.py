"""Processes that are killed while they write: nothing is lost or left over, and the command can be run again."""

import json
import random
import shutil
import signal
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from tests.torture.conftest import INSTANTS, SHORT, Record, Server

pytestmark = pytest.mark.slow

Tree = dict[str, Any]
COMMON = ("--encoder", "color", "--check-alignment", False, "--device", "cpu")


def tree(folder: Path) -> Tree:
    """All files below a folder, hidden ones included; of a manifest, all but what a lift has cost."""
    found: Tree = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_dir():
            found[name] = None
        elif path.name == "manifest.json":
            found[name] = {k: v for k, v in json.loads(path.read_text()).items() if k not in ("cost", "digest")}
        else:
            found[name] = path.read_bytes()
    return found


def differing(first: Tree, second: Tree) -> list[str]:
    return sorted(name for name in first.keys() | second.keys() if first.get(name, 0) != second.get(name, 0))


class Place:
    """A capture with a trained run and a lifted one, `one`, which can be put back as it was."""

    def __init__(self, server: Server, folder: Path) -> None:
        self.server, self.folder, self.saved = server, folder / "now", folder / "saved"
        self.folder.mkdir()
        server.command("room", self.folder)
        (self.trained,) = self.folder.glob("outputs/room/splatfacto/*/config.yml")
        self.runs = self.folder / "outputs" / "room" / "normlift"
        self.config = self.runs / "one" / "config.yml"

    def lift(self, *flags: object) -> tuple[object, ...]:
        return ("lift", "--load-config", self.trained, *COMMON, *flags)

    def save(self) -> None:
        shutil.rmtree(self.saved, ignore_errors=True)
        shutil.copytree(self.folder, self.saved)

    def restore(self) -> None:
        shutil.rmtree(self.folder)
        shutil.copytree(self.saved, self.folder)


@pytest.fixture(scope="module")
def place(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Place:
    place = Place(server, tmp_path_factory.mktemp("kills"))
    server.command(*place.lift("--timestamp", "one", "--queries", "red", "--vote-k", 6))
    shutil.rmtree(place.runs / ".cache")
    out = place.folder / "out"
    server.command("export", "--load-config", place.config, "--output-dir", out)
    place.save()
    return place


COMMANDS = {
    "ns-normlift --overwrite True": ("lift", "outputs/room/normlift"),
    "ns-normlift-export --overwrite True": ("export", "out"),
    "ns-normlift-query --save-query True": ("query", "outputs/room/normlift/one"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_loses_nothing(name: str, place: Place, record: Record) -> None:
    command, below = COMMANDS[name]
    words = {
        "lift": place.lift("--timestamp", "one", "--queries", "yellow", "--vote-k", 9, "--overwrite", True),
        "query": ("query", "--load-config", place.config, "--text", "yellow", "--save-query", True),
        "export": (
            *("export", "--load-config", place.config, "--text", "yellow", "--select", "selection"),
            *("--output-dir", place.folder / "out", "--overwrite", True),
        ),
    }[command]
    watched = place.folder / below
    place.restore()
    old, begin = tree(watched), time.monotonic()
    ((code, steps),) = place.server.run({"words": words, "folder": str(watched)})
    took = time.monotonic() - begin
    assert code == 0
    assert steps >= 6
    new = tree(watched)
    assert len(differing(old, new)) > 0
    draw, seen = random.Random(0), Counter()
    moments: list[dict[str, Any]] = [{"step": step} for step in spread(draw, steps, INSTANTS - INSTANTS // 5)]
    moments += [{"seconds": draw.uniform(0.05, took)} for _ in range(INSTANTS // 5)]
    terms = 1 if SHORT else 3 if command == "lift" else INSTANTS
    moments += [{"step": step, "signal": signal.SIGTERM} for step in spread(draw, steps, terms)]
    for moment in moments:
        place.restore()
        ((code, taken),) = place.server.run({"words": words, "folder": str(watched), **moment})
        # where processes wait for each other's locks, a run has a few steps more or less than another
        assert code != 0 or "seconds" in moment or taken < moment["step"] > steps - 10, moment
        look(place, command)
        state = {path: content for path, content in tree(watched).items() if ".cache" not in path}
        kept = [known for known in (old, new) if differing(state, without_cache(known)) == []]
        assert len(kept) == 1, (moment, differing(state, without_cache(old)), differing(state, without_cache(new)))
        seen["old" if kept[0] is old else "new"] += 1
        assert place.server.run({"words": words})[0][0] == 0
        assert differing(tree(watched), new) == [], moment
        assert list(place.folder.rglob(".normlift-*")) == []
    assert set(seen) == {"old", "new"} or SHORT, seen
    found = f"{terms} SIGTERM: {seen['old']} times what was there before, {seen['new']} times the new"
    whole = "nothing lost or left over; run again it equals an undisturbed one. Found, with"
    record(f"kill -9 during `{name}`", INSTANTS, f"{whole} {found}")


def spread(draw: random.Random, steps: int, count: int) -> list[int]:
    """Steps in all parts of 1..steps, the last ones, where files take their places, in any case."""
    late = list(range(max(1, steps - max(1, count // 4) + 1), steps + 1))
    return sorted([draw.randint(1, steps) for _ in range(count - len(late))] + late)


def without_cache(found: Tree) -> Tree:
    return {path: content for path, content in found.items() if ".cache" not in path}


def look(place: Place, command: str) -> None:
    """The next command, whichever it is, completes what was under way, and finds a run or an export that is whole."""
    answers = place.folder / "answers.json"
    if command == "export":
        words = ("export", "--load-config", place.config, "--output-dir", place.folder / "out")
        assert place.server.run({"words": words})[0][0] == 1  # something is there
    else:
        words = ("query", "--load-config", place.config, "--text", "red", "--output-json", answers)
        if command == "lift":
            words = (*words, "--save-query", False)
        assert place.server.run({"words": words})[0][0] == 0
        answers.unlink()
        for left in place.runs.rglob(".normlift-*"):  # of the killed process; only who writes there removes it
            shutil.rmtree(left)
