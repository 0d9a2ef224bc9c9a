import torch

from normlift_ns.objects import connected_components
from tests.scenes import generator


def blob(count: int, centre: tuple[float, float, float], seed: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=generator(seed)) + torch.tensor(centre)


def test_blobs_apart_are_objects_by_size():
    means = torch.cat([blob(60, (0, 0, 0), 0), blob(150, (5, 0, 0), 1), blob(20, (0, 9, 0), 2)])
    labels = connected_components(means, torch.ones(230, dtype=torch.bool))
    truth = torch.tensor([1] * 60 + [0] * 150 + [2] * 20)
    assert (labels == truth).float().mean() > 0.97
    assert torch.bincount(labels[labels >= 0]).diff().le(0).all()


def test_only_what_is_selected_connects():
    line = torch.arange(30)[:, None] * torch.tensor([[1.0, 0, 0]])
    selected = torch.ones(30, dtype=torch.bool)
    assert connected_components(line, selected).tolist() == [0] * 30
    selected[10:16] = False
    assert connected_components(line, selected).tolist() == [1] * 10 + [-1] * 6 + [0] * 14
    assert connected_components(line, selected, reach=8.0).tolist() == [0] * 10 + [-1] * 6 + [0] * 14


def test_scale_and_order_do_not_matter():
    means = torch.cat([blob(40, (0, 0, 0), 3), blob(80, (4, 0, 0), 4)])
    selected = torch.rand(120, generator=generator(5)) < 0.9
    labels = connected_components(means, selected)
    assert torch.equal(connected_components(1000 * means, selected), labels)
    order = torch.randperm(120, generator=generator(6))
    sizes, shuffled = (torch.bincount(x[x >= 0]) for x in (labels, connected_components(means[order], selected[order])))
    assert torch.equal(sizes, shuffled)


def test_nothing_one_and_the_same_place():
    means = torch.tensor([[0.0, 0, 0], [0, 0, 0], [torch.nan, 0, 0], [1, 1, 1]])
    none = torch.zeros(4, dtype=torch.bool)
    assert connected_components(means, none).tolist() == [-1] * 4
    assert connected_components(means, torch.tensor([False, False, True, True])).tolist() == [-1, -1, -1, 0]
    assert connected_components(means, torch.tensor([True, True, True, False])).tolist() == [0, 0, -1, -1]
