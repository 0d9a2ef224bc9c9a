"""Objects without prompts: parts that images agree about, with boxes and names, in Python and on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from PIL import Image

from normlift_ns import Evidence, open_run
from normlift_ns.analysis.inventory import Inventory, best_words, find_inventory
from normlift_ns.cli import query
from normlift_ns.core.evidence import Entries
from tests.cli.conftest import run_entry, said

SIDE, VIEWS = 24, 12


def scene_of_blocks(*, seam: int, cosine: float, swap: bool = False) -> torch.Tensor:
    """Return the inventory of a plane whose left half is an object and whose right half another.

    Every image divides the right half once more: at a random line, or at the middle with probability `seam` / 100.

    Args:
        cosine: of the features of the two regions in the right half.
        swap: list the images in the opposite order.
    """
    x, y = (part.flatten() for part in torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij"))
    generator, parts = torch.Generator().manual_seed(0), []
    means = torch.stack([x, y, torch.zeros_like(x)], dim=1) + 0.01 * torch.rand(len(x), 3, generator=generator)
    for _ in range(VIEWS):
        line, draw = (int(torch.randint(*ends, (), generator=generator)) for ends in ((2, SIDE - 2), (0, 100)))
        line = SIDE // 2 if draw < seam else line
        column = torch.where(x < SIDE // 2, 1, torch.where(y < line, 2, 3))
        parts.append(Entries(torch.arange(len(x)), column, torch.ones(len(x)), (3,)))
    rows = torch.tensor([[0, 0, 1.0], [1, 0, 0], [cosine, (1 - cosine**2) ** 0.5, 0]])
    order = list(reversed(range(VIEWS))) if swap else list(range(VIEWS))
    evidence = Evidence.from_entries([parts[view] for view in order], len(x))
    return find_inventory(evidence, rows.repeat(VIEWS, 1), means, spread=0.2).view(SIDE, SIDE)


@pytest.mark.parametrize(("seam", "cosine", "objects"), [(0, 0.3, 2), (100, 0.3, 3), (100, 0.9, 2)])
def test_parts_are_divided_where_images_agree(seam: int, cosine: float, objects: int) -> None:
    """Random borders vanish, borders that stay divide, unless the features agree."""
    found = scene_of_blocks(seam=seam, cosine=cosine)
    assert int(found.max()) == objects
    assert not set(found[: SIDE // 2].unique().tolist()) & set(found[SIDE // 2 :].unique().tolist())
    assert torch.equal(found, scene_of_blocks(seam=seam, cosine=cosine))
    again = scene_of_blocks(seam=seam, cosine=cosine, swap=True)
    assert len(torch.stack([found.flatten(), again.flatten()]).unique(dim=1).T) == objects  # the same parts


def test_nothing_is_listed_without_evidence() -> None:
    none = torch.zeros(0, dtype=torch.int64)
    nothing = Evidence.from_entries([Entries(none, none, torch.zeros(0), (0,))], 30)
    assert find_inventory(nothing, torch.zeros(0, 4), torch.eye(30)[:, :3], 0.2).tolist() == [0] * 30


def test_a_name_must_stand_out_from_those_that_are_best_by_chance() -> None:
    generator = torch.Generator().manual_seed(0)
    words, scene = (torch.nn.functional.normalize(torch.randn(n, 64, generator=generator), dim=1) for n in (400, 500))
    scene = torch.nn.functional.normalize(scene + words[7], dim=1)  # a word that is near to everything
    things = torch.stack([scene[:9].mean(0), words[3] + 0.5 * words[7], scene[0]]).double()
    assert best_words(things, scene, words, by_chance=0.25, count=400) == [None, 3, None]
    assert best_words(things, scene, words, by_chance=float("inf"), count=400)[:2] == [7, 3]
    assert best_words(things, scene, words, by_chance=0.25, count=9) == [None, 3, None]  # the others only compared with
    assert best_words(things, scene, words, by_chance=0.25, count=3) == [None] * 3


@pytest.fixture(scope="module")
def inventory(lifted: Path) -> Inventory:
    return open_run(lifted).inventory(["black", "yellow", "red"])


def test_things_of_a_room_are_listed_with_boxes_and_names(inventory: Inventory, lifted: Path) -> None:
    names = [item.text for item in inventory.catalog.objects]
    assert 2 <= len(inventory) <= 20
    assert all(name in ("red", "yellow", f"object {number}") for number, name in enumerate(names, 1))
    red = open_run(lifted).ask("red")["red"].mask
    best = max(range(1, len(inventory) + 1), key=lambda number: int((inventory.mask(number) & red).sum()))
    assert int((inventory.mask(best) & red).sum()) > 0.7 * int((inventory.mask(best) | red).sum())
    assert names[best - 1] == "red"
    assert 0 < max(inventory.catalog.objects[best - 1].capture.box.size) < 2


@pytest.mark.slow
def test_command_writes_a_list_and_a_picture(inventory, lifted, tmp_path, monkeypatch, capsys) -> None:
    words, picture, table = tmp_path / "words.txt", tmp_path / "room.png", tmp_path / "room.json"
    words.write_text("black\n\n yellow \nred\n", encoding="utf8")
    flags = ("--load-config", lifted, "--inventory", "--vocabulary", words, "--image", picture, "--output-json", table)
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 0
    listed = json.loads(table.read_text())["objects"]
    assert [row["text"] for row in listed] == [item.text for item in inventory.catalog.objects]
    assert [row["gaussians"] for row in listed] == [int(inventory.mask(row["id"]).sum()) for row in listed]
    with Image.open(picture) as image:
        assert image.size == (160, 120)
    assert run_entry(monkeypatch, query.entrypoint, *flags) == 1
    assert "exists" in said(capsys)
    words.write_text("fork\nred\nknife\n", encoding="utf8")
    assert run_entry(monkeypatch, query.entrypoint, *flags, "--overwrite", True) == 1
    assert "(2 of 3); remove or replace: fork, knife" in said(capsys)
