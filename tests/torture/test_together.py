"""Eight processes, or two, at once on one capture: no run is lost, and no files of two of them are mixed."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from tests.torture.conftest import SHORT, Record, Server
from tests.torture.test_kills import Place, Tree, differing, tree, without_cache

EIGHT = 2 if SHORT else 8
TEXTS = ("red", "yellow", "blue", "green", "white", "brown", "black", "orange")[:EIGHT]


@pytest.fixture(scope="module")
def place(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Place:
    place = Place(server, tmp_path_factory.mktemp("together"))
    server.command(*place.lift("--timestamp", "one", "--queries", "red", "--vote-k", 6))
    place.save()
    return place


def together(place: Place, tmp_path: Path, *commands: tuple[object, ...]) -> tuple[list[int], list[str]]:
    """Exit codes and output of commands that start at the same time."""
    logs = [tmp_path / f"{i}.log" for i in range(len(commands))]
    found = place.server.run(*({"words": words, "log": str(log)} for words, log in zip(commands, logs)))
    return [code for code, _ in found], [" ".join(log.read_text().split()) for log in logs]


def each_alone(place: Place, commands: Iterable[tuple[object, ...]], look: Callable[[], Tree]) -> list[Tree]:
    """What each of some commands leaves where nothing else happens; the place is put back as it was."""
    known = []
    for words in commands:
        place.restore()
        place.server.command(*words)
        known.append(look())
    place.restore()
    return known


def answers(place: Place, run: Path) -> Any:
    """What a run says of its own query, which proves that it is whole; asked by a process of its own."""
    output = place.folder.parent / "answers.json"
    output.unlink(missing_ok=True)
    place.server.command("query", "--load-config", run / "config.yml", "--text", "red", "--output-json", output)
    return json.loads(output.read_text())


@pytest.mark.extra
def test_lifts_with_default_names_all_succeed(place: Place, tmp_path: Path, record: Record) -> None:
    place.restore()
    lifts = [place.lift("--queries", text, "--vote-k", 6) for text in TEXTS]
    codes, logs = together(place, tmp_path, *lifts)
    assert codes == [0] * EIGHT, logs
    runs = [path for path in place.runs.iterdir() if path.name not in ("one", ".cache")]
    assert len(runs) == EIGHT
    queries = {(run / "normlift" / "queries.safetensors").read_bytes() for run in runs}
    assert len(queries) == EIGHT  # every process finds its own again
    expected = answers(place, place.runs / "one")
    assert all(answers(place, run) == expected for run in runs)
    assert list(place.folder.rglob(".normlift-*")) == []
    record(f"{EIGHT} lifts at once, default names", EIGHT, f"{EIGHT} runs, all whole")


@pytest.mark.slow
def test_of_lifts_with_one_name_one_succeeds(place: Place, tmp_path: Path, record: Record) -> None:
    place.restore()
    codes, logs = together(place, tmp_path, *(place.lift("--timestamp", "two", "--queries", text) for text in TEXTS))
    assert sorted(codes) == [0] + [1] * (EIGHT - 1), logs
    refused = [log for code, log in zip(codes, logs) if code == 1]
    assert all("two exists" in log and "--timestamp" in log for log in refused), refused
    answers(place, place.runs / "two")
    assert sorted(path.name for path in place.runs.iterdir()) == [".cache", "one", "two"]
    record(f"{EIGHT} lifts at once, one `--timestamp`", EIGHT, f"1 run, whole; {EIGHT - 1} refused by name")


@pytest.mark.extra
def test_lifts_that_replace_one_run_leave_one_whole(place: Place, tmp_path: Path, record: Record) -> None:
    replaced = [place.lift("--timestamp", "one", "--vote-k", k, "--queries", text, "--overwrite", True)
                for k, text in ((6, "yellow"), (9, "blue"))]  # fmt: skip
    known = each_alone(place, replaced, lambda: without_cache(tree(place.runs)))
    codes, logs = together(place, tmp_path, *(replaced * (EIGHT // 2)))
    assert codes == [0] * EIGHT, logs
    found = without_cache(tree(place.runs))
    assert [] in [differing(found, whole) for whole in known]
    record(f"{EIGHT} lifts at once, `--overwrite True` of one run", EIGHT, "1 run, equal to that of one of them")


def export(place: Place, text: str, *flags: object) -> tuple[object, ...]:
    words = ("export", "--load-config", place.config, "--text", text, "--select", "selection", "--threshold", 0.2)
    return (*words, "--output-dir", place.folder / "out", *flags)


@pytest.mark.extra
def test_exports_never_mix(place: Place, tmp_path: Path, record: Record) -> None:
    known = each_alone(place, (export(place, text) for text in TEXTS[:2]), lambda: tree(place.folder / "out"))
    assert known[0] != known[1]
    codes, logs = together(place, tmp_path, *(export(place, TEXTS[i % 2], "--overwrite", True) for i in range(EIGHT)))
    assert codes == [0] * EIGHT, logs
    assert tree(place.folder / "out") in known
    place.restore()
    codes, logs = together(place, tmp_path, *(export(place, TEXTS[i % 2]) for i in range(EIGHT)))
    assert sorted(codes) == [0] + [1] * (EIGHT - 1), logs
    assert all("exists" in log for code, log in zip(codes, logs) if code == 1), logs
    assert tree(place.folder / "out") in known
    what = f"{EIGHT} exports at once into one folder, with and without `--overwrite True`"
    record(what, 2 * EIGHT, "files of one of them")


@pytest.mark.extra
def test_saves_and_everything_else_at_once(place: Place, tmp_path: Path, record: Record) -> None:
    def save(text: str) -> tuple[object, ...]:
        return ("query", "--load-config", place.config, "--text", text, "--save-query", True)

    known = each_alone(place, map(save, TEXTS), lambda: tree(place.config.parent))
    codes, logs = together(place, tmp_path, *map(save, TEXTS))
    assert codes == [0] * EIGHT, logs
    assert tree(place.config.parent) in known
    place.restore()
    mixed = [place.lift("--vote-k", 6), export(place, "red", "--overwrite", True)] * 3
    codes, logs = together(place, tmp_path, *mixed, save(TEXTS[0]), save(TEXTS[1]))
    assert set(codes) == {0}, logs
    assert len(list(place.runs.glob("[!.]*"))) == 4
    assert tree(place.config.parent) in known
    assert len(tree(place.folder / "out")) == 4
    what = f"{EIGHT} saves at once; 3 lifts, 3 exports and 2 saves at once"
    record(what, 2 * EIGHT, "the question of one; no run lost")
