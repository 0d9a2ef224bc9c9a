"""Regions between learned edges."""

from hashlib import sha256
from itertools import pairwise

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import label

from normlift_ns.cli.preflight import check_source_options
from normlift_ns.encoders.build import make_source
from normlift_ns.encoders.cache import CachedRegions
from normlift_ns.encoders.weights import EDGES
from normlift_ns.options import SourceOptions
from normlift_ns.segmentation.edges import (
    ALGORITHM,
    EDGE_COUNTS,
    WORKING_PIXELS,
    EdgeNetwork,
    EdgeRegions,
    read_edge_weights,
    watershed_levels,
    working_size,
)
from tests.captures import capture, needs_shared
from tests.encoders.hed import edge_probability, keras_file, tiny_network
from tests.encoders.tiny import needs_cuda, noise, refused


def tiny_regions(**options) -> EdgeRegions:
    source = EdgeRegions(**options)
    vars(source)["network"] = tiny_network()
    return source


def assert_nested(maps: np.ndarray) -> None:
    """Every region of a level lies in one region of the next level, and none is empty."""
    for level in maps:
        assert np.unique(level).tolist() == list(range(level.max() + 1))
    for fine, coarse in pairwise(maps):
        assert len(np.unique(np.stack([fine, coarse]).reshape(2, -1), axis=1).T) == fine.max() + 1


@pytest.mark.parametrize("size", [(37, 50), (1, 1), (3, 40), (16, 32)])
def test_the_network_computes_what_keras_computes(size):
    content, network = keras_file(tiny_network()).getvalue(), EdgeNetwork((6, 7, 8, 9, 9))
    read_edge_weights(network, content)
    image = noise(*size)
    expected = edge_probability(content, image.numpy())
    assert 0.01 < expected.mean() < 0.99
    np.testing.assert_allclose(network(image).numpy(), expected, rtol=0, atol=2e-6)


def test_files_of_another_layout_are_refused():
    for name, values in (
        ("dsn2/vars/0", None),
        ("dsn2/vars/0", np.zeros((1, 1, 8, 1), np.float32)),
        ("dsn2/vars/1", np.zeros(1)),
        ("block3/layers/conv2d_1/vars/1", {}),
    ):
        content = keras_file(tiny_network())
        with h5py.File(content, "a") as file:
            del file[name]
            if values is not None:
                file.create_group(name) if isinstance(values, dict) else file.create_dataset(name, data=values)
        network = EdgeNetwork((6, 7, 8, 9, 9))
        refused(lambda n=network, c=content: read_edge_weights(n, c.getvalue()), name.split("/vars")[0], EDGES.command)
    refused(lambda: read_edge_weights(tiny_network(), b"\x89HDF\r\n\x1a\n"), EDGES.command)


def test_levels_of_walls_of_known_height():
    """Four rooms, each halved by a low wall, and a deep shaft of nine pixels in one of them."""
    edges = np.zeros((40, 40), np.uint8)
    edges[:, [9, 30]] = edges[[9, 30], :] = 40
    edges[20], edges[:, 20] = 200, 180
    edges[:5, :5] = 250
    edges[1:4, 1:4] = 0
    (all_basins, rooms, halves, whole) = watershed_levels(edges, (100, 4, 2, 1))
    assert (all_basins.max() + 1, rooms.max() + 1, halves.max() + 1, whole.max()) == (17, 4, 2, 0)
    assert_nested(np.stack([all_basins, rooms, halves, whole]))
    for level, count in ((rooms, 4), (halves, 2)):
        parts = [np.unique(level[y : y + 20, x : x + 20]) for y in (0, 21) for x in (0, 21)]
        assert all(len(part) == 1 for part in parts)
        assert len(np.unique(parts)) == count
    assert all_basins[2, 2] != all_basins[7, 7] and rooms[2, 2] == rooms[7, 7]


@given(arrays(np.uint8, st.tuples(st.integers(1, 30), st.integers(1, 30)), elements=st.integers(0, 4)))
def test_levels_nest_and_have_the_number_of_regions(edges):
    finest = int(watershed_levels(edges, (edges.size,)).max()) + 1
    counts = (finest + 3, finest, max(1, finest // 2), max(1, finest // 7), 1)
    maps = watershed_levels(edges, counts)
    assert [int(level.max()) + 1 for level in maps] == [min(count, finest) for count in counts]
    assert_nested(maps)
    assert all(label(level == i)[1] == 1 for level in maps for i in range(level.max() + 1))
    assert np.array_equal(maps, watershed_levels(edges, counts))


def test_regions_of_images_of_any_size():
    flat, large = torch.full((30, 50, 3), 90, dtype=torch.uint8), noise(65, 66)
    large = large.repeat_interleave(8, 0).repeat_interleave(8, 1)
    for image in (flat, flat[:1, :1], noise(1, 3000), noise(3000, 2), large):
        size = tuple(image.shape[:2])
        used = working_size(*size, WORKING_PIXELS)
        assert used == size or 0.99 < np.prod(used) / WORKING_PIXELS < 1.01
        labels = tiny_regions().labels(image, "a.png")
        assert labels.dtype == torch.int32 and labels.shape == (3, 1, *size)
        assert_nested(labels[:, 0].numpy())
    found = [int(level.max()) + 1 for level in labels]
    assert found == list(EDGE_COUNTS)
    few = tiny_regions(count=77).labels(image, "a.png")
    assert len(few) == 1 and int(few.max()) == 76


def test_options_choose_a_level_or_a_number(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def options(**more) -> SourceOptions:
        return SourceOptions(encoder="colour", regions="edges", **more)

    for more, chosen in (({}, (1,)), ({"level": "s"}, (0,)), ({"level": "l"}, (2,)), ({"region_count": 9}, ())):
        assert make_source(options(**more)).regions.chosen == chosen
    assert EdgeRegions().identity == EdgeRegions("l").identity != EdgeRegions(count=9).identity
    refused(lambda: make_source(options(level="default")), "s, m, l", "'default'")
    refused(lambda: make_source(options(level="s", region_count=9)), "--level s", "--region-count 9")
    for call in (lambda: check_source_options(options(), ()), lambda: EdgeRegions().labels(noise(3, 4), "a.png")):
        refused(call, str(tmp_path), "ns-normlift-weights --get edges", error=FileNotFoundError)


def test_regions_of_another_algorithm_are_not_reused(monkeypatch, tmp_path):
    """With integers in place of the network, which is compared with Keras above, regions repeat on every machine."""
    source, image = EdgeRegions(count=20), noise(9, 11).repeat_interleave(80, 0).repeat_interleave(80, 1)
    vars(source)["network"] = lambda x: (x.int() - x.roll((3, 5), (0, 1)).int()).abs().amax(dim=2) / 255
    kept = CachedRegions(source, tmp_path)
    labels = kept.labels(image, "a.png")
    digest = sha256(labels.numpy().tobytes()).hexdigest()[:16]
    assert (ALGORITHM, digest) == (2, "5c1926ec108e096b"), (
        "other regions need another number, which is part of the cache's key"
    )
    path = kept.path(image, "a.png")
    assert path.exists()
    monkeypatch.setattr("normlift_ns.segmentation.edges.ALGORITHM", ALGORITHM + 1)
    assert kept.path(image, "a.png") != path


@pytest.mark.slow
@needs_shared
@pytest.mark.usefixtures("trained_weights")
def test_trained_weights():
    image = capture("fox").train[0].image
    crop = image[300:396, 100:229]
    source = EdgeRegions()
    error = np.abs(source.network(crop).numpy() - edge_probability(EDGES.read(), crop.numpy())).max()
    assert error <= 1e-4
    labels = source.labels(image, "a.png")
    assert [int(level.max()) + 1 for level in labels] == list(EDGE_COUNTS)
    assert_nested(labels[:, 0].numpy())


@needs_cuda
def test_a_gpu_repeats_its_regions_which_are_nearly_those_of_the_cpu():
    image = noise(400, 300)
    here, there = tiny_regions(), tiny_regions(device="cuda")
    there.network.cuda()
    assert torch.equal(there.labels(image, ""), there.labels(image, ""))
    difference = np.abs(here.edges(image).astype(int) - there.edges(image))
    assert difference.max() <= 1 and (difference > 0).mean() < 0.01
