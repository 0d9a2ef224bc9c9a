"""Pages are written by hand, but for tables that are those of the committed results."""

from typing import Any

import pytest


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
