"""The controlled benchmark: what damage is, that no damage is none, and that its shortcuts are exact."""

import sys
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import normalize

from normlift_ns import RefineConfig, lift, nearest_neighbors, rasterize_evidence, refine_variant
from normlift_ns.evaluation.studies import variant_source
from research import variants
from research.accuracy import Bench
from research.accuracy_report import METHODS, summarize
from research.batched_votes import parts, voters_of
from research.candidates import Candidate
from research.damage import LADDER, STEPS, Damage, observe
from research.documents import read
from research.features import LENGTHS, mask_features, orthogonal_words
from research.geometry import Seen, geometry, spread
from research.real_features import FOX, NOISE, Regions, real_features
from research.report import RESULTS, Report
from research.synthetic_scenes import PARTS, made_words
from research.tests import ROOT, quick
from research.tests.tiny import CLASSES, WORDS
from tests.processes import run
from tests.random_scenes import dense, generator


def test_without_damage_cells_become_the_exact_masks(world):
    observed = observe(world, WORDS, Damage(noise=0.0), 0)
    direct = rasterize_evidence(world.scene, world.cameras, world.cells.maps.int(), num_regions=[CLASSES] * 6)
    assert torch.allclose(dense(observed.evidence.rows, 24), dense(direct.rows, 24), rtol=1e-5, atol=1e-6)
    assert torch.allclose(dense(observed.evidence.unlabeled, 6), dense(direct.unlabeled, 6), rtol=1e-5, atol=1e-6)
    rows = observed.features.view(6, CLASSES, -1)
    assert torch.equal(rows[0], rows[5])
    assert ((observed.features @ WORDS.classes.T).argmax(1) == torch.arange(CLASSES).repeat(6)).all()


def test_each_damage_does_what_its_name_says(world):
    def columns(**damage):
        return observe(world, WORDS, replace(Damage(), **damage), 3)

    plain = columns()
    assert len(plain.features) == 24
    assert len(columns(split=1.0).features) == 48
    assert len(columns(merged=1.0).features) < 24
    assert len(columns(dropped=0.5).features) < 24
    few = columns(views=2)
    assert (few.evidence.num_views, len(few.features)) == (2, 8)
    assert few.evidence.rows.weight.sum() < plain.evidence.rows.weight.sum()
    heavy = columns(dominant=64.0)
    assert heavy.evidence.rows.weight.sum() > 5 * plain.evidence.rows.weight.sum()
    assert torch.equal(heavy.columns, plain.columns)
    for moved in ("shifted", "pose"):
        assert 0.05 < float((columns(**{moved: 8.0}).columns != plain.columns).float().mean()) < 0.9
    assert 0.01 < float((columns(boundary=1.0).columns != plain.columns).float().mean()) < 0.4
    right = (columns(wrong=1.0).features @ WORDS.classes.T).argmax(1) == torch.arange(CLASSES).repeat(6)
    assert right.float().mean() < 0.3
    again, other = columns(wrong=0.5), observe(world, WORDS, Damage(wrong=0.5), 4)
    assert torch.equal(again.features, columns(wrong=0.5).features)
    assert not torch.equal(again.features, other.features)


def test_scores_of_variants_are_those_of_refined_directions(world):
    observed = observe(world, WORDS, LADDER["hard"], 0)
    lifted = lift(observed.evidence, observed.features)
    plain, config = variants.lifted_scores(lifted, WORDS.classes), RefineConfig(k=9)
    neighbors = nearest_neighbors(world.scene.means, 9)
    for variant in variants.VARIANTS:
        found = variants.refined_scores(variant, world.scene.means, lifted, plain, neighbors, config)
        expected = refine_variant(variant, world.scene.means, lifted, config, neighbors=neighbors)
        cosine = expected @ WORDS.classes.T
        scale = cosine.norm(dim=1, keepdim=True) / found.cosine.norm(dim=1, keepdim=True).clamp(min=1e-9)
        assert torch.allclose(found.cosine * scale, cosine, atol=2e-5)  # the arg-max does not see the length
        assert torch.equal(found.valid, (expected != 0).any(1))
        some = torch.arange(0, 300, 7)
        few = variants.refined_scores(variant, world.scene.means, lifted, plain, variants.only(neighbors, some), config)
        assert torch.equal(few.cosine[some], found.cosine[some])


def test_rows_and_their_summary(world):
    rows, damages = [], {name: (LADDER | STEPS)[name] for name in ("mild", "noise only", "arc")}
    bench = Bench(world, WORDS, None, "cpu", RefineConfig(k=9))
    for seed in range(2):
        for name, damage in (damages | {"mild, 3 views": replace(LADDER["mild"], views=3)}).items():
            found = bench.run(damage, seed, others=name in LADDER)
            rows.append({"scene": "tiny", "damage": name, "seed": seed, **found})
    summarize(rows, report := Report("accuracy"))
    values = {metric.key: metric.value for metric in report.metrics}
    ladder = [row for row in rows if row["damage"] in ("mild", "noise only")]
    three = [row for row in rows if row["damage"] == "mild, 3 views"]

    def mean(some: list, method: str, figure: str = "miou") -> float:
        return sum(row[method][figure] for row in some) / len(some)

    for method in METHODS:
        gains = [row[method]["miou"] - row["none"]["miou"] for row in ladder]
        expected = {
            f"ablation.{method}.miou": mean(ladder, method),
            f"undamaged.{method}.miou": mean([row for row in ladder if row["damage"] == "noise only"], method),
            f"views3.ablation.{method}.miou": mean(three, method),
            f"ablation.{method}.worst": min(gains),
            f"ablation.{method}.share_worse": sum(gain < -1 for gain in gains) / 4,
            f"ablation.{method}.copied": mean(ladder, method, "copied"),
        }
        assert {key: values[key] for key in expected} == pytest.approx(expected)
    assert values["ablation.none.copied"] == values["ablation.none.gain"] == 0 < values["ablation.paper.copied"]
    assert all(0 < values[f"baseline.{other}.miou"] <= 100 for other in ("sfs", "occam", "vala", "drsplat"))
    assert values["ablation.paper_minus_none.miou"] == pytest.approx(mean(ladder, "paper") - mean(ladder, "none"))
    assert values["preset.half.miou"] == pytest.approx(values["ablation.paper.miou"], abs=1)


def test_quick_accuracy_benchmark(tmp_path):
    values = {key: metric["value"] for key, metric in quick("accuracy", tmp_path).items()}
    assert values["ladder.few views.paper.miou"] > values["ladder.few views.none.miou"]
    assert values["ablation.paper.miou"] > values["ablation.norm_only.miou"]
    assert values["reliability.spearman_bins_mean"] > 0.7


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


def test_votes_are_those_of_refine(world):
    observed = observe(world, WORDS, LADDER["hard"], 0)
    lifted, neighbors = lift(observed.evidence, observed.features), nearest_neighbors(world.scene.means, 9)
    voters = voters_of(neighbors, world.truth, CLASSES)
    (part,) = parts(lifted, voters, cosines=True)
    for name in ("plain_knn", "norm_only", "support_only", "paper", "posterior"):
        for delta in (0.0, 0.1):
            vote = "posterior" if name == "posterior" else "paper"
            config = RefineConfig(vote=vote, k=9, sigma_d=1.5, tau=0.95, gamma=0.4, delta=delta, prior=3.0)
            expected = variant_source(
                name, world.scene.means, lifted.directions, lifted.scalars, config, neighbors=neighbors
            )
            (source,) = part.sources([Candidate(name, sigma_d=1.5, delta=delta, prior=3.0)], 0.95, 0.4)
            assert torch.equal(source, expected[voters.group[:, 0]].long()), (name, delta)


def test_quick_grid(tmp_path):
    flags = ("--rows", str(tmp_path / "rows.jsonl"))
    command = [sys.executable, "-m", "research.grid", "--quick", *flags, "--minutes", "0"]
    assert "no cell is finished" in run(*command, "--output", tmp_path, code=1, cwd=ROOT)
    values = quick("grid", tmp_path, *flags)
    assert values["cells"]["value"] == 12 and any(key.startswith("decision.default.") for key in values)
    assert quick("grid", tmp_path, *flags) == values  # from the rows


def test_real_features_have_the_cosines_of_the_fox():
    values = {key.removeprefix("fox."): x for key, x in read(RESULTS / "geometry.json").values.items()}
    paired = {"two_things": "two_things.two_views", "twoparts": "thing.two_views",
              "twoparts_one_view": "thing.one_view"}  # fmt: skip
    measured = {key: values[paired.get(key, key)] for key in vars(FOX)}
    assert measured == pytest.approx(vars(FOX), abs=5.1e-4, rel=2e-3)
    things, views, words = 12, 40, orthogonal_words(12)
    toward = normalize(torch.randn(views, 3, generator=generator(1)) + torch.tensor([0, 0, 1.5]), dim=1)
    view, thing, part = (x.flatten() for x in torch.meshgrid(*map(torch.arange, (views, things, PARTS)), indexing="ij"))
    angles = torch.rad2deg((toward @ toward.T).clamp(-1, 1).acos()).expand(things, -1, -1)
    regions = Regions(view, thing, part, torch.full_like(view, -1))
    features = real_features(words, regions, angles, 0.0, NOISE, generator(0))
    home = torch.arange(len(view)).view(views, -1).T  # of every part one Gaussian
    seen = Seen(home, features, toward.expand(len(home), -1, -1))
    made = geometry(seen, {str(k): torch.arange(k * PARTS, (k + 1) * PARTS) for k in range(things)}, generator(0))
    for key in (x for x in made if x.startswith(("drift.", "thing.", "two_things.two", "near", "far"))):
        assert made[key] == pytest.approx(values[key], abs=0.04), key
    cosines = (features @ words.classes.T).view(views, things * PARTS, things)
    own = cosines[:, torch.arange(things * PARTS), thing[: things * PARTS]]
    assert float(own.mean()) == pytest.approx(FOX.own, abs=0.02)
    lifted = normalize(features.view(views, -1, 512).mean(0), dim=1) @ words.classes.T
    assert spread(lifted[torch.arange(len(home)), thing[: len(home)]]) == pytest.approx(FOX.spread, abs=0.12)
    wrong = cosines.mean(0).view(things, PARTS, things).mean(1).fill_diagonal_(-1).amax(1)
    assert float(wrong.mean()) == pytest.approx(FOX.wrong, abs=0.04) and bool((wrong > 0.02).all())
