"""The small networks of the encoders' tests."""

from tests.encoders.conftest import (
    clip,
    clip_weights,
    empty_hub,
    library_weights,
    open_clip,
    sam_weights,
    transformers,
    unsure,
)

__all__ = ["clip", "clip_weights", "empty_hub", "library_weights", "open_clip", "sam_weights", "transformers", "unsure"]
