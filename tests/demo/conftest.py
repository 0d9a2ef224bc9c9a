from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from normlift_ns.demo.room import DemoRoom


@pytest.fixture(scope="session")
def room() -> DemoRoom:
    """The room that people see, with few Gaussians."""
    from normlift_ns.demo.room import demo_room  # noqa: PLC0415

    return demo_room(6000)
