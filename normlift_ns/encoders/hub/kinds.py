"""`--encoder siglip`, `siglip2` and `metaclip2`: what is known of them before torch is loaded.

SigLIP is trained with a sigmoid: what a text and an image have in common is sigmoid(scale * cosine + bias), with one
scale > 0 and one bias for all. Of two texts the one of larger cosine has the larger sigmoid too, whatever scale and
bias are; so LERF's comparison with negatives applies as it does to a softmax, and its draw, 0.5, is where the sigmoids
of text and negative are equal. That rule and that threshold are the defaults. The sigmoid itself is no default: its 0.5
is the odds of one right caption among the tens of thousands of a batch, which hardly any crop of a region reaches.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from normlift_ns.encoders.hub.families import FAMILIES, Family
from normlift_ns.encoders.hub.places import check_options, check_packages, model_of
from normlift_ns.encoders.kinds import EncoderKind
from normlift_ns.options import SourceOptions

if TYPE_CHECKING:
    from normlift_ns.encoders.source import Encoder


def _always(options: SourceOptions) -> bool:
    return True


def _kind(family: Family) -> EncoderKind:
    def make(options: SourceOptions, device: str) -> Encoder:
        from normlift_ns.encoders.hub.encoder import HubEncoder  # noqa: PLC0415 (needs torch)

        check_packages(family)
        return HubEncoder(family.name, model_of(options, family), options.crop_fill, device, options.text_template)

    check = partial(check_options, family=family)
    return EncoderKind(make, check=check, has_patches=_always, paths=("encoder_model",))


SIGLIP, SIGLIP2, METACLIP2 = (_kind(FAMILIES[name]) for name in ("siglip", "siglip2", "metaclip2"))
