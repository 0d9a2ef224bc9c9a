"""Pages are written by hand, but for tables that are those of the committed results."""

import shutil

import pytest

from benchmarks import pages
from benchmarks.documents import documents
from benchmarks.pages import DOCS, PAGES, MarkerError, outdated, refreshed, split
from benchmarks.tables import tables

MADE = {"first": "| a |\n|---|\n| 1 |\n", "second": "| b |\n|---|\n| 2 |\n"}
PAGE = """# Title \t

Gamma is best at 0.4.
<!-- table: first -->
| a |
|---|
| 7 |
<!-- end -->
<!-- a remark -->\r
<!-- table: second -->\r
<!-- end -->

The table says 7; no line ends here"""


@pytest.fixture(scope="module")
def made():
    return tables(documents())


@pytest.fixture
def folder(tmp_path):
    for name in PAGES:
        shutil.copy(DOCS / name, tmp_path / name)
    return tmp_path


def test_tables_of_the_pages_are_those_of_the_results_and_every_table_stands_on_one(made):
    shown = set()
    for name in PAGES:
        text = (DOCS / name).read_bytes().decode()
        assert outdated(text, made) == [], "refresh them: python -m benchmarks.pages"
        assert refreshed(text, made) == text
        shown |= {part.table for part in split(text, made)}
    assert shown == {None, *made}


def test_a_refresh_changes_tables_alone():
    assert outdated(PAGE, MADE) == ["first", "second"]
    new = refreshed(PAGE, MADE)
    assert new == PAGE.replace("| 7 |", "| 1 |").replace("second -->\r\n", f"second -->\r\n{MADE['second']}")
    assert outdated(new, MADE) == []
    by_hand = [[part.text for part in split(text, MADE) if part.table is None] for text in (PAGE, new)]
    assert by_hand[0] == by_hand[1]
    assert "".join(part.text for part in split(PAGE, MADE)) == PAGE


def test_wrong_markers_are_refused():
    for text, *facts in (
        ("\n<!-- table: third -->\n<!-- end -->\n", "line 2", "third", "first, second"),
        ("<!-- table: first -->\n", "first", "<!-- end -->"),
        ("<!-- table: first -->\n<!-- table: second -->\n<!-- end -->\n", "line 2", "second", "first"),
        ("text\n<!-- end -->\n", "line 2", "<!-- end -->"),
        ("<!--table: first-->\n<!-- end -->\n", "line 1", "<!-- table: NAME -->"),
        ("<!-- table: first -->\n<!-- End -->\n", "line 2", "<!-- table: NAME -->"),
        ("Before <!-- table: first -->\n<!-- end -->\n", "line 1", "<!-- table: NAME -->"),
    ):
        with pytest.raises(MarkerError) as error:
            refreshed(text, MADE)
        assert [fact for fact in facts if fact not in str(error.value)] == [], text


def test_check_names_the_page_and_the_table(folder, capsys):
    pages.main(check=True, folder=folder)
    page = folder / "accuracy.md"
    stale = page.read_text().replace("| fitted, for `--vote paper` | 36 |", "| fitted, for `--vote paper` | 48 |")
    page.write_text(stale)
    with pytest.raises(SystemExit) as stopped:
        pages.main(check=True, folder=folder)
    assert "accuracy.md: table parameters" in str(stopped.value)  # a message is exit status 1
    assert page.read_text() == stale
    assert sorted(path.name for path in folder.iterdir()) == sorted(PAGES)
    assert capsys.readouterr().out == ""


def test_a_refresh_writes_pages_in_place_or_nothing(folder, monkeypatch):
    monkeypatch.setattr(pages, "plots", lambda found, folder: [])
    good, bad, *_ = (folder / name for name in PAGES)
    good.write_text(good.read_text().replace("| 36 |", "| 48 |"))
    before = good.read_text()
    bad.write_text(bad.read_text() + "<!-- end -->\n")
    with pytest.raises(SystemExit, match=r"speed_and_error.md, line \d+"):
        pages.main(check=False, folder=folder)
    assert good.read_text() == before
    bad.write_text(bad.read_text().removesuffix("<!-- end -->\n"))
    pages.main(check=False, folder=folder)
    assert all((folder / name).read_bytes() == (DOCS / name).read_bytes() for name in PAGES)
