"""Fixtures for all tests."""

import os
import sys
from collections.abc import Iterator
from typing import Any

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


def pytest_collection_finish() -> None:
    """Makes Triton's interpreter prepare its language once per launch.

    It does so again at every call of one jit function by another, though nothing is left to prepare, which is two
    fifths of the time of the tests of kernels.
    """
    interpreter: Any = sys.modules.get("triton.runtime.interpreter")
    if not hasattr(interpreter, "_LangPatchScope"):  # not imported, or a version that prepares otherwise
        return
    prepare, prepared = interpreter._patch_lang, set()

    def once(fn: Any) -> Any:
        names = frozenset(name for name in ("tl", "core") if name in fn.__globals__)
        if names in prepared:
            return None  # a call within a launch, whose answer nobody looks at
        scope = prepare(fn)
        if not prepared:  # a launch
            restore = scope.restore
            scope.restore = lambda: (prepared.clear(), restore())
        prepared.add(names)
        return scope

    interpreter._patch_lang = once


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Switches the shape checks off, as they are for users: for tests of the messages that users get instead."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
