"""What a link carries: the question and the camera, as the query of an address."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from typing import Annotated, Literal

import msgspec
import numpy as np

from normlift_ns.errors import InputError
from normlift_ns.session.prompts import join_prompts
from normlift_ns.session.state import State

_LONGEST = 6000
"""Characters; a server refuses lines of 8 KB."""
Finite = Annotated[float, msgspec.Meta(ge=-1e30, le=1e30)]
Place = tuple[Finite, Finite, Finite]


class View(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A camera, in the scene's own units."""

    position: Place
    look_at: Place
    up: Place
    fov: Annotated[float, msgspec.Meta(gt=0, lt=3.14)]

    @property
    def looks(self) -> bool:
        """Whether it looks anywhere: not at where it is, and not along its vertical."""
        ahead = np.subtract(self.look_at, self.position)
        return bool(np.linalg.norm(np.cross(ahead, self.up)) > 0)


class Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A question and a camera."""

    prompts: str = ""
    clicks: dict[str, Annotated[int, msgspec.Meta(ge=0)]] = {}
    """The clicks among the prompts, by the Gaussians that were clicked."""
    threshold: Finite | None = None
    min_reliability: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    look: str = "overlay"
    view: View | None = None


class Hello(msgspec.Struct, frozen=True):
    """What the page says when it opens, and again when a key is pressed or let go that clicks go by."""

    token: Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
    link: Annotated[str, msgspec.Meta(max_length=_LONGEST)] = ""
    webgl: bool = True
    held: Literal["", "Add", "Take away"] = ""
    """What the key does that is held down."""


def link_of(state: State, clicks: Mapping[str, int], view: View) -> Link:
    """A link to what a person sees.

    Args:
        clicks: Gaussians that were clicked, by the names of the prompts.
    """
    question = state.question
    if question is None:
        return Link(view=view, look=state.look)
    asked = {name: gaussian for name, gaussian in clicks.items() if name in question.texts}
    line = join_prompts(question.texts)
    return Link(line, asked, question.threshold, question.min_reliability, state.look, view)


def write_link(link: Link) -> str:
    """As the query of an address.

    Raises:
        ValueError: a question that is too long for an address.

    >>> read_link(write_link(Link("red, blue"))).prompts
    'red, blue'
    """
    found = "q=" + base64.urlsafe_b64encode(msgspec.json.encode(link)).decode().rstrip("=")
    if len(found) > _LONGEST:
        raise InputError(
            f"These prompts make a link of {len(found):,} characters; browsers and servers take {_LONGEST:,}."
        )
    return found


def read_link(query: str) -> Link | None:
    """The inverse of `write_link`; None for a query that is no link of ours.

    Raises:
        ValueError: a link that is cut off or damaged.
    """
    if not query.startswith("q="):
        return None
    text = query.removeprefix("q=")
    try:
        return msgspec.json.decode(base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)), type=Link)
    except (binascii.Error, ValueError, RecursionError) as error:
        raise InputError(f"The link of this page cannot be read ({error}); copy it again.") from error


def read_hello(text: str) -> Hello:
    """What the page says when it opens.

    Raises:
        ValueError: something else.
    """
    try:
        return msgspec.json.decode(text, type=Hello)
    except (ValueError, RecursionError) as error:
        raise InputError(f"the page says {text[:80]!r}, which is no greeting: {error}") from error
