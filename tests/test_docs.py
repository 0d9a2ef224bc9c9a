"""Pages are written by hand, but for tables that are those of the committed results."""

import shutil
from typing import Any

import pytest

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
def pages() -> Any:
    from research import pages  # noqa: PLC0415 (scikit-image, matplotlib)

    return pages


@pytest.fixture(scope="module")
def made(pages):
    return pages.tables(pages.documents())


@pytest.fixture
def folder(pages, tmp_path):
    for name in pages.PAGES:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(pages.DOCS.parent / name, tmp_path / name)
    return tmp_path


def test_tables_of_the_pages_are_those_of_the_results_and_every_table_stands_on_one(pages, made):
    shown = set()
    for name in pages.PAGES:
        text = (pages.DOCS.parent / name).read_bytes().decode()
        assert pages.outdated(text, made) == [], "refresh them: python -m research.pages"
        assert pages.refreshed(text, made) == text
        shown |= {part.table for part in pages.split(text, made)}
    assert shown == {None, *made}


def test_a_refresh_changes_tables_alone_and_refuses_wrong_markers(pages):
    assert pages.outdated(PAGE, MADE) == ["first", "second"]
    new = pages.refreshed(PAGE, MADE)
    assert new == PAGE.replace("| 7 |", "| 1 |").replace("second -->\r\n", f"second -->\r\n{MADE['second']}")
    assert pages.outdated(new, MADE) == []
    by_hand = [[part.text for part in pages.split(text, MADE) if part.table is None] for text in (PAGE, new)]
    assert by_hand[0] == by_hand[1]
    assert "".join(part.text for part in pages.split(PAGE, MADE)) == PAGE
    for text, *facts in (
        ("\n<!-- table: third -->\n<!-- end -->\n", "line 2", "third", "first, second"),
        ("<!-- table: first -->\n", "first", "<!-- end -->"),
        ("<!-- table: first -->\n<!-- table: second -->\n<!-- end -->\n", "line 2", "second", "first"),
        ("text\n<!-- end -->\n", "line 2", "<!-- end -->"),
        ("<!--table: first-->\n<!-- end -->\n", "line 1", "<!-- table: NAME -->"),
        ("<!-- table: first -->\n<!-- End -->\n", "line 2", "<!-- table: NAME -->"),
        ("Before <!-- table: first -->\n<!-- end -->\n", "line 1", "<!-- table: NAME -->"),
    ):
        with pytest.raises(pages.MarkerError) as error:
            pages.refreshed(text, MADE)
        assert [fact for fact in facts if fact not in str(error.value)] == [], text


def test_check_names_the_page_and_the_table_and_a_refresh_writes_all_or_nothing(pages, folder, monkeypatch, capsys):
    pages.main(check=True, folder=folder)
    page = folder / "research" / "studies.md"
    stale = page.read_text().replace("| fitted, for `--vote paper` | 36 |", "| fitted, for `--vote paper` | 48 |")
    page.write_text(stale)
    with pytest.raises(SystemExit) as stopped:
        pages.main(check=True, folder=folder)
    assert "studies.md: table parameters" in str(stopped.value)  # a message is exit status 1
    assert page.read_text() == stale
    assert sorted(str(path.relative_to(folder)) for path in folder.glob("*/*")) == sorted(pages.PAGES)
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(pages, "plots", lambda found, folder: [])
    bad = folder / "docs" / "speed_and_error.md"
    bad.write_text(bad.read_text() + "<!-- end -->\n")
    with pytest.raises(SystemExit, match=r"speed_and_error.md, line \d+"):
        pages.main(check=False, folder=folder)
    assert page.read_text() == stale
    bad.write_text(bad.read_text().removesuffix("<!-- end -->\n"))
    pages.main(check=False, folder=folder)
    assert all((folder / name).read_bytes() == (pages.DOCS.parent / name).read_bytes() for name in pages.PAGES)
