"""Adapter for encoders of other packages: checks their results and attributes their errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float32, Int32, UInt8
from torch import Tensor

from normlift_ns.encoders.source import Encoder
from normlift_ns.encoders.texts.prompts import UNIT_TOLERANCE, check_prompts
from normlift_ns.encoders.weights import first_line
from normlift_ns.errors import InputError


@dataclass(frozen=True)
class Foreign:
    """An encoder of another package. The wrapped object needs only `identity`, `encode` and `text`; if it has
    `patches`, so does the adapter. Error messages name the encoder that failed.

    Raises (from every method):
        InputError: If the encoder fails, or returns something that `Encoder` does not allow.
    """

    name: str
    encoder: Encoder

    @classmethod
    def made(cls, name: str, make: Callable[[], Encoder]) -> Foreign:
        """Make an encoder, and check that it has the required attributes."""
        with _attribute_errors(name):
            encoder = make()
        missing = [x for x in ("identity", "encode", "text") if not hasattr(encoder, x)]
        if len(missing) > 0:
            raise InputError(f"encoder {name!r} of another package has no {' and no '.join(missing)}; fix that package")
        return Dense(name, encoder) if hasattr(encoder, "patches") else cls(name, encoder)

    @property
    def identity(self) -> dict[str, Any]:
        with _attribute_errors(self.name):
            return {"kind": self.name, **self.encoder.identity}

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        with _attribute_errors(self.name):
            rows = self.encoder.encode(image, labels)
        return self._check_rows(rows, int(labels.max()) + 1, "regions")

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        return (self.encode(image, labels) for image, labels in views)

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        check_prompts(prompts)
        with _attribute_errors(self.name):
            rows = self.encoder.text(prompts)
        return self._check_rows(rows, len(prompts), "texts")

    def _check_rows(self, rows: object, count: int, units: str) -> Float32[Tensor, "n d"]:
        """Return the rows as float32 on the CPU; raise InputError unless there are `count` of them, each of length
        1."""
        if not isinstance(rows, Tensor) or rows.ndim != 2 or len(rows) != count or not rows.is_floating_point():
            received = f"{rows.dtype} {tuple(rows.shape)}" if isinstance(rows, Tensor) else type(rows).__name__
            raise InputError(
                f"encoder {self.name!r} of another package returned {received} for {count} {units}, expected "
                f"floats [{count}, D]; fix that package"
            )
        rows = rows.detach().float().cpu()
        length = torch.linalg.vector_norm(rows, dim=1)
        if not bool(((length - 1).abs() < UNIT_TOLERANCE).all()):
            raise InputError(
                f"encoder {self.name!r} of another package returned vectors of {units} whose length is not 1 (such as "
                f"{float(length[(length - 1).abs().argmax()]):.3g}); normalize them"
            )
        return rows


@dataclass(frozen=True)
class Dense(Foreign):
    """An encoder of another package that also has features of patches."""

    @property
    def why_not_dense(self) -> str | None:
        return getattr(self.encoder, "why_not_dense", None)

    def patches(self, image: UInt8[Tensor, "h w 3"], rows: int, columns: int) -> Float32[Tensor, "r d"]:
        with _attribute_errors(self.name):
            features = self.encoder.patches(image, rows, columns)  # type: ignore[attr-defined]
        return self._check_rows(features, rows * columns, "patches")


@contextmanager
def _attribute_errors(name: str) -> Iterator[None]:
    """Attribute exceptions to the encoder of another package."""
    try:
        yield
    except (InputError, FileNotFoundError, MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:  # a third-party module may raise anything
        raise InputError(f"encoder {name!r} of another package failed ({first_line(error)})") from error
