import pytest

from normlift_ns.demo import DemoRoom, demo_room


@pytest.fixture(scope="session")
def room() -> DemoRoom:
    return demo_room(20_000)


@pytest.fixture(scope="session")
def small() -> DemoRoom:
    return demo_room(2000)
