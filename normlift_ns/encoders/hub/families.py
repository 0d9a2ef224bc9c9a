"""Families of networks: what their folders say of themselves, and what they read for a text. Imports nothing heavy."""

from __future__ import annotations

import re
import string
from collections.abc import Callable
from dataclasses import dataclass

_PUNCTUATION = str.maketrans("", "", string.punctuation)


def lower(text: str) -> str:
    """SigLIP 2 was trained on lower case; not every tokenizer that is published with it sees to that."""
    return text.lower()


def canonical(text: str) -> str:
    """SigLIP was trained on lower case without punctuation, as `SiglipTokenizer.canonicalize_text` makes it.

    >>> canonical("A red mug,  on the table!")
    'a red mug on the table'
    """
    return re.sub(r"\s+", " ", text.lower().translate(_PUNCTUATION)).strip()


def bare(text: str) -> str:
    """MetaCLIP 2 reads texts as they are."""
    return text


@dataclass(frozen=True)
class Family:
    """Networks that are trained alike."""

    name: str
    """That `--encoder` takes."""
    title: str
    model_types: tuple[str, ...]
    """What config.json may call them. SigLIP 2 of fixed resolution has the architecture of SigLIP, and says so."""
    default: str
    """Name on the hub."""
    read: Callable[[str], str]
    """What the tokenizer gets for a text."""
    pad: str
    """Token that fills a text up to its full length, where the tokenizer's configuration names none."""
    tokenizers: tuple[str, ...]
    """What the names of its tokenizers contain."""
    mean: tuple[float, float, float] = (0.5, 0.5, 0.5)
    std: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Of pixels in 0..1, where the configuration names none."""


FAMILIES = {
    family.name: family
    for family in (
        Family("siglip", "SigLIP", ("siglip",), "google/siglip-base-patch16-224", canonical, "</s>", ("Siglip", "T5")),
        Family(
            "siglip2",
            "SigLIP 2",
            ("siglip", "siglip2"),
            "google/siglip2-base-patch16-224",
            lower,
            "<pad>",
            ("Siglip2", "Gemma"),
        ),
        Family(
            "metaclip2",
            "MetaCLIP 2",
            ("metaclip_2",),
            "facebook/metaclip-2-worldwide-huge-quickgelu",
            bare,
            "<pad>",
            ("XLMRoberta",),
            (0.48145466, 0.4578275, 0.40821073),
            (0.26862954, 0.26130258, 0.27577711),
        ),
    )
}
"""By their names."""


def of_tokenizer(name: str) -> Family | None:
    """The family that a tokenizer belongs to; None: any.

    >>> of_tokenizer("GemmaTokenizerFast").title, of_tokenizer("SiglipTokenizer").title
    ('SigLIP 2', 'SigLIP')
    """
    for family in (FAMILIES["siglip2"], FAMILIES["siglip"], FAMILIES["metaclip2"]):
        if any(part in name for part in family.tokenizers):
            return family
    return None
