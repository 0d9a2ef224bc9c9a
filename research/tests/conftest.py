"""Research is not even collected in the default tiers: its imports take a second."""

from typing import Any

import pytest


def pytest_ignore_collect(config: pytest.Config) -> bool | None:
    return True if "not extra" in str(config.getoption("markexpr")) else None


@pytest.fixture(scope="session")
def world() -> Any:
    from research.tests.tiny import tiny_world  # noqa: PLC0415

    return tiny_world()
