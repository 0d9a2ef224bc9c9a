"""Model families: their identifiers in configurations, and their text preprocessing. Imports nothing heavy."""

from __future__ import annotations

import re
import string
from collections.abc import Callable
from dataclasses import dataclass

_PUNCTUATION = str.maketrans("", "", string.punctuation)


def _lowercase(text: str) -> str:
    """Convert to lower case, which SigLIP 2 was trained on. Not every tokenizer that is published with it does so."""
    return text.lower()


def _canonicalize(text: str) -> str:
    """Convert to lower case without punctuation, which SigLIP was trained on, like `SiglipTokenizer.canonicalize_text`.

    >>> _canonicalize("A red mug,  on the table!")
    'a red mug on the table'
    """
    return re.sub(r"\s+", " ", text.lower().translate(_PUNCTUATION)).strip()


def _unchanged(text: str) -> str:
    """Return the text unchanged, as MetaCLIP 2 expects it."""
    return text


@dataclass(frozen=True)
class Family:
    """Networks with the same training and preprocessing."""

    name: str
    """Value of `--encoder`."""
    title: str
    """Name in messages."""
    model_types: tuple[str, ...]
    """Values of "model_type" in config.json. Fixed-resolution SigLIP 2 models have the architecture of SigLIP and use
    its name."""
    default: str
    """Hub name of the default model."""
    read: Callable[[str], str]
    """Prepares a text for the tokenizer."""
    pad: str
    """Token that pads texts to full length, if the tokenizer's configuration names none."""
    tokenizers: tuple[str, ...]
    """Substrings of the class names of its tokenizers."""
    mean: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Mean of pixels in 0..1, if the configuration names none."""
    std: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Standard deviation of pixels in 0..1, if the configuration names none."""


FAMILIES = {
    family.name: family
    for family in (
        Family(
            "siglip", "SigLIP", ("siglip",), "google/siglip-base-patch16-224", _canonicalize, "</s>", ("Siglip", "T5")
        ),
        Family(
            "siglip2",
            "SigLIP 2",
            ("siglip", "siglip2"),
            "google/siglip2-base-patch16-224",
            _lowercase,
            "<pad>",
            ("Siglip2", "Gemma"),
        ),
        Family(
            "metaclip2",
            "MetaCLIP 2",
            ("metaclip_2",),
            "facebook/metaclip-2-worldwide-huge-quickgelu",
            _unchanged,
            "<pad>",
            ("XLMRoberta",),
            (0.48145466, 0.4578275, 0.40821073),
            (0.26862954, 0.26130258, 0.27577711),
        ),
    )
}
"""Families by name."""


def of_tokenizer(name: str) -> Family | None:
    """Return the family of a tokenizer class; None if it may belong to any family.

    >>> of_tokenizer("GemmaTokenizerFast").title, of_tokenizer("SiglipTokenizer").title
    ('SigLIP 2', 'SigLIP')
    """
    for family in (FAMILIES["siglip2"], FAMILIES["siglip"], FAMILIES["metaclip2"]):
        if any(part in name for part in family.tokenizers):
            return family
    return None
