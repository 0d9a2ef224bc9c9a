"""Ideas of other methods on a run's own features, against dense sums over pixels in float64."""

import json
from collections.abc import Iterable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns import Camera, InputError, LiftOptions, RasterSettings, SourceOptions, rasterize_evidence
from normlift_ns.encoders.build import make_source, source_settings
from normlift_ns.evaluation import baselines
from normlift_ns.evaluation.options import Evaluation
from normlift_ns.evaluation.protocols import EvaluatedRun
from normlift_ns.evaluation.studies import study_ablation, study_timing, voting_scalars
from normlift_ns.evidence_collection import cells_to_regions
from normlift_ns.pipeline import lift_scene
from normlift_ns.rasterization.rasterize import RasterJob
from tests.random_scenes import Photographs, dense, generator, made_scene, orbit, random_scene

N, VIEWS, HEIGHT, WIDTH = 300, 5, 35, 40
OPTIONS = SourceOptions(encoder="color", regions="grid", region_count=12)
PLAIN = LiftOptions(refine=False, max_views=4, consensus=False, consensus_min_agreement=0.0)  # cells count as things


@pytest.fixture(scope="module")
def lifted(tmp_path_factory) -> EvaluatedRun:
    """A lifted run of a scene made by hand, whose photographs are masked in part."""
    folder = tmp_path_factory.mktemp("cache")
    masks = [torch.arange(HEIGHT)[:, None].expand(HEIGHT, WIDTH) >= 3 * i for i in range(VIEWS)]
    photographs = Photographs([f"{i}.png" for i in range(VIEWS)], orbit(VIEWS), masks=masks)
    scene = made_scene(random_scene(N, dtype=torch.float32, size=0.3), photographs)
    found = lift_scene(scene, make_source(OPTIONS), PLAIN, folder, encoder={}).field
    manifest = json.loads(json.dumps({**found.manifest, "source": source_settings(OPTIONS)}))  # as on disk
    return EvaluatedRun(scene, replace(found, manifest=manifest), make_source(OPTIONS), False, folder)


def observations(lifted: EvaluatedRun) -> list[tuple[Camera, Tensor, Tensor]]:
    """Per view: the camera, A [N, P] in float64, and the feature of every pixel [P, D], 0 without a region."""
    found = []
    pixels = torch.arange(HEIGHT * WIDTH, dtype=torch.int32).view(HEIGHT, WIDTH)
    for block in baselines.lifted_batches(lifted, "cpu"):
        for camera, features in zip(block.cameras, baselines.feature_maps(block, "cpu")):
            weights = rasterize_evidence(lifted.scene.gaussians, [camera], [pixels]).rows
            found.append((camera, dense(weights, HEIGHT * WIDTH).double(), features.flatten(0, 1).double()))
    return found


def sfs(seen: list[tuple[Camera, Tensor, Tensor]], means: Tensor) -> Tensor:
    return normalize(sum(weights**2 @ features for _, weights, features in seen))


def occam(seen: list[tuple[Camera, Tensor, Tensor]], means: Tensor) -> Tensor:
    total = torch.zeros(N, seen[0][2].shape[1], dtype=torch.float64)
    for camera, weights, features in seen:
        weight = weights @ (features != 0).any(1).double()
        for j, mean in enumerate(means.double()):
            pose = camera.world_to_camera.double()
            x, y, z = (camera.K.double() @ (pose[:3, :3] @ mean + pose[:3, 3])).tolist()
            if z > 0 and 0 <= x / z < WIDTH and 0 <= y / z < HEIGHT:
                total[j] += weight[j] * features[int(y / z) * WIDTH + int(x / z)]
    return normalize(total)


def drsplat(seen: list[tuple[Camera, Tensor, Tensor]], means: Tensor) -> Tensor:
    total = 0
    for _, weights, features in seen:
        kept = weights * (weights >= weights.topk(baselines.TOP, dim=0).values[-1])
        total = total + kept @ features
    return normalize(total)


def vala(seen: list[tuple[Camera, Tensor, Tensor]], means: Tensor) -> Tensor:
    u = torch.zeros(N, seen[0][2].shape[1], dtype=torch.float64)
    some = [(features != 0).any(1) for *_, features in seen]
    labelled = [(weights[:, i], features[i]) for (_, weights, features), i in zip(seen, some)]
    for j in range(0, N, 4):  # the rest would take a second
        views = [(weights[j], features) for weights, features in labelled]
        most = max(float(weight.sum()) for weight, _ in views)
        used = [
            (weight, features) for weight, features in views if weight.sum() >= baselines.VISIBLE * most and most > 0
        ]
        if len(used) == 0:
            continue
        weight, features = (torch.cat(part) for part in zip(*used))
        u[j] = normalize(weight @ features, dim=0)
        for _ in range(10):
            far = (1 - features @ u[j]).clamp(min=1e-4)
            u[j] = normalize((weight / far) @ features, dim=0)
    return u


@pytest.mark.slow
def test_ideas_are_their_sums_over_pixels(lifted, monkeypatch):
    monkeypatch.setattr("normlift_ns.evaluation.baselines._BLOCK", 60)
    seen, methods = observations(lifted), (sfs, occam, vala, drsplat)
    every = list(map(id, lifted.scene.train.cameras))
    assert [every.index(id(camera)) for camera, *_ in seen] == [0, 1, 3, 4]  # those of the lift
    few = [camera for block in baselines.lifted_batches(lifted, "cpu", max_views=2) for camera in block.cameras]
    assert [every.index(id(camera)) for camera in few] == [0, 4]
    assert {method.__name__ for method in methods} == set(baselines.BASELINES)
    for method in methods:
        field = baselines.baseline_field(method.__name__, lifted, "cpu")
        expected = method(seen, lifted.scene.gaussians.means)
        valid = field.valid(refined=False)
        if method is vala:
            valid &= torch.arange(N) % 4 == 0
        assert torch.equal(valid, (expected != 0).any(1))
        assert valid.sum() > 50
        cosine = (field.directions(refined=False).double() * expected).sum(1)[valid]
        # One pixel's arithmetic may fall to the other side of a border between regions.
        assert (cosine > 1 - 1e-5).float().mean() > 0.95, method
        plain = lifted.field.directions(refined=False).double()
        assert ((plain * expected).sum(1)[valid] < 1 - 1e-4).float().mean() > 0.1, method  # another method


def changed(lifted: EvaluatedRun, **facts: Any) -> EvaluatedRun:
    return replace(lifted, field=replace(lifted.field, manifest={**lifted.field.manifest, **facts}))


def test_features_that_cannot_be_made_again_are_refused(lifted):
    for change, message in (
        ({"source": None}, "does not record"),
        ({"source": {"wings": 2}}, "wings"),
        ({"source": [1]}, "found a list"),
        ({"source": {"encoder": 3}}, "encoder"),
        ({"features": {"kind": "other"}}, '{"kind": "other"}'),
    ):
        with pytest.raises(InputError, match=message):
            baselines.baseline_field("sfs", changed(lifted, **change), "cpu")


@pytest.mark.parametrize("power", [0.0, 2.0])
def test_runs_are_lifted_again_with_consensus_and_without(lifted, power):
    options = replace(PLAIN, consensus=True, consensus_power=power, consensus_sample=9)
    found = lift_scene(lifted.scene, lifted.texts, options, lifted.cache, encoder={}).field
    manifest = {**found.manifest, "source": lifted.field.manifest["source"]}
    agreed = replace(lifted, field=replace(found, manifest=json.loads(json.dumps(manifest))))
    assert baselines.with_consensus(lifted, False, "cpu") is lifted
    assert baselines.with_consensus(agreed, True, "cpu") is agreed
    plain = baselines.with_consensus(agreed, False, "cpu")
    assert not plain.refined and plain.field.manifest["options"]["consensus"] is False
    pairs = ((plain.field, lifted.field), (baselines.with_consensus(plain, True, "cpu").field, agreed.field))
    for ours, theirs in pairs:
        assert torch.allclose(ours.directions(refined=False), theirs.directions(refined=False), atol=2e-3)
        for name in ("norm", "n_eff", "weight"):
            a, b = getattr(ours.scalars, name), getattr(theirs.scalars, name)
            assert torch.allclose(a, b, rtol=1e-4, atol=1e-5), name
        assert torch.equal(ours.valid(refined=False), theirs.valid(refined=False))
    assert torch.allclose(pairs[1][0].scalars.reliability, agreed.field.scalars.reliability, atol=1e-5)
    assert torch.allclose(voting_scalars(agreed.field).norm, lifted.field.scalars.norm, atol=1e-5)
    assert (agreed.field.scalars.norm - lifted.field.scalars.norm).mean() > 0.001


@pytest.mark.slow
def test_the_ablation_has_every_variant_whichever_way_a_run_was_lifted(lifted):
    """A run with consensus, and one without it, give the same rows; what cannot be made again is left out, and said."""

    def evaluate(runs: Iterable[EvaluatedRun]) -> Evaluation:
        (run,) = runs
        cosine = (run.field.directions(refined=run.refined) * run.field.directions(refined=False)).sum(1)
        return Evaluation({"cosine": float(cosine.mean()), "norm": float(run.field.scalars.norm.mean())}, [], {})

    told = []
    rows = study_ablation([lifted], evaluate, "cpu", told.append)
    names = ["none", "plain_knn", "linear", "norm_only", "support_only", "paper", "posterior"]
    agreed = ["consensus", "consensus_paper", "consensus_posterior"]
    assert [row["variant"] for row in rows] == [*names, *agreed]
    assert told == []
    other = baselines.with_consensus(lifted, True, "cpu")
    again = study_ablation([other], evaluate, "cpu", told.append)
    assert [row["variant"] for row in again] == [row["variant"] for row in rows]
    for ours, theirs in zip(again, rows):
        assert ours["cosine"] == pytest.approx(theirs["cosine"], abs=0.02)
        assert ours["norm"] == pytest.approx(theirs["norm"], abs=1e-5)
    own = changed(lifted, source=None)
    assert [row["variant"] for row in study_ablation([own], evaluate, "cpu", told.append)] == names
    assert len(told) == 1 and "consensus" in told[0]


def test_lengths_of_pixels_are_those_of_composited_features(lifted, monkeypatch):
    monkeypatch.setattr("normlift_ns.evaluation.protocols._CHANNELS", 5)
    camera, weights, _ = observations(lifted)[1]
    norm = lifted.field.scalars.norm[:, None]
    for more, factor in (((), 1.0), ((norm,), norm)):
        features = weights.T @ (lifted.field.directions(refined=False) * factor).double()
        (length,) = lifted.feature_lengths([camera], *more)
        assert torch.allclose(length.flatten(), torch.linalg.vector_norm(features, dim=1), atol=1e-3)


needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: gsplat cannot run")


@needs_gpu
def test_channels_through_gsplat_are_the_sums_of_evidence_and_are_timed(lifted):
    from tests.rasterization.test_gpu import compiled_gsplat  # noqa: PLC0415

    if not compiled_gsplat():
        pytest.skip("gsplat's compiled part is missing")
    scene = lifted.scene.gaussians.to("cuda")
    job = RasterJob(scene, False, RasterSettings(), torch.float32)
    for block in baselines.lifted_batches(lifted, "cuda"):
        found = baselines.dense_sums(
            job, block.cameras, baselines.feature_maps(block, "cuda"), block.features[0].shape[1]
        )
        counts = [regions.shape[1] for regions in block.regions]
        cells = rasterize_evidence(scene, block.cameras, block.labels, num_regions=counts)
        expected = cells_to_regions(cells, block).rows.matmul(torch.cat(block.features).cuda())
        assert torch.allclose(found, expected.float(), rtol=1e-3, atol=1e-3 * float(expected.abs().max()))
    (row,) = study_timing([lifted], "cuda")
    assert row["timed_views"] == 4
    assert row["dense512_over_evidence_lift"] == pytest.approx(row["dense512_s"] / row["evidence_lift_s"])
    assert row["dense512_all_views_s"] == row["dense512_s"] > 0  # all four


@needs_gpu
def test_ideas_are_the_same_on_a_gpu(lifted):
    for name in baselines.BASELINES:
        here, there = (baselines.baseline_field(name, lifted, device) for device in ("cpu", "cuda"))
        cosine = (here.directions(refined=False) * there.directions(refined=False)).sum(1)
        assert (cosine[here.valid(refined=False)] > 1 - 1e-3).float().mean() > 0.98
        assert (here.valid(refined=False) == there.valid(refined=False)).float().mean() > 0.99


def test_what_is_left_out_is_said(lifted):
    told = []
    (row,) = study_timing([lifted], "cpu", told.append)
    assert "dense512_s" not in row
    assert row["total_s"] == pytest.approx(sum(value for key, value in row.items() if key.endswith("_s")) / 2)
    assert len(told) == 1 and baselines.timing_obstacle(lifted, "cpu") in told[0] and "--device cuda" in told[0]
    cost = {key: value for key, value in lifted.field.manifest["cost"].items() if key != "store_s"}
    older = changed(lifted, cost=cost)
    table = study_timing([lifted, older], "cpu")
    assert [row["scene"] for row in table] == ["made", "made", "mean"]
    assert table[2]["store_s"] == lifted.field.manifest["cost"]["store_s"]  # the other does not say


def test_channels_are_lifted_some_at_a_time(lifted, monkeypatch):
    """The loop over views and channels, with gsplat's compiled functions replaced by dense products."""
    seen = observations(lifted)[:2]
    weights = iter([weights for _, weights, _ in seen])

    def project_views(job: RasterJob, cameras: list[Camera]) -> SimpleNamespace:
        return SimpleNamespace(means2d=None, conics=None, opacities=None, offsets=None, indices=next(weights))

    def backward(*given: Any) -> tuple[Any, ...]:
        gradient = given[13]
        assert gradient.shape == (1, HEIGHT, WIDTH, 32)
        return None, None, None, (given[10] @ gradient.flatten(0, 2))[None]

    monkeypatch.setattr("normlift_ns.evaluation.baselines.project_views", project_views)
    monkeypatch.setattr(
        "normlift_ns.evaluation.baselines.compiled_rasterizer",
        lambda: (lambda *drawing: (None, torch.zeros(1, HEIGHT, WIDTH, 1), None), backward),
    )
    g = generator(0)
    maps = [torch.rand(HEIGHT, WIDTH, 45, generator=g, dtype=torch.float64) for _ in seen]
    job = RasterJob(lifted.scene.gaussians, False, RasterSettings(), torch.float32)
    found = baselines.dense_sums(job, [camera for camera, _, _ in seen], maps, 45)
    expected = sum(w @ features.flatten(0, 1) for (_, w, _), features in zip(seen, maps))
    assert torch.allclose(found.double(), expected, rtol=1e-5, atol=1e-5)
