"""What the panel says: nothing of a prompt or an error is compiled as MDX."""

from __future__ import annotations

import html
import re

from normlift_ns.errors import visible
from normlift_ns.viewer.legend import clipped
from normlift_ns.viewer.status import as_text

HOSTILE = (
    "<script>x</script>", "{1+1}", "| a | b |", "**b**", "a\n# b", "`x`", "\x1b[31m", "\u202ex", "\udc80", "\0", "&lt;",
)  # fmt: skip


def test_markup_is_text_and_choices_of_a_dropdown_can_be_sent_and_shown():
    for text in HOSTILE:
        shown = as_text(text)
        assert re.fullmatch(r"(?:\w| |&#\d+;)*", shown), text
        assert html.unescape(shown) == visible(text, keep="\n")
        assert clipped(text, 40).isprintable(), text
        clipped(text, 40).encode("utf8")
