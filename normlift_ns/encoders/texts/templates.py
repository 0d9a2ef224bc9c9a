"""Sentences that an encoder reads for a text."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from normlift_ns.errors import InputError

ENSEMBLE = "ensemble"
"""Name of open_clip's seven templates."""


def check_template(template: str) -> None:
    """Raises InputError for a template without a place for the text."""
    if template != ENSEMBLE and "{}" not in template:
        raise InputError(
            f"text template {template!r} has no {{}} where the text belongs; write it like "
            f'"a photo of a {{}}", or {ENSEMBLE} for the mean of several'
        )


def templates_of(template: str) -> Sequence[Callable[[str], str]]:
    """What is read for a text; its vector is the mean of theirs.

    >>> [make("mug") for make in templates_of("a {}, a big {}")]
    ['a mug, a big mug']
    """
    if template == ENSEMBLE:
        from normlift_ns.encoders.clip.architectures import open_clip_part  # noqa: PLC0415 (rarely needed)

        return open_clip_part("zero_shot_metadata").SIMPLE_IMAGENET_TEMPLATES
    return [lambda text: template.replace("{}", text)]
