"""Fixtures for all tests."""

import os
from collections.abc import Iterator

import jaxtyping
import pytest
import torch

if not torch.cuda.is_available():  # Triton kernels run in its interpreter; read when a kernel is defined
    os.environ["TRITON_INTERPRET"] = "1"


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Switches the shape checks off, as they are for users: for tests of the messages that users get instead."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
