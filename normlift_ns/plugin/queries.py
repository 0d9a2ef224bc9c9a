"""Text vectors that are stored with a run, so that stock nerfstudio can render relevancies without a text encoder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from normlift_ns.core.files import atomic_path

_FILE = "queries.safetensors"


class QueryVectors(NamedTuple):
    """Vectors of texts, from the encoder that made the field."""

    vectors: Float[Tensor, "q d"]
    negatives: Float[Tensor, "b d"] | None = None
    """With negatives, relevancy is LERF's (0.5: a draw); without, the cosine."""


def save_queries(folder: Path, queries: QueryVectors) -> None:
    """Writes queries.safetensors beside the field."""
    tensors = {name: value.contiguous().cpu() for name, value in queries._asdict().items() if value is not None}
    with atomic_path(folder / _FILE) as temporary:
        save_file(tensors, temporary)


def load_queries(folder: Path, texts: Sequence[str]) -> QueryVectors | None:
    """The vectors of the texts that the config names; None if it names none.

    Raises:
        FileNotFoundError, ValueError: no such file, a damaged one, or vectors of other texts.
    """
    if len(texts) == 0:
        return None
    path = folder / _FILE
    if not path.exists():
        raise FileNotFoundError(
            f"{path} is missing, which holds the vectors of {list(texts)}; lift again with: ns-normlift"
        )
    try:
        tensors = load_file(path)
        queries = QueryVectors(tensors["vectors"], tensors.get("negatives"))
    except (SafetensorError, KeyError) as error:
        raise ValueError(f"{path} is damaged ({error}); lift again with: ns-normlift --load-config ...") from error
    if len(queries.vectors) != len(texts):
        raise ValueError(
            f"{path} has {len(queries.vectors)} vectors, the config names {len(texts)} queries {list(texts)}; "
            "lift again with: ns-normlift --load-config ..."
        )
    return queries
