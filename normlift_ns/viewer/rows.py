"""List of found objects in a panel: a row with buttons for each object."""

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
    """List of found objects, added to the container of the panel that is open when it is created.

    Args:
        gui: viser's `GuiApi`.
        act: called with the action (one of `OBJECT_DEEDS`), its object, and viser's event.
    """

    def __init__(self, gui: Any, act: Callable[[str, FoundObject, Any], None]) -> None:
        self._objects: tuple[FoundObject, ...] = ()
        with gui.add_folder("Found objects"):
            self._summary = gui.add_markdown("Nothing is selected.")
            # created once: viser never frees what is added to or removed from a panel that all pages share
            self._rows = [self._row(gui, i, act) for i in range(MOST_OBJECTS)]

    def show(self, object_list: Found) -> None:
        """Replace the listed objects; at most `MOST_OBJECTS` are shown."""
        self._objects, small = tuple(object_list.objects), object_list.in_smaller_parts
        unlisted = [f"{object_list.left_out:,} smaller objects are not listed"] * (object_list.left_out > 0)
        unlisted += [f"Gaussians in smaller components: {small:,}"] * (small > 0)
        empty = "" if len(self._objects) > 0 else "Nothing that is drawn is selected."
        self._summary.content = as_text("; ".join(unlisted) or empty)
        for i, (text, buttons) in enumerate(self._rows):
            if i < len(self._objects):
                row = self._objects[i]
                details = as_text(f"object {row.number}: {row.size:,} Gaussians, {row.evidence}")
                text.content = f"{swatch(row.colour)} **{as_text(clipped(row.text, 40))}** {details}"
            text.visible = buttons.visible = i < len(self._objects)

    def _row(self, gui: Any, i: int, act: Callable[[str, FoundObject, Any], None]) -> tuple[Any, Any]:
        def pressed(action: str, event: Any) -> None:
            if i < len(self._objects):
                act(action, self._objects[i], event)

        text = gui.add_markdown("")
        buttons = button_group(gui, "", OBJECT_DEEDS, pressed)
        text.visible = buttons.visible = False
        return text, buttons
