"""Prompt templates: the sentences that an encoder embeds for a text."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from normlift_ns.errors import InputError

ENSEMBLE = "ensemble"
"""Name of the set of open_clip's seven templates."""


def check_template(template: str) -> None:
    """Raise InputError if a template has no placeholder for the text."""
    if template != ENSEMBLE and "{}" not in template:
        raise InputError(
            f"text template {template!r} has no placeholder {{}} for the text; write it like "
            f'"a photo of a {{}}", or give {ENSEMBLE} for the mean of several templates'
        )


def templates_of(template: str) -> Sequence[Callable[[str], str]]:
    """Return the functions that fill the templates; the embedding of a text is the mean over them.

    >>> [make("mug") for make in templates_of("a {}, a big {}")]
    ['a mug, a big mug']
    """
    if template == ENSEMBLE:
        from normlift_ns.encoders.clip.architectures import open_clip_part  # noqa: PLC0415 (rarely needed)

        return open_clip_part("zero_shot_metadata").SIMPLE_IMAGENET_TEMPLATES
    return [lambda text: template.replace("{}", text)]
