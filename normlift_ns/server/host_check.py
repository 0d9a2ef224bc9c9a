"""Check of the Host and Origin headers of a request, which blocks pages of other sites.

Browsers do not let a page forge these headers: Origin names the site of the page, and Host the requested server. The
check therefore also detects foreign names that resolve to this machine (DNS rebinding).
"""

from __future__ import annotations

import contextlib
import ipaddress
import re
import socket
from collections.abc import Sequence

from normlift_ns.errors import InputError
from normlift_ns.options import short_repr

_AUTHORITY = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9_](?:[a-z0-9._-]*[a-z0-9_])?)\.?(?::([0-9]{1,5}))?", re.ASCII)
_PORTS = {"http": 80, "https": 443}
_LOCAL = {"localhost", "127.0.0.1", "::1"}


def accepted_names(host: str, allowed_hosts: Sequence[str] = ()) -> frozenset[str]:
    """Return the host names that a server accepts; "" stands for all addresses of this machine.

    Args:
        host: Address that the server listens on.
        allowed_hosts: Additional names, such as the name of a proxy.
    Raises:
        ValueError: An entry of `allowed_hosts` is not a host name or address.

    >>> sorted(accepted_names("192.168.0.7", ["Splats.example.org"]))
    ['127.0.0.1', '192.168.0.7', '::1', 'localhost', 'splats.example.org']
    """
    names = _LOCAL | {_plain(host) or host.lower()}
    for text in allowed_hosts:
        name = _plain(text)
        if name is None:
            raise InputError(
                f"--allowed-hosts must be host names or addresses, such as splats.example.org, without http:// "
                f"and without a port; got {short_repr(text)}"
            )
        names.add(name)
    if host in ("", "0.0.0.0", "::"):
        own = socket.gethostname().lower()
        names |= {"", own, f"{own.partition('.')[0]}.local", socket.getfqdn().lower()}
    return frozenset(names)


def refuse_request(hosts: Sequence[str], origins: Sequence[str], names: frozenset[str]) -> str | None:
    """Return the reason to reject a request; None if the server accepts it.

    Args:
        hosts: Values of the Host headers.
        origins: Values of the Origin headers, which only browsers send.
        names: Result of `accepted_names`.

    >>> names = accepted_names("127.0.0.1")
    >>> refuse_request(["localhost:8000"], ["http://localhost:8000"], names)
    >>> refuse_request(["localhost:7008"], ["https://example.org"], names)
    'A page with the origin https://example.org may not use the server at localhost:7008.'
    """
    host = _authority(hosts[0]) if len(hosts) == 1 else None
    if host is None:
        return "The request must have exactly one Host header, with the name or address of this machine."
    if host[0] not in names and not ("" in names and _is_own_address(host[0])):
        return (
            f"This server does not accept the host name {host[0]}. If the name is yours, start the server with "
            f"--allowed-hosts {host[0]}."
        )
    if len(origins) == 0:
        return None
    scheme, _, place = origins[0].partition("://")
    page, default = _authority(place), _PORTS.get(scheme)
    if len(origins) > 1 or page is None or default is None or (page[1] or default, page[0]) != (
        host[1] or default, host[0],
    ):  # fmt: skip
        return f"A page with the origin {short_repr(origins[0])[1:-1]} may not use the server at {hosts[0]}."
    return None


def _authority(text: str) -> tuple[str, int | None] | None:
    """Return the name, in lower case, and the port of a Host header; None if the header is malformed."""
    match = _AUTHORITY.fullmatch(text.lower())
    if match is None:
        return None
    name, port = match[1], None if match[2] is None else int(match[2])
    if name.startswith("["):
        try:
            name = str(ipaddress.IPv6Address(name[1:-1]))
        except ValueError:
            return None
    return name, port


def _plain(text: str) -> str | None:
    """Return a host name in the form that `_authority` returns; None if it is malformed or includes a port."""
    found = _authority(f"[{text}]" if ":" in text and not text.startswith("[") else text)
    return None if found is None or found[1] is not None else found[0]


def _is_own_address(name: str) -> bool:
    """Return True if `name` is an IP address of this machine, which a socket can bind to."""
    with contextlib.suppress(OSError, ValueError):
        address = ipaddress.ip_address(name)
        family = socket.AF_INET if address.version == 4 else socket.AF_INET6
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind((name, 0))
            return True
    return False
