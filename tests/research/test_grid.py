"""The grid: what its damages, features, regions and votes are, and that a run goes on where it stopped."""

import subprocess
import sys

import pytest
import torch

from benchmarks.ballots import _parts, voters_of
from benchmarks.candidates import Candidate
from benchmarks.damage import GROUP, LADDER, Damage, observe
from benchmarks.features import LENGTHS, as_features, mask_features, mixture_features, orthogonal_words
from benchmarks.grid import chunks, finished
from benchmarks.pieces import KINDS, blurred, label_map, observe_pieces, pieces, shares_of
from benchmarks.rows import RowsError, append, read_rows
from benchmarks.rule import cells_of
from benchmarks.second_room import second
from benchmarks.sites import Place
from benchmarks.worlds import World, made_words
from normlift_ns import RefineConfig, lift, nearest_neighbors
from normlift_ns.core.ablations import variant_source
from tests.research import ROOT, quick
from tests.research.tiny import CLASSES, WORDS
from tests.scenes import generator


@pytest.fixture(scope="module")
def room() -> World:
    return second(4000, views=10, width=160)


def test_a_group_shares_one_mask_and_an_arc_one_wrong_class(room):
    damages = Damage(noise=0.0), Damage(noise=0.0, grouped=0.4), Damage(noise=0.0, arc=0.4)
    plain, grouped, arc = (observe(room, made_words(16), damage, 0) for damage in damages)
    lost = plain.evidence.region_view.bincount() - grouped.evidence.region_view.bincount()
    struck = lost[lost > 0].tolist()
    assert len(struck) == 4 and all(GROUP[0] - 1 <= count <= GROUP[1] - 1 for count in struck)
    shown = (arc.features @ made_words(16).classes.T).argmax(1)[arc.columns[0].clamp(min=0)]
    wrong = (room.cells.mask >= 0) & (shown != room.cells.mask)
    assert bool(wrong.any())
    for c in range(16):  # the same wrong class in all views of two fifths of the azimuth
        here = wrong & (room.cells.mask == c)
        assert len(shown[here].unique()) <= 1 and len(room.cells.view[here].unique()) <= 4


def test_statistics_have_the_geometry_that_is_documented():
    expected = {"clip": (0.83, 0.64), "isotropic": (0.13, 0.10), "low contrast": (0.90, 0.85), "orthogonal": (0.26, 0)}
    k, masks = 12, torch.arange(12).repeat(40)
    mistakes = {}
    for name, lengths in LENGTHS.items():
        words = orthogonal_words(k) if name == "orthogonal" else made_words(k)
        given = (masks, torch.full_like(masks, -1), 0.0)
        rows = mask_features(words, *given, 1.2, lengths, generator(0)).view(40, k, -1)
        upper = torch.triu_indices(40, 40, 1).unbind()
        same = torch.einsum("vkd,wkd->vwk", rows, rows)[upper].mean()
        other = torch.einsum("vkd,wld->vwkl", rows, rows)[upper][:, ~torch.eye(k, dtype=torch.bool)].mean()
        assert (float(same), float(other)) == pytest.approx(expected[name], abs=0.015), name
        loud = mask_features(words, *given, 2.5, lengths, generator(0))
        mistakes[name] = float(((loud @ words.classes.T).argmax(1) != masks).float().mean())
    assert all(0.25 < share < 0.5 for share in mistakes.values()), mistakes


def test_histograms_are_square_roots_of_shares():
    sums = torch.zeros(1, 72)
    sums[0, [0, 5, 64, 70]] = torch.tensor([3.0, 1.0, 10.0, 30.0])
    expected = torch.zeros(72)
    expected[[0, 5, 64, 70]] = (torch.tensor([0.75, 0.25, 0.25, 0.75]) / 2).sqrt()
    assert torch.allclose(as_features(sums)[0], expected)


@pytest.mark.parametrize("kind", KINDS)
def test_pieces_show_what_is_in_them(room, kind):
    cut = pieces(room, kind, 64)
    assert len(cut.labels) == 10 and cut.evidence.num_regions == len(cut.content)
    assert torch.allclose(cut.content.sum(1), torch.ones(len(cut.content)), atol=1e-5)
    plain = observe_pieces(cut, made_words(16), Damage(noise=0.0), 0, LENGTHS["clip"])
    pure = cut.content[:, :16].max(1)
    share = (plain.features @ made_words(16).classes.T).argmax(1) == pure.indices
    assert float(share[pure.values > 0.9].float().mean()) == 1
    lost = observe_pieces(cut, made_words(16), Damage(dropped=0.5), 0)
    assert 0.4 < len(lost.features) / len(plain.features) < 0.6
    assert len(lost.features) == lost.evidence.num_regions
    few = observe_pieces(cut, made_words(16), Damage(views=3), 0)
    assert few.evidence.num_views == 3 and len(few.views) == 3
    expected = cut.evidence.select_views(few.views)
    assert torch.equal(few.evidence.rows.weight, expected.rows.weight)
    looked = observe_pieces(cut, cut.looks, Damage(wrong=0.3), 0)
    assert looked.features.shape == (len(cut.content), 72)


def test_patches_show_their_neighbours_too():
    labels = label_map("patches", torch.zeros(60, 80, 3, dtype=torch.uint8), 48)  # 6 rows of 8
    assert int(labels.max()) == 47 and labels[0, 0] == 0 and labels[-1, -1] == 47
    classes = (torch.arange(80) >= 40).long().expand(60, 80)
    shares = shares_of(labels, classes, 48, 2)
    assert shares[:, 0].view(6, 8)[0].tolist() == [1, 1, 1, 1, 0, 0, 0, 0]
    assert blurred(shares, (6, 8))[:, 0].view(6, 8)[2].tolist() == pytest.approx([1, 1, 1, 0.75, 0.25, 0, 0, 0])


def test_mixtures_are_between_their_classes():
    words = made_words(3)
    half = torch.tensor([[0.5, 0.5, 0, 0], [1.0, 0, 0, 0], [0, 0, 0, 1.0]])
    rows = mixture_features(words, half, 0.0, 0.0, LENGTHS["clip"], generator(0))
    cosine = rows @ words.classes.T
    assert float(cosine[0, 0]) == pytest.approx(float(cosine[0, 1]), abs=2e-2)
    assert cosine[0, 2] < cosine[0, :2].min() and cosine[1, 0] > cosine[0, 0]
    assert cosine[2].max() < cosine[1, 0]


def test_votes_are_those_of_refine(world):
    observed = observe(world, WORDS, LADDER["hard"], 0)
    lifted, neighbors = lift(observed.evidence, observed.features), nearest_neighbors(world.scene.means, 9)
    voters = voters_of(neighbors, world.truth, CLASSES)
    (part,) = _parts(lifted, voters, cosines=True)
    for name in ("plain_knn", "norm_only", "support_only", "paper", "posterior"):
        for delta in (0.0, 0.1):
            vote = "posterior" if name == "posterior" else "paper"
            config = RefineConfig(vote=vote, k=9, sigma_d=1.5, tau=0.95, gamma=0.4, delta=delta, prior=3.0)
            expected = variant_source(
                name, world.scene.means, lifted.directions, lifted.scalars, config, neighbors=neighbors
            )
            (source,) = part.sources([Candidate(name, sigma_d=1.5, delta=delta, prior=3.0)], 0.95, 0.4)
            assert torch.equal(source, expected[voters.group[:, 0]].long()), (name, delta)


def test_a_file_of_rows_is_gone_on_with(tmp_path):
    path, run = tmp_path / "some" / "rows.jsonl", {"seeds": [1, 2], "voters": None}
    assert finished(path, run) == {}
    cells = cells_of("demo")[:2]
    for cell in cells:
        append(path, {"cell": list(cell), "seconds": 1.0})
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"cell": ["demo", "masks", "cl')
    assert list(finished(path, run)) == cells and path.read_bytes() == whole  # the damaged last line is gone
    with pytest.raises(RowsError, match="another run"):
        read_rows(path, run | {"voters": 5})
    path.write_bytes(whole.replace(b'{"cell"', b"{cell", 1))
    with pytest.raises(RowsError, match="line 2 is no JSON"):
        read_rows(path, run)


def test_cells_of_one_place_stay_together():
    parts_of = list(chunks(cells_of("demo")))
    assert sum(map(len, parts_of)) == 299 and max(map(len, parts_of)) <= 50
    assert all(len({Place.of(cell) for cell in some}) == 1 for some in parts_of)
    assert Place("demo", "masks", floaters=True) in {Place.of(some[0]) for some in parts_of}


def test_quick_grid(tmp_path):
    flags = ("--rows", str(tmp_path / "rows.jsonl"))
    command = [sys.executable, "-m", "benchmarks.grid", "--quick", *flags, "--minutes", "0"]
    begun = subprocess.run([*command, "--output", tmp_path], cwd=ROOT, capture_output=True, text=True, check=False)
    assert begun.returncode == 1 and "no cell is done" in begun.stderr
    values = quick("grid", tmp_path, *flags)
    assert values["cells"]["value"] == 12 and any(key.startswith("decision.default.") for key in values)
    assert quick("grid", tmp_path, *flags) == values  # from the rows
