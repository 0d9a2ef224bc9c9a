"""Commands that run in several processes."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from normlift_ns.scripts.shared import CONSOLE, Terminated, say_error
from normlift_ns.team.launch import OURS, LostError, joined, told

if TYPE_CHECKING:
    from normlift_ns.core.portions import Team


@contextmanager
def in_team(device: str) -> Iterator[Team]:
    """Join the processes that this one was started with, if any; only the first process prints.

    Args:
        device: cpu, cuda or auto.
    """
    started_by_us = OURS in os.environ  # the process that started this one reports failures
    try:
        with joined(device, say_error) as team:
            if team.rank > 0:
                CONSOLE.quiet = True
                warnings.simplefilter("ignore")
            yield team
    except LostError as error:
        if not error.lost.failed:
            say_error(told(error.lost))
        sys.exit(1)
    except (KeyboardInterrupt, Terminated):
        if started_by_us:
            sys.exit(1)
        raise
