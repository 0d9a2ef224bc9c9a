"""Elements of the panel that nerfstudio's viewer does not have, or has otherwise."""

from __future__ import annotations

from typing import Any

from nerfstudio.viewer.viewer_elements import ViewerButton, ViewerElement, ViewerParameter, ViewerText


class TextBox(ViewerText):
    """A text box that does nothing while one types: nerfstudio would render again at every key."""

    def install(self, viser_server: Any) -> None:
        """Makes the element in the page."""
        self._create_gui_handle(viser_server)


class FreeButton(ViewerButton):
    """A button whose hook is called without the render lock, so that the picture stays live while it works."""

    def install(self, viser_server: Any) -> None:
        """Makes the element in the page."""
        self._create_gui_handle(viser_server)
        press = self.cb_hook  # nerfstudio puts another in its place, which takes the lock
        self.gui_handle.on_click(lambda _: press(self))


class Markdown(ViewerElement[str]):
    """Text in the panel, which changes as the program likes. It is compiled as MDX: see `status.as_text`."""

    def __init__(self, content: str) -> None:
        super().__init__("")
        self.content = content

    def _create_gui_handle(self, viser_server: Any) -> None:
        self.gui_handle = viser_server.gui.add_markdown(self.content)

    def install(self, viser_server: Any) -> None:
        """Makes the element in the page."""
        self._create_gui_handle(viser_server)

    def set(self, content: str) -> None:
        """Replaces the text."""
        self.content = content
        if self.gui_handle is not None:
            self.gui_handle.content = content  # type: ignore[attr-defined]


def set_value(element: ViewerParameter[Any], value: Any) -> None:
    """Sets an element, which calls its hook in another thread, only where that changes it."""
    if element.value != value:
        element.value = value
