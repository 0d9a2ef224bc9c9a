"""What a lift refuses or warns of, on a scene made by hand: nothing labelled, files shared by two images, label maps of
photographs that were undistorted."""

import json
import re
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

import normlift_ns as nl
from normlift_ns.core.consensus import consensus
from normlift_ns.encoders.base import RegionFeatures, ViewFeatures, precomputed_features
from normlift_ns.encoders.color import ColorEncoder
from normlift_ns.encoders.langsplat import FeatureExport, LangSplat
from normlift_ns.evaluation.lerf import run_lerf
from normlift_ns.evaluation.options import LerfOptions, MaskOptions
from normlift_ns.evaluation.protocols import EvaluatedRun, mask_truth
from normlift_ns.evaluation.studies import voting_scalars
from normlift_ns.options import VOTE_DEFAULTS
from normlift_ns.pipeline import lift_scene, min_agreement
from normlift_ns.progress import lift_cost
from normlift_ns.rendering.figures import training_cameras, unique_file_names
from normlift_ns.segmentation.regions import LabelFiles, resample_nearest
from tests.random_scenes import Photographs, generator, made_scene, orbit, random_scene

WIDTH, HEIGHT, N = 24, 18, 30
POSE = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]])
CAMERA = nl.Camera(torch.tensor([[20.0, 0, 12], [0, 20, 9], [0, 0, 1]]), POSE, WIDTH, HEIGHT)


def scene(*names: str, count: int = N, held_out: Sequence[str] = (), mask: Any = None, **more: Any) -> Any:
    g = generator(0)
    means = torch.rand(count, 3, generator=g) - 0.5
    gaussians = nl.GaussianScene(
        means, torch.randn(count, 4, generator=g), torch.full((count, 3), 0.05), torch.full((count,), 0.8)
    )
    train, other = (
        Photographs(some, [CAMERA] * len(some), masks=[mask] * len(some), **more)
        for some in (names or ("images/a.png",), held_out)
    )
    return made_scene(gaussians, train, other)


def lifted(source: Any, cache: Path, made: Any = None, export: Any = None, **options: Any) -> Any:
    given = nl.LiftOptions(**{"refine": False, "storage": "evidence", **options})
    return lift_scene(scene() if made is None else made, source, given, cache, encoder={}, export=export)


def files(folder: Path, array: np.ndarray, *stems: str, **options: Any) -> RegionFeatures:
    for stem in stems or ("a",):
        (folder / stem).parent.mkdir(parents=True, exist_ok=True)
        np.save(folder / f"{stem}.npy", array)
    return RegionFeatures(LabelFiles(folder, **options), ColorEncoder())


FULL = np.ones((HEIGHT, WIDTH), int)


def test_nothing_labelled_is_refused_and_few_gaussians_with_features_are_warned_of(tmp_path: Path) -> None:
    for value, unlabeled in ((0, "ignore"), (-5, "dilute")):
        with pytest.raises(nl.InputError, match=r"nothing was labeled: .* 30 .*maps.*regions_back"):
            lifted(files(tmp_path / "maps", value * FULL), tmp_path / "cache", unlabeled=unlabeled)
    hidden, away = scene(mask=torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)), scene()
    away.gaussians.means[:] -= 100
    for made, why in ((hidden, "masks"), (away, "cameras")):
        with pytest.raises(nl.InputError, match=rf"nothing was labeled: .*{why}"):
            lifted(files(tmp_path / "maps", FULL), tmp_path / "cache", made)
    made = scene(count=3000)
    made.gaussians.means[5:, 2] -= 100  # behind the camera
    with pytest.warns(UserWarning, match=r" 5 of 3,000 .*0\.17%"):
        lifted(files(tmp_path / "maps", FULL), tmp_path / "cache", made)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lifted(files(tmp_path / "maps", FULL), tmp_path / "cache")


def test_images_that_share_a_label_map_or_exported_files_are_refused(tmp_path: Path) -> None:
    made = scene("a/0000.png", "b/0000.png")
    source = files(tmp_path / "maps", FULL, "0000")
    with pytest.raises(nl.InputError, match=r"a/0000\.png and b/0000\.png .*label map .*0000\.npy"):
        lifted(source, tmp_path / "cache", made)
    made, source = scene("a/0.left.png", "b/0.right.png"), files(tmp_path / "maps", FULL, "a/0.left", "b/0.right")
    with pytest.raises(nl.InputError, match=r"a/0\.left\.png and b/0\.right\.png .*0_s\.npy"):
        lifted(source, tmp_path / "cache", made, export=FeatureExport(tmp_path / "out", True))
    assert not (tmp_path / "out").exists()


def test_labels_of_nothing_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "0000.npy", FULL)
    (tmp_path / "labels.json").write_text('{"2": "a"}')
    with pytest.raises(nl.InputError, match=r"no Gaussian can be scored .*labels\.json"):
        mask_truth(scene("0000.png"), tmp_path, MaskOptions(names=tmp_path / "labels.json"))
    info = {"width": WIDTH, "height": HEIGHT}
    (tmp_path / "0000.json").write_text(json.dumps({"info": info, "objects": []}))
    run = EvaluatedRun(scene("a/0000.png"), None, ColorEncoder(), True)  # type: ignore[arg-type]
    with pytest.raises(nl.InputError, match="have no objects"):
        run_lerf([run], [tmp_path], LerfOptions())


def langsplat(folder: Path, height: int, width: int, **options: Any) -> LangSplat:
    folder.mkdir(exist_ok=True)
    np.save(folder / "a_s.npy", np.zeros((4, height, width), np.float32))
    np.save(folder / "a_f.npy", np.eye(20, dtype=np.float32)[:1])
    return LangSplat(folder, ColorEncoder(), "l", **options)


RAW = (WIDTH + 1, HEIGHT + 1)


def test_maps_of_distorted_images_are_refused_or_stretched(tmp_path: Path) -> None:
    """Also where another size of the same image is: half of 25 x 19 is half of 24 x 18, but for the distortion."""
    for height, width, what in (
        (HEIGHT + 1, WIDTH + 1, "the size of the original image"),
        (HEIGHT // 2, WIDTH // 2, "width x height\\)"),
    ):
        for kind in ("langsplat", "files"):
            refused, stretched = (
                langsplat(tmp_path / kind, height, width, resample=resample)
                if kind == "langsplat"
                else files(tmp_path / kind, np.ones((height, width), int), resample=resample)
                for resample in (False, True)
            )
            message = rf"{kind}\S+ (of images/a\.png )?is {width}x{height} .*{what}; "
            with pytest.raises(nl.InputError, match=message + r".*24x18\. .*regions_resample=True"):
                lifted(refused, tmp_path / "cache", scene(original=RAW))
            with pytest.warns(UserWarning, match=message + ".*resized"):
                lifted(stretched, tmp_path / "cache", scene(original=RAW))


def test_maps_of_undistorted_images_are_taken(tmp_path: Path) -> None:
    cache, undistorted = tmp_path / "cache", scene(original=RAW)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lifted(files(tmp_path / "maps", FULL), cache, undistorted)
        lifted(langsplat(tmp_path / "l", HEIGHT, WIDTH), cache, undistorted)
        lifted(langsplat(tmp_path / "l", HEIGHT, WIDTH), cache, undistorted, lift_downscale=2)
        lifted(langsplat(tmp_path / "l", HEIGHT // 2, WIDTH // 2), cache, scene())
    for source in (langsplat(tmp_path / "l", HEIGHT, WIDTH), files(tmp_path / "maps", FULL)):
        with pytest.warns(UserWarning, match="without changing their size"):
            lifted(source, cache, scene(original=(WIDTH, HEIGHT)))
    mask = torch.ones(HEIGHT, WIDTH + 1, dtype=torch.bool)
    with pytest.raises(nl.InputError, match=r"the mask of images/a\.png is \(18, 25\), but its camera is \(18, 24\)"):
        lifted(files(tmp_path / "maps", FULL), cache, scene(mask=mask))


def test_maps_of_whole_images_are_downscaled_with_them(tmp_path: Path) -> None:
    maps = torch.randint(0, 4, (HEIGHT, WIDTH), generator=generator(0)).numpy()
    small = resample_nearest(maps[None], HEIGHT // 2, WIDTH // 2)[0]

    def weights(size: np.ndarray, kind: str) -> Any:
        vectors = torch.eye(4)
        if kind == "given":
            source: Any = precomputed_features({"images/a.png": (size, vectors)}, None, ["images/a.png"])
        else:
            source = files(tmp_path / f"maps{size.shape}", size + 1)
        how = {"lift_downscale": 2, "reuse_evidence": kind == "cached"}
        return lifted(source, tmp_path / f"cache{size.shape}", **how).field.scalars.n_eff

    for kind in ("given", "files", "cached"):
        expected = weights(small, kind)
        assert float(expected.max()) > 0
        torch.testing.assert_close(weights(maps, kind), expected, rtol=0, atol=0)
        with pytest.raises(nl.InputError, match="lift_downscale 2"):
            weights(maps[:-2], kind)


def test_names_of_pictures_lose_no_camera_and_guess_none() -> None:
    for images, expected in (
        (["images/0.png", "images/1.png"], ["0", "1"]),
        (["a/0.png", "b/0.png", "b/1.png"], ["a_0", "b_0", "1"]),
        (["0.png", "0.jpg"], ["0.png", "0.jpg"]),
        (["a/b_0.png", "a_b/0.png", "c/0.png"], ["b_0", "a_b_0", "c_0"]),
        (["a/b/0.png", "a_b/0.png"], ["a_b_0.png", "a_b_0_2.png"]),
        (["/data/a/X.png", "../b/x.png"], ["_data_a_X", ".._b_x"]),
    ):
        assert unique_file_names(images) == expected
    made = scene("a/0000.png", "b/0000.png", "b/0001.png")
    assert list(training_cameras(made)) == ["a_0000", "b_0000", "0001"]
    assert list(training_cameras(made, ["0001", "b/0000", "a/0000.png"])) == ["0001", "b_0000", "a_0000"]
    for name, message in (("0000", "2 .*'0000'.* a_0000, b_0000"), ("c", "'c'.*3.* 'a_0000' to '0001'")):
        with pytest.raises(nl.InputError, match=message):
            training_cameras(made, [name])


@pytest.mark.skipif(sys.platform != "linux", reason="other systems count memory otherwise")
def test_costs_are_seconds_their_sum_and_the_memory_of_this_process() -> None:
    """`ru_maxrss` would count what the process had from which this one was started."""
    found = lift_cost({"a": 1.0, "b": 0.5}, "cpu")
    (line,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found == pytest.approx({"a_s": 1.0, "b_s": 0.5, "total_s": 1.5, "memory_gib": int(line) / 2**20}, rel=0.01)


@pytest.mark.skipif(torch.cuda.is_available(), reason="watches Triton's interpreter")
def test_kernels_that_are_compiled_ahead_are_those_of_a_lift(monkeypatch):
    """The same kernels with the same types and constants, so that a lift compiles none of them again."""
    interpreter = pytest.importorskip("triton.runtime.interpreter")
    backend = import_module("normlift_ns.rasterization.triton")
    seen: set[Any] = set()
    run = interpreter.InterpretedFunction.run

    def watched(self: Any, *given: Any, **named: Any) -> Any:
        types = tuple(x.dtype if isinstance(x, torch.Tensor) else type(x) for x in given)
        constants = {name: x for name, x in named.items() if name not in ("grid", "warmup")}
        seen.add((self.fn.__name__, types, tuple(sorted(constants.items()))))
        return run(self, *given, **named)

    monkeypatch.setattr(interpreter.InterpretedFunction, "run", watched)
    gaussians, cameras = random_scene(40, dtype=torch.float32), orbit(2, width=32, height=24)
    options: Any = {"rasterize_mode": "classic", "settings": nl.RasterSettings(), "dtype": torch.float32}
    for call in chain(*backend.kernel_calls(gaussians, cameras[0], weight_power=1, **options)):
        call()
    ahead = set(seen)
    seen.clear()
    job = backend.RasterJob(gaussians, False, nl.RasterSettings(), torch.float32)
    labels = [torch.zeros(24, 32, dtype=torch.int32)] * 2
    backend.views_evidence(job, backend.RasterBatch(cameras, labels, [1, 1]))
    backend.composite(job, cameras[0], torch.ones(40, 3))
    assert len(seen) == 9
    assert seen <= ahead


def test_stages_run_ahead_do_not_fail():
    """Their errors would be suppressed."""
    early, lift = nl.pipeline.lift_calls(random_scene(60, dtype=torch.float32).means, nl.LiftOptions())
    for call in (*early, *lift(7)):
        call()


def test_neighbours_and_vote_report_gaussians(monkeypatch, tmp_path):
    monkeypatch.setattr("normlift_ns.core.neighbors._BLOCK", 10)
    told: list[tuple[str, int, int]] = []
    made, given = scene("a.png"), nl.LiftOptions(refine=True, vote=nl.RefineConfig(k=4))
    source = files(tmp_path / "maps", FULL)
    lift_scene(made, source, given, tmp_path / "cache", encoder={}, report=lambda *step: told.append(step))
    for stage in ("neighbors", "vote"):
        steps = [done for name, done, total in told if name == stage and total == N]
        assert steps == sorted(steps) and (steps[0], steps[-1]) == (0, N)
    assert len([step for step in told if step[0] == "neighbors"]) == 4


def test_the_manifest_says_what_rasterized_and_by_which_rules(tmp_path):
    made = scene("a.png")
    for asked, recorded, rules in (("auto", None, "1.4"), ("auto", "1.5", "1.5"), ("1.6", "1.5", "1.6")):
        made.identity = {} if recorded is None else {"gsplat_rules": recorded}
        found = lifted(files(tmp_path / "maps", FULL), tmp_path / "cache", made, gsplat_version=asked, backend="auto")
        assert found.field.manifest["gsplat_rules"] == rules
        assert found.field.manifest["backend"] == "numba"
        assert nl.RasterSettings.recorded(found.field.manifest) == nl.RasterSettings.of_gsplat(rules)


THREE = ("a.png", "b.png", "c.png")


def halves(folder: Path) -> RegionFeatures:
    """Two masks in each of three views."""
    labels = np.ones((HEIGHT, WIDTH), int)
    labels[:, WIDTH // 2 :] = 2
    return files(folder, labels, "a", "b", "c")


def test_consensus_changes_features_and_nothing_else(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The three views have two masks each, of noise of their own; switching it on rasterizes nothing again, and the
    stored features are those that the formula gives."""
    source, results = halves(tmp_path / "maps"), []
    for on in (False, True, False):
        results.append(lifted(source, tmp_path / "cache", scene(*THREE), consensus=on, consensus_sample=7))
        monkeypatch.setattr(nl.evidence_collection, "rasterize_evidence", None)
    _, on, off = results
    assert "consensus" not in off.seconds and "consensus" not in off.field.manifest["statistics"]
    facts = on.field.manifest["statistics"]["consensus"]
    assert {name: facts[name] for name in ("power", "sample", "seed")} == {"power": 1.0, "sample": 7, "seed": 0}
    assert facts["agreement"][0] > 0.5
    assert on.field.manifest["cost"]["consensus_s"] > 0
    before, after = (x.field.store for x in (off, on))
    assert torch.equal(before.evidence.rows.weight, after.evidence.rows.weight)
    expected = consensus(before.evidence, before.features, sample=7).features
    assert torch.allclose(after.features, expected, atol=1e-6)
    assert not torch.allclose(after.features, before.features, atol=1e-3)
    seen, agreed = (x.field.scalars for x in (off, on))
    has = agreed.norm > 0
    assert torch.equal(agreed.reliability[has], seen.reliability[has])
    assert bool((agreed.reliability[~has] == 0).all())
    assert bool((agreed.norm[has] > seen.norm[has] + 1e-3).any())  # that of what the views agree on


def test_the_vote_counts_what_was_seen_before_the_consensus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """R and own evidence are those of the lift without consensus, directions those with it; voting again on the stored
    run takes the same numbers."""
    source, watched = halves(tmp_path / "maps"), MagicMock(side_effect=nl.pipeline.refine)
    monkeypatch.setattr(nl.pipeline, "refine", watched)
    how = {"refine": True, "reliability_beta": 0.7, "vote": nl.RefineConfig(vote="posterior", k=3)}
    fields = [lifted(source, tmp_path, scene(*THREE), consensus=on, **how).field for on in (False, True)]
    first, second = watched.call_args_list
    assert torch.equal(first.args[2], second.args[2]) and torch.equal(first.kwargs["own"], second.kwargs["own"])
    plain, agreed = (voting_scalars(field) for field in fields)
    assert torch.allclose(agreed.norm, plain.norm, atol=1e-6)
    assert torch.allclose(agreed.own_evidence, second.kwargs["own"], atol=1e-5)
    assert torch.equal(plain.norm, fields[0].scalars.norm)


def test_the_gate_is_measured_after_a_consensus_and_fixed_by_options(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    source, watched = halves(tmp_path / "maps"), MagicMock(side_effect=nl.pipeline.refine)
    monkeypatch.setattr(nl.pipeline, "refine", watched)

    def voted(**options: Any) -> tuple[Any, nl.RefineConfig]:
        how = {"refine": True, "consensus": True, "vote": nl.RefineConfig(k=5), **options}
        return lifted(source, tmp_path, scene(*THREE, count=300), **how).field.manifest, watched.call_args.args[3]

    manifest, config = voted()
    statistics, vote = manifest["statistics"], manifest["options"]["vote"]
    assert statistics["gate"]["pairs"] >= 50
    assert (config.tau, config.gamma) == (statistics["gate"]["tau"], statistics["gate"]["gamma"]) != (0.9, 0.05)
    assert (vote["tau"], vote["gamma"], vote["min_labeled"]) == (config.tau, config.gamma, 0.2)
    assert 0 <= statistics["changed_share"] <= statistics["refined_share"]
    assert statistics["recognition"]["recognized"] <= statistics["recognition"]["confirmed"]
    manifest, config = voted(vote=nl.RefineConfig(k=5, tau=0.9, gamma=0.05, min_labeled=0.0), recognition=False)
    assert config.numbers == VOTE_DEFAULTS["posterior"]._replace(min_labeled=0.0)  # version 0.2
    assert {"gate", "recognition"}.isdisjoint(manifest["statistics"])
    assert min_agreement(nl.LiftOptions(), source.identity) == 0.4
    for identity in ({"regions": {"kind": "edges"}}, {"kind": "langsplat"}):  # regions that are objects
        assert min_agreement(nl.LiftOptions(), identity) == 0
        assert min_agreement(nl.LiftOptions(consensus_min_agreement=0.3), identity) == 0.3
    paper = {"vote": nl.RefineConfig(vote="paper", k=5)}
    for options in ({"consensus": False}, {"consensus_min_agreement": 1.0}, paper):
        manifest, config = voted(**options)
        assert "gate" not in manifest["statistics"] and config.numbers == VOTE_DEFAULTS[config.vote]


def test_reliabilities_of_pairs_of_views_are_stored_and_leave_the_vote_alone(tmp_path: Path) -> None:
    how = {"refine": True, "vote": nl.RefineConfig(k=3)}
    fields = [
        lifted(halves(tmp_path / "maps"), tmp_path, scene(*THREE), reliability=kind, **how).field
        for kind in ("paper", "pairs", "angular")
    ]
    paper, pairs, angular = (field.scalars.reliability for field in fields)
    seen = paper > 0
    assert torch.equal(fields[0].source, fields[2].source)
    assert bool((pairs[seen] < paper[seen]).all() and (pairs[seen] > 0).all())
    assert bool((angular[seen] <= 0.021).all())  # all three cameras are at one place


def test_levels_agree_each_for_itself(tmp_path: Path) -> None:
    rows = torch.nn.functional.normalize(torch.rand(3, 4, generator=generator(1)), dim=1)

    class Both:
        identity: ClassVar = {"kind": "both"}

        def available(self, names: Sequence[str]) -> list[str]:
            return list(names)

        def text(self, prompts: Sequence[str]) -> torch.Tensor:
            return rows[:1].expand(len(prompts), -1)

        def view(self, image: torch.Tensor, name: str) -> ViewFeatures:
            cells = (torch.arange(WIDTH) >= WIDTH // 2).int().expand(HEIGHT, WIDTH).contiguous()
            own = rows[[0, 1, 2]] if name == "a.png" else rows[[2, 1, 0]]
            return ViewFeatures(cells, own, torch.tensor([[0, 0], [1, 2]], dtype=torch.int32))

    found = lifted(Both(), tmp_path, scene("a.png", "b.png"), consensus=True).field
    assert len(found.manifest["statistics"]["consensus"]["agreement"]) == 2
    whole = torch.nn.functional.normalize(rows[0] + rows[2], dim=0)
    assert torch.allclose(found.store.features[[0, 3]], whole.expand(2, -1), atol=1e-6)
    assert torch.allclose(found.store.features[[1, 4]], rows[1].expand(2, -1), atol=1e-6)
