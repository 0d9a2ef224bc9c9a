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
        self._objects: tuple[FoundObject, ...] = ()
        with gui.add_folder("Found objects"):
            self._remark = gui.add_markdown("Nothing is selected.")
            # made once: viser keeps what is added to a panel that all pages share, and its removal, for ever
            self._rows = [self._row(gui, i, act) for i in range(MOST_OBJECTS)]

    def show(self, found: Found) -> None:
        """Lists these objects, at most `MOST_OBJECTS`, in place of those before."""
        self._objects = tuple(found.objects)
        rest = [f"{found.left_out:,} smaller objects are not listed"] * (found.left_out > 0)
        rest += [f"Gaussians in smaller parts: {found.in_smaller_parts:,}"] * (found.in_smaller_parts > 0)
        none = "" if len(found.objects) > 0 else "Nothing that is drawn is selected."
        self._remark.content = as_text("; ".join(rest) or none)
        for i, (text, buttons) in enumerate(self._rows):
            if i < len(self._objects):
                row = self._objects[i]
                facts = as_text(f"object {row.number}: {row.size:,} Gaussians, {row.evidence}")
                text.content = f"{swatch(row.colour)} **{as_text(clipped(row.text, 40))}** {facts}"
            text.visible = buttons.visible = i < len(self._objects)

    def _row(self, gui: Any, i: int, act: Callable[[str, FoundObject, Any], None]) -> tuple[Any, Any]:
        def pressed(deed: str, event: Any) -> None:
            if i < len(self._objects):
                act(deed, self._objects[i], event)

        text = gui.add_markdown("")
        buttons = button_group(gui, "", OBJECT_DEEDS, pressed)
        text.visible = buttons.visible = False
        return text, buttons
