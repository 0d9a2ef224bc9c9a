"""Small worlds whose answers are known."""

from functools import cache

import numpy as np
import torch

from normlift_ns import Evidence, SemanticField, lift
from normlift_ns.core.evidence import Entries
from normlift_ns.errors import InputError
from normlift_ns.session.selection import SelectionContext

SIDE = 4
BLOCK = SIDE**3
"""Gaussians of one cube."""
WORDS = {"red": (1.0, 0.0, 0.0), "blue": (0.0, 1.0, 0.0), "green": (0.0, 0.0, 1.0)}


def cubes(side: int = SIDE) -> SelectionContext:
    """Four cubes of Gaussians in a row, 100 apart: red, blue, red, and one without a direction."""
    axis, block = torch.arange(side).float(), side**3
    cube = torch.cartesian_prod(axis, axis, axis)
    means = torch.cat([cube + torch.tensor([100.0 * i, 0, 0]) for i in range(4)])
    column = torch.tensor([1, 2, 1]).repeat_interleave(block)
    seen = Entries(torch.arange(3 * block), column, torch.ones(3 * block), (3,))
    again = Entries(torch.arange(block), torch.ones(block, dtype=torch.long), torch.ones(block), (3,))
    features = torch.cat([torch.eye(3), torch.eye(3)])
    evidence = Evidence.from_entries([seen, again], 4 * block)
    return SelectionContext(SemanticField.build(lift(evidence, features), means), means)


@cache
def world() -> SelectionContext:
    """The same for all tests that do nothing but ask."""
    return cubes()


def read(texts) -> np.ndarray:
    """Like `rows` of an encoder that knows three words."""
    for text in texts:
        if text not in WORDS:
            raise InputError(f"text {text!r} is unknown")
    return np.array([WORDS[text] for text in texts], np.float32)


def rows(*numbers: int) -> torch.Tensor:
    return torch.isin(torch.arange(4 * BLOCK) // BLOCK, torch.tensor(numbers))


def ray(gaussian: int) -> torch.Tensor:
    return torch.nn.functional.one_hot(torch.tensor(gaussian), 4 * BLOCK).float()
