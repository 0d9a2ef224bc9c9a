"""Fixtures for all tests."""

import os
from collections.abc import Iterator

import jaxtyping
import pytest
import torch
from hypothesis import settings

# max_examples: where a test names no number. CI tries the same examples every time, so that a change fails by its own
# doing; everybody else, and `make torture`, looks for new ones.
settings.register_profile("tests", max_examples=30, derandomize="CI" in os.environ)
settings.load_profile("tests")
if not torch.cuda.is_available():  # Triton kernels run in its interpreter; read when a kernel is defined
    os.environ["TRITON_INTERPRET"] = "1"


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Switches the shape checks off, as they are for users: for tests of the messages that users get instead."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
