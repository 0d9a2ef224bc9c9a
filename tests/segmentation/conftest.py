"""The small networks of the encoders' tests."""

from tests.encoders.conftest import empty_hub, library_weights, sam_weights, transformers, unsure

__all__ = ["empty_hub", "library_weights", "sam_weights", "transformers", "unsure"]
