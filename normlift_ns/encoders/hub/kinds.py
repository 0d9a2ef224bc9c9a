"""Registration of `--encoder siglip`, `siglip2` and `metaclip2`, without torch.

SigLIP is trained with a sigmoid. The match of a text and an image is sigmoid(scale * cosine + bias), with one scale > 0
and one bias for all pairs. Of two texts, the one with the larger cosine also has the larger sigmoid, whatever scale and
bias are. LERF's comparison with negatives therefore applies as with a softmax, and its tie, 0.5, is where the sigmoids
of text and negative are equal. That rule and that threshold are the defaults.

The sigmoid itself is not a suitable default. Its 0.5 stands for one right caption among the tens of thousands of a
batch, odds that crops of regions hardly ever reach.
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


def _has_patches(options: SourceOptions) -> bool:
    return True


def _make_kind(family: Family) -> EncoderKind:
    def make(options: SourceOptions, device: str) -> Encoder:
        from normlift_ns.encoders.hub.encoder import HubEncoder  # noqa: PLC0415 (needs torch)

        check_packages(family)
        return HubEncoder(family.name, model_of(options, family), options.crop_fill, device, options.text_template)

    check = partial(check_options, family=family)
    return EncoderKind(make, check=check, has_patches=_has_patches, paths=("encoder_model",))


SIGLIP, SIGLIP2, METACLIP2 = (_make_kind(FAMILIES[name]) for name in ("siglip", "siglip2", "metaclip2"))
