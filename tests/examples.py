"""Numbers of examples that hypothesis tries: few by default, 20 times as many in `make test-all`."""

import os

from hypothesis import settings

FACTOR = int(os.environ.get("NORMLIFT_EXAMPLES", "1"))


def examples(number: int, **more: object) -> settings:
    """A decorator beside `@given` for a test that tries another number of examples than ten in the default tiers."""
    return settings(max_examples=number * FACTOR, deadline=None, **more)  # type: ignore[arg-type]


def register_profile(name: str, *, derandomize: bool) -> None:
    """Sets the number for all tests that name none."""
    settings.register_profile(name, max_examples=10 * FACTOR, derandomize=derandomize, deadline=None)
    settings.load_profile(name)
