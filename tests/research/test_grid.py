"""The grid: what its damages, features, regions and votes are, and that a run goes on where it stopped."""

import subprocess
import sys

import pytest
import torch

from benchmarks.ballots import _parts, results, voters_of
from benchmarks.candidates import CANDIDATES, Candidate
from benchmarks.damage import GROUP, LADDER, STEPS, Damage, observe
from benchmarks.features import LENGTHS, as_features, mask_features, mixture_features, orthogonal_words, world_looks
from benchmarks.grid import QUICK, chunks, finished, run_cells
from benchmarks.grid_report import report_of
from benchmarks.pieces import KINDS, blurred, label_map, observe_pieces, pieces, shares_of
from benchmarks.rows import RowsError, append, read_rows
from benchmarks.rule import Cell, cells_of
from benchmarks.second_room import parts, second, walk
from benchmarks.sites import Place
from benchmarks.third_room import third, turns
from benchmarks.variants import lifted_scores, only, refined_scores
from benchmarks.worlds import World, made_words
from normlift_ns import RefineConfig, lift, nearest_neighbors
from normlift_ns.core.ablations import Variant, variant_source
from normlift_ns.core.metrics import classify
from tests.research import ROOT, quick
from tests.research.tiny import CLASSES, WORDS
from tests.scenes import generator

PINNED = {
    "noise only": (24, 4335172, 0.97888, 3397.190),
    "mild": (22, 3596355, -3.87753, 3168.727),
    "merged masks": (15, 2071634, -0.48616, 2760.616),
    "split masks": (33, 5005464, -2.77079, 2672.476),
    "shifted masks": (22, 3537593, -4.48879, 3039.818),
    "dominant view": (20, 2919573, 6.05680, 27594.662),
    "pose noise": (19, 2933120, 0.94737, 3057.612),
    "hard": (17, 1999422, -2.06203, 2467.121),
}


@pytest.fixture(scope="module")
def room() -> World:
    return second(4000, views=10, width=160)


def test_the_steps_of_version_0_1_keep_their_numbers(world):
    """Masks, a checksum of their cells, sums of features and of weights."""
    for step, expected in PINNED.items():
        observed = observe(world, WORDS, LADDER[step], list(LADDER).index(step))
        columns = observed.columns.double()
        checksum = int((columns * (torch.arange(1, columns.numel() + 1).double() % 97)).sum())
        sums = float(observed.features[:, :7].double().sum()), float(observed.evidence.rows.weight.double().sum())
        assert (len(observed.features), checksum, *sums) == pytest.approx(expected, rel=1e-4, abs=2e-4), step


def test_a_group_shares_one_mask_in_some_views(room):
    plain = observe(room, made_words(16), Damage(noise=0.0), 0)
    grouped = observe(room, made_words(16), Damage(noise=0.0, grouped=0.4), 0)
    lost = []
    for view in range(10):
        before, after = (int((o.evidence.region_view == view).sum()) for o in (plain, grouped))
        lost.append(before - after)
    struck = [count for count in lost if count > 0]
    assert len(struck) == 4 and all(GROUP[0] - 1 <= count <= GROUP[1] - 1 for count in struck)
    # the cells of a group share the feature of its largest member, and no other cell changes
    was, now = (o.features[o.columns[0].clamp(min=0)] @ made_words(16).classes.T for o in (plain, grouped))
    labelled = plain.columns[0] >= 0
    moved = (was.argmax(1) != now.argmax(1)) & labelled
    assert set(room.cells.view[moved].tolist()) == {v for v, count in enumerate(lost) if count > 0}
    for view in range(10):
        here = moved & (room.cells.view == view)
        if bool(here.any()):
            assert len(now.argmax(1)[here].unique()) == 1


def test_an_arc_has_one_wrong_class_per_object_over_two_fifths_of_the_azimuth(room):
    words = made_words(16)
    observed = observe(room, words, Damage(noise=0.0, arc=0.4), 0)
    shown = (observed.features @ words.classes.T).argmax(1)[observed.columns[0].clamp(min=0)]
    rank, cells = room.azimuth_rank, room.cells
    assert all(sorted(column.tolist()) == list(range(10)) for column in rank.T)
    for c in range(16):
        views = {int(v) for v in cells.view[cells.mask == c].unique()}
        wrong = {int(v) for v in cells.view[(cells.mask == c) & (shown != c)].unique()}
        assert len(shown[(cells.mask == c) & (shown != c)].unique()) <= 1  # the same wrong class in all of them
        places = sorted(int(rank[v, c]) for v in wrong)
        assert len(places) <= 4
        # neighbours by azimuth, but for views that do not show the object
        seen = [int(rank[v, c]) for v in views]
        assert not places or any({(start + i) % 10 for i in range(4)} & set(seen) == set(places) for start in range(10))
    assert {int(v) for v in cells.view[(cells.mask >= 0) & (shown != cells.mask)].unique()}


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


def test_histograms_tell_classes_apart_and_follow_the_damaged_masks(room):
    looks = world_looks(room)
    exact = observe(room, looks, Damage(noise=0.0), 0)
    present = exact.evidence.region_view.shape[0]
    shown = (exact.features @ looks.classes.T).argmax(1)
    classes = [int(room.cells.mask[exact.columns[0] == s][0]) for s in range(present)]
    assert float((shown == torch.tensor(classes)).float().mean()) > 0.8
    assert torch.allclose(exact.features.norm(dim=1), torch.ones(present), atol=1e-5)
    merged = observe(room, looks, Damage(noise=0.0, merged=1.0), 0)
    assert float((merged.features @ looks.classes.T).amax(1).mean()) < float(
        (exact.features @ looks.classes.T).amax(1).mean()
    )
    wrong = observe(room, looks, Damage(noise=0.0, wrong=1.0), 0)
    right = (wrong.features @ looks.classes.T).argmax(1) == torch.tensor(classes)
    assert float(right.float().mean()) < 0.35
    again = observe(room, looks, STEPS["hard"], 7)
    assert torch.equal(again.features, observe(room, looks, STEPS["hard"], 7).features)


def test_histograms_are_square_roots_of_shares():
    sums = torch.zeros(1, 72)
    sums[0, [0, 5, 64, 70]] = torch.tensor([3.0, 1.0, 10.0, 30.0])
    expected = torch.zeros(72)
    expected[[0, 5, 64, 70]] = (torch.tensor([0.75, 0.25, 0.25, 0.75]) / 2).sqrt()
    assert torch.allclose(as_features(sums)[0], expected)


def test_rooms_are_others_and_as_they_were_when_the_rule_was_written(room):
    third_room = third(6000, views=10, width=160)
    for found, gaussians, classes in ((room, 4000, 16), (third_room, 6000, 20)):
        assert (len(found.scene), found.classes, len(found.cameras), len(found.held_out)) == (gaussians, classes, 10, 5)
        assert set(found.truth.unique().tolist()) == set(range(-1, classes)) and bool(found.scene.drawable.all())
        assert int((found.cells.maps[..., None] == torch.arange(classes)).flatten(0, 2).any(0).sum()) == classes
    assert len(parts()) == 16 and int((room.truth < 0).sum()) == 120
    walked, turned = (
        torch.stack([camera.world_to_camera.double().inverse()[:3, 3] for camera in path]) for path in (walk(), turns())
    )
    assert walked[7].tolist() == pytest.approx([0.1986, 0.1559, 0.9904], abs=1e-3)
    assert turned.unique(dim=0).shape[0] <= 30 and turned[1].tolist() == pytest.approx([1.5, -1.4, 1.35], abs=1e-3)


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


def test_results_are_those_of_the_variants(world):
    observed = observe(world, WORDS, STEPS["arc"], 0)
    lifted, neighbors = lift(observed.evidence, observed.features), nearest_neighbors(world.scene.means, 9)
    voters = voters_of(neighbors, world.truth, CLASSES)
    found = results([Candidate(), Candidate("linear"), Candidate("paper")], lifted, voters, WORDS.classes)
    plain, counted = lifted_scores(lifted, WORDS.classes), voters.group[:, 0]
    config = RefineConfig(vote="paper", k=9, sigma_d=1.0, tau=0.95, gamma=0.4, delta=0.0)
    names: tuple[Variant, ...] = ("none", "linear", "paper")
    for name in names:
        scores = refined_scores(name, world.scene.means, lifted, plain, only(neighbors, counted), config)
        answer = classify(scores.cosine, scores.valid)[counted]
        truth = world.truth[counted]
        ious = [
            float(((answer == c) & (truth == c)).sum() / ((answer == c) | (truth == c)).sum()) for c in range(CLASSES)
        ]
        assert found[name].miou == pytest.approx(100 * sum(ious) / CLASSES, abs=1e-3)
    assert found["none"].copied == 0 == found["linear"].copied and 0.5 < found["paper"].copied <= 1


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


def test_a_run_skips_what_is_done_and_ends_in_a_report(tmp_path):
    path = tmp_path / "rows.jsonl"
    cells = [
        Cell("second", "masks", "clip", "group", "3"), Cell("second", "masks", "clip", "noise only", "all"),
        Cell("second", "superpixels", "histogram", "mild", "3"),
    ]  # fmt: skip
    read_rows(path, {})
    assert run_cells(cells[:1], QUICK, (0, 1), path, 0.0) == 0  # past the deadline
    assert finished(path, {}) == {}
    assert run_cells(cells[:2], QUICK, (0, 1), path, float("inf")) == 2
    assert run_cells(cells[2:], QUICK, (0, 1), path, float("inf")) == 1
    rows, names = finished(path, {}), [one.name for one in CANDIDATES]
    assert list(rows) == cells
    for row in rows.values():
        assert list(row["miou"]) == names == list(row["copied"]) and row["voters"] == 80
        assert all(len(values) == 2 and 0 <= min(values) <= max(values) <= 100 for values in row["miou"].values())
    moved = {cell._replace(scene="demo"): row for cell, row in rows.items()}
    report = report_of(rows | moved, names, 6, {"voters": 80})
    values = {metric.key: metric for metric in report.metrics}
    assert values["cells"].value == 6 and values["decision.confirmed"].value in (0, 1)
    gain = values["choice.paper.mean"].value - values["choice.none.mean"].value
    assert values["choice.paper.gain"].value == pytest.approx(gain)
    undamaged = rows[cells[1]]["miou"]
    assert values["second.paper.undamaged"].value == pytest.approx(
        sum(undamaged["none"]) / 2 - sum(undamaged["paper"]) / 2
    )
    assert values["column.kind.superpixels.paper.gain"].value == pytest.approx(
        sum(rows[cells[2]]["miou"]["paper"]) / 2 - sum(rows[cells[2]]["miou"]["none"]) / 2
    )


def test_quick_grid(tmp_path):
    flags = ("--rows", str(tmp_path / "rows.jsonl"))
    command = [sys.executable, "-m", "benchmarks.grid", "--quick", *flags, "--minutes", "0"]
    begun = subprocess.run([*command, "--output", tmp_path], cwd=ROOT, capture_output=True, text=True, check=False)
    assert begun.returncode == 1 and "no cell is done" in begun.stderr
    values = quick("grid", tmp_path, *flags)
    assert values["cells"]["value"] == 12 and any(key.startswith("decision.default.") for key in values)
    assert quick("grid", tmp_path, *flags) == values  # from the rows
