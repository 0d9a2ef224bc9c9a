"""Cells and regions of images that are cut in several ways."""

import numpy as np
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from normlift_ns.encoders.base import RegionFeatures, joint_partition
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.segmentation.regions import LabelFiles
from tests.encoders.tiny import noise, refused

SHAPES = st.tuples(st.integers(1, 5), st.integers(1, 6), st.integers(1, 6))


@given(arrays(np.int32, SHAPES, elements=st.integers(-1, 3)))
@example(np.array([[[-1, 0, 2]], [[-1, 3, -1]]], np.int32))
def test_cells_are_the_sets_of_pixels_with_the_same_labels(values):
    maps = torch.from_numpy(values)
    cells, regions = joint_partition(maps)
    present = cells[cells >= 0].unique()
    assert present.tolist() == list(range(regions.shape[1]))
    assert torch.equal(cells == -1, (maps == -1).all(dim=0))
    labelled = cells >= 0
    assert torch.equal(regions[:, cells[labelled].long()], maps[:, labelled])
    assert regions.unique(dim=1).shape == regions.shape  # no two cells have the same labels
    ids = np.unique(values[0][values[0] >= 0])  # the cells of one level are its regions
    labels = torch.from_numpy(np.where(values[0] >= 0, np.searchsorted(ids, values[0]), -1).astype(np.int32))
    cells, regions = joint_partition(labels[None])
    assert torch.equal(cells, labels)
    assert regions.tolist() == [list(range(len(ids)))]


def test_many_levels_of_many_regions_do_not_overflow():
    """Ten levels of 40,000 regions: 10**46 possible tuples."""
    maps = torch.stack([torch.randperm(40_000, generator=torch.Generator().manual_seed(i)) for i in range(10)]).int()
    maps = maps.reshape(10, 200, 200)
    cells, regions = joint_partition(maps)
    assert torch.equal(regions[:, cells.long()], maps)


def test_every_level_has_the_same_cells_and_its_own_features(tmp_path):
    steps = np.repeat([[1], [1], [0], [2]], 4, 1)
    np.save(tmp_path / "a.npy", np.stack([np.repeat([[1, 1, 2, 2]], 4, 0), steps, np.zeros((4, 4), int)]))
    image = noise(4, 4)
    views = [RegionFeatures(LabelFiles(tmp_path, level=i), ColorEncoder()).view(image, "a.jpg") for i in range(3)]
    assert all(torch.equal(view.labels, views[0].labels) for view in views)
    for level, view in enumerate(views):
        alone = LabelFiles(tmp_path).labels(image, "a.jpg")[level]
        assert torch.equal(view.region_of_cell[0, view.labels.long()], alone[0])
        assert torch.equal(view.features, ColorEncoder().encode(image, alone))
    assert views[2].features.shape[0] == 0
    for wrong in (None, 3):
        source = RegionFeatures(LabelFiles(tmp_path, level=wrong), ColorEncoder())
        refused(lambda source=source: source.view(image, "a.jpg"), "a.npy", "levels 0..2", "--level")
    two = type("Two", (LabelFiles,), {"chosen": (1, 0)})
    (zero, one, _), view = views, RegionFeatures(two(tmp_path), ColorEncoder()).view(image, "a.jpg")
    assert torch.equal(view.features, torch.cat([one.features, zero.features]))
    offset = torch.where(zero.regions >= 0, zero.regions + len(one.features), -1)
    assert torch.equal(view.regions, torch.cat([one.regions, offset]))
