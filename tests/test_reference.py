"""The reference of the commands is that of the code, and the site has a page for every public name.

The commands themselves are held against the code by tests/scripts/test_help.py.
"""

import re

import normlift_ns
from benchmarks.reference import PAGE, page


def test_the_page_is_made_of_the_code():
    assert PAGE.read_text("utf8") == page(), "refresh it: python -m benchmarks.reference"


def test_every_public_name_is_in_the_reference():
    shown = re.findall(r"^::: normlift_ns\.[\w.]*?(\w+)$", (PAGE.parent / "api.md").read_text("utf8"), re.MULTILINE)
    assert sorted(shown) == sorted(normlift_ns.__all__)
