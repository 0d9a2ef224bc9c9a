import pytest

from normlift_ns.demo.room import DemoRoom, demo_room


@pytest.fixture(scope="session")
def room() -> DemoRoom:
    return demo_room(6000)
