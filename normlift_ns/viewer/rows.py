"""Found objects in a panel: a row for each, with its buttons."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from normlift_ns.session.found import Found, FoundObject
from normlift_ns.viewer.adapter import button_group
from normlift_ns.viewer.legend import clipped
from normlift_ns.viewer.status import as_text, swatch

MOST_OBJECTS = 8
OBJECT_DEEDS = ("go to", "only", "hide", "export")


class Rows:
    """The list of found objects, in the container of the panel that is open when it is made.

    Args:
        gui: viser's `GuiApi`.
        act: called with a deed, the object that it is done to, and viser's event.
    """

    def __init__(self, gui: Any, act: Callable[[str, FoundObject, Any], None]) -> None:
        self._gui, self._act = gui, act
        self._handles: list[Any] = []
        self._folder = gui.add_folder("Found objects")
        with self._folder:
            self._remark = gui.add_markdown("Nothing is selected.")

    def show(self, found: Found) -> None:
        """Lists these objects in place of those before."""
        for handle in self._handles:
            handle.remove()
        rest = [f"{found.left_out:,} smaller objects are not listed"] * (found.left_out > 0)
        rest += [f"Gaussians in smaller parts: {found.in_smaller_parts:,}"] * (found.in_smaller_parts > 0)
        none = "" if len(found.objects) > 0 else "Nothing that is drawn is selected."
        self._remark.content = as_text("; ".join(rest) or none)
        with self._folder:
            self._handles = [handle for row in found.objects for handle in self._row(row)]

    def _row(self, row: FoundObject) -> list[Any]:
        facts = as_text(f"object {row.number}: {row.size:,} Gaussians, {row.evidence}")
        text = self._gui.add_markdown(f"{swatch(row.colour)} **{as_text(clipped(row.text, 40))}** {facts}")
        return [text, button_group(self._gui, "", OBJECT_DEEDS, lambda deed, event: self._act(deed, row, event))]
