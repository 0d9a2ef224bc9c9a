"""Encoders of other packages, whose results are checked before they are used."""

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
    """An encoder of another package, which needs `identity`, `encode` and `text` only; it has `patches` where that one
    has. Its own errors are told as its own.

    Raises (from every method):
        InputError: what it returns is not what `Encoder` promises, or it fails.
    """

    name: str
    encoder: Encoder

    @classmethod
    def made(cls, name: str, make: Callable[[], Encoder]) -> Foreign:
        """Makes one, and checks that it has what is needed."""
        with _blamed(name):
            encoder = make()
        missing = [x for x in ("identity", "encode", "text") if not hasattr(encoder, x)]
        if len(missing) > 0:
            raise InputError(f"encoder {name!r} of another package has no {' and no '.join(missing)}; repair it")
        return Dense(name, encoder) if hasattr(encoder, "patches") else cls(name, encoder)

    @property
    def identity(self) -> dict[str, Any]:
        with _blamed(self.name):
            return {"kind": self.name, **self.encoder.identity}

    def encode(self, image: UInt8[Tensor, "h w 3"], labels: Int32[Tensor, "depth h w"]) -> Float32[Tensor, "r d"]:
        with _blamed(self.name):
            rows = self.encoder.encode(image, labels)
        return self._checked(rows, int(labels.max()) + 1, "region")

    def encode_each(
        self, views: Iterable[tuple[UInt8[Tensor, "h w 3"], Int32[Tensor, "depth h w"]]]
    ) -> Iterator[Float32[Tensor, "r d"]]:
        return (self.encode(image, labels) for image, labels in views)

    def text(self, prompts: Sequence[str]) -> Float32[Tensor, "q d"]:
        check_prompts(prompts)
        with _blamed(self.name):
            rows = self.encoder.text(prompts)
        return self._checked(rows, len(prompts), "text")

    def _checked(self, rows: object, count: int, what: str) -> Float32[Tensor, "n d"]:
        """The rows as float32 on the CPU: one per thing, each of length 1."""
        if not isinstance(rows, Tensor) or rows.ndim != 2 or len(rows) != count or not rows.is_floating_point():
            found = f"{rows.dtype} {tuple(rows.shape)}" if isinstance(rows, Tensor) else type(rows).__name__
            raise InputError(
                f"encoder {self.name!r} of another package gave {found} for {count} {what}s, expected floats "
                f"[{count}, D]; repair it"
            )
        rows = rows.detach().float().cpu()
        length = torch.linalg.vector_norm(rows, dim=1)
        if not bool(((length - 1).abs() < UNIT_TOLERANCE).all()):
            raise InputError(
                f"encoder {self.name!r} of another package gave {what}s vectors of other lengths than 1, such as "
                f"{float(length[(length - 1).abs().argmax()]):.3g}; normalise them"
            )
        return rows


@dataclass(frozen=True)
class Dense(Foreign):
    """One that has features of patches too."""

    @property
    def why_not_dense(self) -> str | None:
        return getattr(self.encoder, "why_not_dense", None)

    def patches(self, image: UInt8[Tensor, "h w 3"], rows: int, columns: int) -> Float32[Tensor, "r d"]:
        with _blamed(self.name):
            found = self.encoder.patches(image, rows, columns)  # type: ignore[attr-defined]
        return self._checked(found, rows * columns, "patch")


@contextmanager
def _blamed(name: str) -> Iterator[None]:
    """Errors within are those of another package, not of this program."""
    try:
        yield
    except (InputError, FileNotFoundError, MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:  # whatever a foreign module raises
        raise InputError(f"encoder {name!r} of another package failed ({first_line(error)})") from error
