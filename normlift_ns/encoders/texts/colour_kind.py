"""Registration of `--encoder colour`, without torch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from normlift_ns.encoders.kinds import EncoderKind
from normlift_ns.options import SourceOptions

if TYPE_CHECKING:
    from normlift_ns.encoders.source import Encoder
    from normlift_ns.encoders.texts.colours import ColourTexts


def _make_color_encoder(options: SourceOptions, device: str) -> Encoder:
    from normlift_ns.encoders.colour import ColourEncoder  # noqa: PLC0415 (needs torch)

    _make_color_texts(options, device, None, {})
    return ColourEncoder()


def _make_color_texts(
    options: SourceOptions, device: str, cache: Path | None, recorded: Mapping[str, Any]
) -> ColourTexts:
    from normlift_ns.encoders.texts.colours import ColourTexts, refuse_template  # noqa: PLC0415 (needs numpy)

    refuse_template(options.text_template)
    return ColourTexts()


COLOUR = EncoderKind(_make_color_encoder, rule="cosine", negatives=(), texts=_make_color_texts, learned=False)
"""Mean colors compared with color names: a neighboring shade has a cosine of 0.9, another color less than 0.5."""
