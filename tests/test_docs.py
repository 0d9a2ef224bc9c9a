"""Pages are written by hand, but for tables that are those of the committed results."""

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
        ("Before <!-- table: first -->\n<!-- end -->\n", "line 1", "<!-- table: NAME -->"),
    ):
        with pytest.raises(pages.MarkerError) as error:
            pages.refreshed(text, MADE)
        assert [fact for fact in facts if fact not in str(error.value)] == [], text
