"""Everything in transformers is Any: reading its own types takes a type checker 20 seconds."""

from typing import Any

def __getattr__(name: str) -> Any: ...
