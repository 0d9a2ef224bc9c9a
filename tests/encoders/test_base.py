"""The values and the protocol that features come in."""

import pytest
import torch

from normlift_ns.encoders.base import PatchFeatures, RegionFeatures, ViewFeatures, precomputed_features
from normlift_ns.encoders.cache import cached
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.encoders.plugins import PluginEncoder
from normlift_ns.segmentation.regions import Grid
from tests.encoders.tiny import refused

UNIT = torch.nn.functional.normalize(torch.arange(1.0, 7.0).reshape(2, 3), dim=1)


def test_view_features_accept_what_fits_and_refuse_the_rest():
    none = torch.zeros(2, 2, dtype=torch.int32)
    for labels, features, parts in (
        (none.float(), UNIT, ["labels", "torch.int32"]),
        (none.flatten(), UNIT, ["labels", "torch.int32"]),
        (none, UNIT.double(), ["features", "torch.float32"]),
        (none + 2, UNIT, ["-1..1", "number of cells: 2", "2..2"]),
        (none - 2, UNIT, ["-2..-2"]),
        (none, 2 * UNIT, ["2 of 2", "row 0 has length 2"]),
        (none, UNIT * torch.tensor([[1.0], [torch.nan]]), ["row 1 has length nan"]),
    ):
        refused(lambda given=(labels, features): ViewFeatures(*given), *parts)
    # Unlabelled pixels and regions without pixels fit
    view = ViewFeatures(torch.tensor([[-1, 0], [0, 0]], dtype=torch.int32), UNIT)
    assert view.features.shape == (2, 3)
    ViewFeatures(torch.full((4, 5), -1, dtype=torch.int32), torch.zeros(0, 3))
    labels = none.long()  # of one's own
    for pair, texts, name in (
        ((labels.to("meta"), UNIT), None, "labels of a"), ((labels, UNIT.to_sparse()), None, "vectors of a"),
        ((labels, UNIT[:, :0]), None, "vectors of a"), ((labels, UNIT), {"\ud800": UNIT[0]}, "not a valid prompt"),
    ):  # fmt: skip
        refused(lambda given=(pair, texts): precomputed_features([given[0]], given[1], ["a"]), name)
    # Regions of cells must have features
    labels = torch.tensor([[-1, 0], [1, 2]], dtype=torch.int32)
    view = ViewFeatures(labels, UNIT, torch.tensor([[1, -1, 0], [-1, -1, 1]], dtype=torch.int32))
    assert torch.equal(view.region_of_cell, view.regions)
    assert ViewFeatures(labels.clamp(max=1), UNIT).region_of_cell.tolist() == [[0, 1]]
    for regions, parts in (
        ([[0, 2, 1]], ["regions", "-1..1", "number of feature rows: 2", "0..2"]),
        ([[0, 1]], ["labels", "-1..1", "number of cells: 2", "-1..2"]),
        ([0, 1, 0], ["regions", "torch.int32"]),
    ):
        given = torch.tensor(regions, dtype=torch.int32)
        refused(lambda given=given: ViewFeatures(labels, UNIT, given), *parts)


class Blind:
    """An encoder without features of odd regions and patches."""

    identity, why_not_dense, calls = {"kind": "blind"}, None, 0

    def encode(self, image, labels):
        return self.patches(image, 1, int(labels.max()) + 1)

    def encode_each(self, views):
        return (self.encode(*view) for view in views)

    def patches(self, image, rows, columns):
        self.calls += 1
        return torch.eye(rows * columns) * (torch.arange(rows * columns) % 2 == 0)

    def text(self, prompts):
        return torch.zeros(len(prompts), 4)


@pytest.mark.parametrize("kind", ["regions", "patches"])
def test_regions_without_a_feature_are_unlabeled(kind, tmp_path):
    encoder, image = Blind(), torch.zeros(4, 4, 3, dtype=torch.uint8)
    plugin = PluginEncoder.made("blind", lambda: encoder)
    for source in (PatchFeatures(x, 4) if kind == "patches" else RegionFeatures(Grid(4), x) for x in (encoder, plugin)):
        encoder.calls = 0
        kept = cached(source, tmp_path / type(source.encoder).__name__)
        for view in (source.view(image, "a.png"), kept.view(image, "a.png"), kept.view(image, "a.png")):
            region = torch.cat([view.region_of_cell[0], torch.tensor([-1])])[view.labels.long()]
            assert region[::2, ::2].tolist() == [[0, -1], [1, -1]]
            assert torch.equal(view.features, torch.eye(4)[::2])
        assert encoder.calls == 2
    refused(lambda: plugin.text(["a"]), "'blind'", "expected 1")


def test_other_images_and_texts_are_refused():
    source = RegionFeatures(Grid(4), ColorEncoder())
    byte = torch.uint8
    for image in (torch.zeros(4, 5, 4, dtype=byte), torch.zeros(4, 5, 3), torch.zeros(0, 5, 3, dtype=byte)):
        refused(lambda image=image: source.view(image, "a/b.png"), "a/b.png", "uint8", "[H, W, 3]")
    refused(lambda: source.text(["red", " "]), "2 of 2")
