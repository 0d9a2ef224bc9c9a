"""Thresholds and cleaning equal those of Splat Feature Solver's published code.

sfs_expectations.json holds what that code (metrics.py, the same in its four latest versions) answered on `maps` and
`shapes`: how many pixels it selects, and a digest of them; null where it fails.
"""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage

from normlift_ns.evaluation.lerf import prompt_mask
from normlift_ns.evaluation.sfs import clean_mask, histogram_threshold

CHANNELS = 9
"""Of the maps that SFS's code looks at: a prompt and eight background words, side by side in memory."""


def of_histogram(counts: list[int]) -> np.ndarray:
    """A map whose 40 bins between 0 and 1 have these counts; the ends are in it."""
    found = np.repeat((np.arange(40) + 0.5) / 40, np.array(counts) - np.eye(40, dtype=int)[[0, 39]].sum(0))
    return np.concatenate([[0.0, 1.0], found])[None]


def bins(**counts: int) -> list[int]:
    """Counts of 40 bins: bins(b3=700) has 700 in bin 3, and one in all others."""
    return [counts.get(f"b{i}", 1) for i in range(40)]


SHAPED = {
    "two peaks": bins(b5=900, b30=700, b20=0),
    "a plateau is two peaks": bins(b10=800, b11=800, b30=700),
    "fewer peaks than instances": bins(b8=2000, b12=0),
    "no valley to the left": [3000, 2000, *range(1900, 1862, -1)],
    "rising to the right": [*range(10, 790, 20), 801],
    "no peak": bins(b5=599, b30=599),
    "peak in the first bin": bins(b0=5000, b20=0),
    "peak in the last bin": bins(b39=5000, b38=0),
    "valley of equal bins": bins(b20=4000, b15=50),
    "all equal": [650] * 40,
    "two plateaus": [700] * 20 + [690] * 20,
}


def random_map(seed: int) -> np.ndarray:
    random = np.random.RandomState(seed)  # its numbers never change
    height, width = random.randint(1, 140, 2)
    kinds = (
        lambda: random.rand(height, width),
        lambda: random.randn(height, width) * 10 ** random.uniform(-2, 3) + 50 * random.randn(),
        lambda: random.rand(4)[random.randint(0, 4, (height, width))] + 0.02 * random.randn(height, width),
        lambda: np.round(random.rand(height, width) * random.randint(2, 50)) / 7,
        lambda: np.linspace(0, 1, height * width).reshape(height, width) ** random.uniform(0.2, 4),
        lambda: (random.rand(height, width) < 0.1 * random.rand()).astype(float),
        lambda: 0.3 + 1e-3 * random.rand(height, width),
        lambda: of_histogram((1 + random.randint(0, 1300, 40) * (random.rand(40) < 0.4)).tolist()),
    )
    return kinds[seed % len(kinds)]()


def maps() -> Iterator[tuple[str, np.ndarray]]:
    for name, counts in SHAPED.items():
        yield name, of_histogram(counts)
    for seed in range(48):
        yield f"random {seed}", random_map(seed)


def shapes() -> Iterator[tuple[str, np.ndarray]]:
    """Masks by name, of which most touch the border."""
    for seed in range(40):
        random = np.random.RandomState(seed)
        height, width = random.randint(1, 40, 2)
        mask = random.rand(height, width) < random.rand()
        if seed % 2 == 1:
            seeds = random.rand(height, width) < 0.1
            mask = np.asarray(ndimage.binary_dilation(seeds, structure=np.ones((3, 3)), iterations=1 + seed % 3))
        if seed % 5 == 0:
            mask[: 1 + seed % 4] = True
        yield f"mask {seed}", mask
    yield "two of one size", np.pad(np.kron(np.array([[0, 1], [1, 0]]), np.ones((6, 6))), 3).astype(bool)
    yield "all", np.ones((20, 30), dtype=bool)
    yield "ring at the border", np.pad(np.zeros((14, 14)), 5, constant_values=1).astype(bool)


def summary(mask: np.ndarray) -> list[object]:
    return [int(mask.sum()), hashlib.sha256(np.packbits(mask).tobytes()).hexdigest()[:16]]


def in_memory(values: np.ndarray) -> torch.Tensor:
    """[H, W], laid out as one of `CHANNELS` scores of every pixel."""
    every = torch.zeros(*values.shape, CHANNELS)
    every[:, :, 0] = torch.from_numpy(values).float()
    return every[:, :, 0]


def test_thresholds_and_cleaning_are_those_of_sfs():
    expected = json.loads(Path(__file__).with_name("sfs_expectations.json").read_text())
    names = []
    for name, values in maps():
        score = in_memory(values)
        for instances, selected in expected["thresholds"][name].items():
            found = prompt_mask(score, score[:, :, None][:, :, :0], "auto", margin=0, instances=int(instances))
            assert selected is None or summary(found.numpy()) == selected, (name, instances)
        names.append(name)
    assert names == list(expected["thresholds"])
    for name, mask in shapes():
        assert summary(clean_mask(torch.from_numpy(mask)).numpy()) == expected["cleaned"][name], name


def test_thresholds_by_hand():
    for counts, valley in (
        (SHAPED["two peaks"], 29),  # bins between the peaks are equal, the nearest one counts
        (bins(b38=700, b39=700, b10=0), 37),  # where the published code looks past the last bin
    ):
        threshold = histogram_threshold(in_memory(of_histogram(counts)), 1)
        assert threshold == pytest.approx((valley + 0.5) / 40, abs=1e-6)
    ones = np.zeros((20, 20))
    ones[:4] = 1.0  # Otsu: after the first bin, whose centre is 1 / 80; 80 % are 0
    assert histogram_threshold(in_memory(ones), 1) == pytest.approx((1 / 80 + 0) / 2, abs=1e-7)
    assert histogram_threshold(in_memory(0.3 + 1e-6 * ones), 1) == pytest.approx(0.3 + 2e-7, abs=5e-8)  # the mean
    assert 0 < histogram_threshold(torch.linspace(0, 1, 2**24 + 2)[None], 1) < 1  # torch takes no such quantiles
    for value, size in ((0.3, (1, 1)), (-0.7, (10, 10)), (0.0, (300, 301)), (1e-30, (10, 10))):
        score = torch.full(size, value)
        assert prompt_mask(score, score[..., None][..., :0], "auto", margin=0, instances=1).all(), (value, size)
