"""What weight files of all networks have in common: their servers, and errors of foreign libraries as one line."""

from __future__ import annotations

import urllib.error
import urllib.request

_PROBE_SECONDS = 10
_LONGEST = 300


def first_line(error: Exception) -> str:
    """The beginning of a foreign error, for a message of ours."""
    lines = [line.strip() for line in str(error).strip().splitlines()]
    kept = lines[: 2 if len(lines) > 0 and lines[0].endswith(":") else 1]
    text = " ".join([f"{type(error).__name__}:", *kept]) if len(kept) > 0 else type(error).__name__
    return text if len(text) <= _LONGEST else text[:_LONGEST] + " ..."


def probe(address: str) -> None:
    """Raises OSError if a server does not answer: the hub's own client would retry for most of a minute."""
    try:
        urllib.request.urlopen(urllib.request.Request(address, method="HEAD"), timeout=_PROBE_SECONDS).close()
    except urllib.error.HTTPError:  # an answer
        pass
    except OSError as error:
        raise ConnectionError(f"{address} cannot be reached, {error}") from error
