"""Greeting of a page, and links that store a query and a camera."""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Mapping
from typing import Annotated

import msgspec
import numpy as np
import torch

from normlift_ns.core.gaussians import Camera, facing_pose
from normlift_ns.errors import InputError
from normlift_ns.query.question import join_prompts
from normlift_ns.session.state import State

MAX_LINK_LENGTH = 6000
"""Maximum number of characters in a link; many web servers reject request lines longer than 8 KB."""
Finite = Annotated[float, msgspec.Meta(ge=-1e30, le=1e30)]
Vector = tuple[Finite, Finite, Finite]
Side = Annotated[int, msgspec.Meta(ge=1, le=16384)]


class PageView(msgspec.Struct, frozen=True):
    """Camera of a page, in scene units."""

    position: Vector
    look_at: Vector
    up: Vector
    fov: Annotated[float, msgspec.Meta(gt=0, lt=3.14)]
    """Vertical field of view in radians."""
    width: Side = 1280
    height: Side = 800

    @property
    def is_valid(self) -> bool:
        """True if `look_at` differs from `position`, and `up` is neither zero nor parallel to the viewing direction."""
        ahead = np.subtract(self.look_at, self.position)
        return bool(np.linalg.norm(np.cross(ahead, self.up)) > 0)

    def camera(self, max_size: int) -> Camera:
        """Return this camera with at most `max_size` pixels along its longer side."""
        scale = min(1.0, max_size / max(self.width, self.height))
        width, height = (max(1, round(scale * side)) for side in (self.width, self.height))
        focal = height / 2 / math.tan(self.fov / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float32)
        points = (torch.tensor(x, dtype=torch.float64) for x in (self.position, self.look_at, self.up))
        return Camera(K, facing_pose(*points).float(), width, height)


class Link(msgspec.Struct, frozen=True, omit_defaults=True):
    """Content of a link: a query, a color mode and a camera."""

    prompts: str = ""
    clicks: dict[str, Annotated[int, msgspec.Meta(ge=0)]] = {}
    """Indices of clicked Gaussians, by the prompt texts that stand for the clicks."""
    threshold: Finite | None = None
    """Threshold that the user chose, or that of a query of clicks alone; None for the default."""
    min_reliability: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    look: str = "overlay"
    """Color mode."""
    view: PageView | None = None


class Greeting(msgspec.Struct, frozen=True):
    """First message of a page."""

    token: Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
    """Random text stored in the browser tab; it identifies the session after a reload."""
    link: Annotated[str, msgspec.Meta(max_length=MAX_LINK_LENGTH)] = ""
    """Query string of the page's URL, with or without the question mark."""
    access: Annotated[str, msgspec.Meta(max_length=200)] = ""
    """Access token for writing; see `app.ServerOptions`."""


def link_of(state: State, clicks: Mapping[str, int], view: PageView | None) -> Link:
    """Return the link to a state and a camera.

    Args:
        clicks: Indices of clicked Gaussians, by the prompt texts that stand for the clicks.
    """
    query = state.query
    if query is None:
        return Link(view=view, look=state.color_mode)
    asked = {name: gaussian for name, gaussian in clicks.items() if name in query.texts}
    threshold = None if query.gated else query.threshold
    return Link(join_prompts(query.texts), asked, threshold, query.min_reliability, state.color_mode, view)


def write_link(link: Link) -> str:
    """Encode a link as the query string of a URL.

    Raises:
        ValueError: The link is too long.

    >>> read_link(write_link(Link("red, blue"))).prompts
    'red, blue'
    """
    text = "q=" + base64.urlsafe_b64encode(msgspec.json.encode(link)).decode().rstrip("=")
    if len(text) > MAX_LINK_LENGTH:
        raise InputError(
            f"The link has {len(text):,} characters; the maximum is {MAX_LINK_LENGTH:,}. Use fewer or shorter prompts."
        )
    return text


def read_link(query: str) -> Link | None:
    """Decode the link in the query string of a URL; return None if it has no link.

    Raises:
        ValueError: The link is truncated or damaged.
    """
    text = next((part[2:] for part in query.removeprefix("?").split("&") if part.startswith("q=")), None)
    if text is None:
        return None
    try:
        return msgspec.json.decode(base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)), type=Link)
    except (binascii.Error, ValueError, RecursionError) as error:
        raise InputError(f"The link of this page cannot be read ({error}). Copy the whole link again.") from error
