import pytest

from normlift_ns.demo.room import DemoRoom, demo_room


@pytest.fixture(scope="session")
def room() -> DemoRoom:
    """The room that people see, with few Gaussians."""
    return demo_room(6000)
