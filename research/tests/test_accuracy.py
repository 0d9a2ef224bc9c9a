"""The controlled benchmark: what damage is, that no damage is none, and that its shortcuts are exact."""

from dataclasses import replace

import pytest
import torch

from normlift_ns import RefineConfig, lift, nearest_neighbors, rasterize_evidence, refine_variant
from research import variants
from research.accuracy import Bench
from research.accuracy_report import METHODS, summarize
from research.damage import LADDER, STEPS, Damage, observe
from research.report import Report
from research.tests import quick
from research.tests.tiny import CLASSES, WORDS
from tests.random_scenes import dense


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
    report = Report("accuracy")
    summarize(rows, report)
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
