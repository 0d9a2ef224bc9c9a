"""Public functions accept the kinds of arguments in TABLE, and refuse every other with the name of the argument."""

import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import normlift_ns as nl
from normlift_ns.core.evidence import Entries
from tests.random_scenes import unit_rows

N = 5
MEANS, K, POSE = torch.rand(N, 3), torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), torch.eye(4)
CAMERA, SCENE = nl.Camera(K, POSE, 16, 16), nl.GaussianScene(MEANS, torch.ones(N, 4), torch.ones(N, 3), torch.ones(N))
EVIDENCE = nl.Evidence.from_entries(
    [Entries(torch.tensor([0, 0, 1, 1]), torch.tensor([1, 3, 1, 3]), torch.ones(4), num_regions=(1, 1))], N
)
FEATURES, UNIT, ONES = unit_rows(2, 4, 0).float(), unit_rows(N, 4, 1).float(), torch.ones(N)
LIFTED, NEAR = nl.lift(EVIDENCE, FEATURES), nl.nearest_neighbors(MEANS, 2)
FIELD = nl.SemanticField.build(LIFTED, MEANS)
GRAY, NO = torch.zeros(16, 16, 3, dtype=torch.uint8), torch.zeros(N, dtype=torch.bool)
MANY, MAP = torch.arange(N), torch.zeros(16, 16).int()
OPTIONS = {nl.LiftOptions, nl.RefineConfig, nl.SourceOptions, nl.SplatOptions}
Row = tuple[Callable[..., Any], dict[str, str], tuple[Any, ...]]


def row(function: Callable[..., Any], kinds: str, *needed: Any) -> Row:
    """A function with the kinds of its arguments, of which the first ones are needed."""
    return function, dict(kind.strip().split(" ", 1) for kind in kinds.split(";")), needed  # type: ignore[misc]


PART, ANSWER, FIELDS = "part bool n", object.__new__(nl.Answer), "backend word; rasterize_mode word; settings None"
METHODS = [
    row(nl.LiftedRun.ask, "negatives texts|None; relevancy word; threshold number|None; min_reliability number; "
        "refined bool"),
    row(nl.LiftedRun.save, "question Answer"),
    row(nl.LiftedRun.export, "path path; part bool n|None; answer None; objects dictionary|None; "
        "object_max_gap number; object_min_gaussians whole; overwrite bool", "a.ply"),
    row(nl.LiftedRun.masks, f"folder path; {PART}; rest bool; overwrite bool", "a", NO),
    row(nl.LiftedRun.transfer, "cloud path; path path; part Answer; transfer_distance number; coordinates word; "
        "overwrite bool", "a.ply", "b.ply", ANSWER),
    row(nl.LiftedRun.why, PART),
    row(nl.LiftedRun.catalogue, f"{PART}; meters_per_unit number|None", NO),
    row(nl.LiftedRun.inventory, "vocabulary texts|None; meters_per_unit number|None"),
    row(nl.LiftedRun.floaters, "limit number"),
    row(nl.LiftedRun.camera, "view path|whole"),
    row(nl.LiftedRun.render, "view path|whole|Camera; found None", 0),
    row(nl.RemoteRun.ask, "negatives texts|None; relevancy word; threshold number|None; min_reliability number; "
        "refined bool"),
    row(nl.RemoteRun.features, "start whole; stop whole|None"),
    row(nl.RemoteRun.coverage, "min_reliability number|None"),
    row(nl.RemoteRun.camera, "view text|whole"),
    row(nl.Coverage.save, "path path; overwrite bool", "a.json"),
    row(nl.Evidence.select_views, "views wholes|whole m"),
    row(nl.Evidence.columns_of, "views wholes|whole m"),
    row(nl.Evidence.select_gaussians, "gaussians whole m"),
    row(nl.Evidence.regroup, "columns whole levels s; region_view whole m", MANY[None], MANY.int()),
    row(nl.Evidence.save, "path path; key text; remarks dictionary|None", "a"),
    row(nl.SemanticField.save, "folder path; overwrite bool; beside dictionary", "a"),
]  # fmt: skip
"""Methods, called without their object: wrong arguments are refused before it is used."""
TABLE = [
    row(nl.GaussianScene, "means float n 3; quats float n 4; scales float n 3; opacities float n",
        MEANS, torch.ones(N, 4), torch.ones(N, 3), ONES),
    row(nl.Camera, "K float 3 3; world_to_camera float 4 4; width whole; height whole", K, POSE, 16, 16),
    row(CAMERA.downscaled, "factor number"),
    row(CAMERA.project, "points float n 3"),
    row(nl.View, "camera Camera; image uint8 h w 3; mask bool h w|None; name text; original pair|None",
        CAMERA, GRAY, None, "a"),
    row(nl.rasterize_evidence, f"scene GaussianScene; cameras Cameras; labels maps; num_regions wholes|None; "
        f"progress function 2|None; weight_power whole; dtype None; {FIELDS}", SCENE, [CAMERA], [MAP]),
    row(nl.render, f"scene GaussianScene; camera Camera; values float n c; dtype None; {FIELDS}",
        SCENE, CAMERA, ONES[:, None]),
    row(nl.contributors, f"scene GaussianScene; camera Camera; pixels whole p 2; {FIELDS}",
        SCENE, CAMERA, torch.tensor([[3, 4]])),
    row(nl.lift, "evidence Evidence; features float s d; beta number; unlabeled word", EVIDENCE, FEATURES),
    row(nl.consensus, "evidence Evidence; features float s d; power number; level whole s|None; sample whole; "
        "least number", EVIDENCE, FEATURES),
    row(nl.nearest_neighbors, "means float n 3; k whole; of whole m|None; progress function 2|None", MEANS, 2),
    row(nl.refine, "means float n 3; directions float n d|function 1; reliability float n; config None; "
        "own float n|None; neighbors None; progress function 2|None", MEANS, UNIT, ONES),
    row(nl.refine_variant, "variant word; means float n 3; lifted Lifted; config None; beta number",
        "none", MEANS, LIFTED),
    row(nl.unsupported, "neighbors Neighbors; reliability float n", NEAR, ONES),
    row(nl.relevancy, "positive float *; negative float *|None; rule word; temperature number", UNIT),
    row(nl.SemanticField.build, "lifted Lifted; means float n 3; source whole n|None; tolerance number; storage word; "
        "provenance dictionary|None", LIFTED, MEANS),
    row(FIELD.query, "text_vectors float q d; refined bool", FEATURES),
    row(FIELD.relevancy, "text_vectors float q d; negatives float b d|None; rule word; refined bool", FEATURES),
    row(FIELD.directions, "gaussians whole m|None; refined bool"),
    row(FIELD.valid, "refined bool"),
    row(nl.SemanticField.load, "folder path; means float n 3|None", "/nowhere"),
    row(nl.Neighbors, "index whole m k; distance float m k; spacing float m", *NEAR),
    row(nl.Contributors, "offsets whole p; gaussian whole m; weight float m", MANY, MANY, ONES),
    row(nl.Floaters, "score float n; mask bool n", ONES, NO),
    row(Entries, "gaussian whole n; column whole n; weight float n; num_regions wholes", MANY, MANY, ONES, (1,)),
    row(nl.Evidence.load, "path path; key text", "/nowhere"),
    row(nl.Evidence.from_entries, "parts maps; num_gaussians whole; weight_power whole; num_excluded whole", [], N),
    row(nl.Lifted, "scalars Scalars; evidence Evidence; features float s d", LIFTED.scalars, EVIDENCE, FEATURES),
    row(LIFTED.directions, "gaussians whole m|None; dtype None"),
    row(nl.RasterSettings, "near_plane number; far_plane number; eps2d number; per_axis bool; tile_size whole; "
        "max_alpha number"),
    row(nl.RasterSettings.of_gsplat, "version text"),
    row(nl.RasterSettings.recorded, "manifest dictionary"),
    row(nl.open_scene, "load_config path; data path|None; load_step whole|None", "/nowhere"),
    row(nl.open_splat, "path path; options SplatOptions", "/nowhere", nl.SplatOptions(colmap=Path("/nowhere"))),
    row(nl.connect, "url text; run text|None; access_token text", "http://127.0.0.1:9"),
    row(nl.open_run, "load_config path; data path|None; device word; text_embeddings path|None; "
        "prompt_template text|None", "/nowhere"),
    row(nl.coverage, "run LiftedRun"),
    row(partial(nl.coverage, object.__new__(nl.LiftedRun)), "min_reliability number; device text|None"),
    *((partial(method, None), kinds, needed) for method, kinds, needed in METHODS),
    row(nl.lift_run, "config_or_scene path; lift None; texts None; queries texts; load_step whole|None; "
        "overwrite bool; output_dir path|None; device word; report function 3; say function 1", "/nowhere"),
    *((options, {field.name: "option" for field in fields(options)}, ()) for options in OPTIONS),
]  # fmt: skip


def is_array(kinds: str, axes: list[str], value: Any) -> bool:
    if isinstance(value, torch.Tensor):
        value = value.detach().numpy() if value.dtype != torch.bfloat16 else value.detach().float().numpy()
    elif isinstance(value, list | tuple):
        try:
            value = np.asarray(value)
        except ValueError:
            return False
        kinds += "iu" if kinds == "f" and value.size > 0 else "f" if value.size == 0 else ""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in kinds:
        return False
    return axes == ["*"] or len(axes) == value.ndim


def is_kind(kind: str, value: Any) -> bool:
    word, *axes = kind.split()
    if word in ("None", "function"):
        return value is {"None": None, "function": print}[word]
    if len(axes) > 0:
        return is_array({"float": "f", "whole": "iu", "bool": "b", "uint8": "u"}[word], axes, value)
    if word in ("texts", "Cameras"):
        return isinstance(value, list | tuple) and all(isinstance(item, str) and word == "texts" for item in value)
    if word == "pair":
        return isinstance(value, list | tuple) and len(value) == 2 and all(type(item) is int for item in value)
    if word == "option":
        return not isinstance(value, Nothing) and not callable(value)
    kinds = {"bool": bool, "text": str, "path": str | Path, "dictionary": Mapping, "maps": list | tuple,
             "wholes": list | tuple | range, "whole": int, "number": int | float}  # fmt: skip
    nan = isinstance(value, float) and math.isnan(value)
    return isinstance(value, kinds.get(word, ())) and not nan and (word == "bool" or value is not True)


class Nothing:
    """Of no use to anybody."""


ARRAYS = [
    make(torch.ones(shape).to(kind))
    for shape in ((), (1,), (2,), (N,), (N, 2), (N, 3), (3, 3), (2, 3, 4), (0,), (0, 3))
    for kind in (torch.float32, torch.float64, torch.int64, torch.bool, torch.complex64, torch.uint8)
    for make in (lambda x: x, lambda x: x.numpy(), lambda x: x.tolist())
]
WRONG = st.one_of(
    st.sampled_from([None, True, Nothing(), Nothing, print, Path("a"), b"a", {}, set(), {1: "a"}, np.array(["a"]),
                     np.array([None]), math.nan, math.inf, 10**400, [["a"], 2], [None], "", "auto\0", range(3)]),
    st.sampled_from(ARRAYS), st.integers(), st.floats(), st.text(max_size=5), st.lists(st.none(), max_size=3),
)  # fmt: skip


def call_with_a_wrong_value(data: st.DataObject) -> None:
    function, kinds, needed = data.draw(st.sampled_from(TABLE))
    name = data.draw(st.sampled_from(sorted(kinds)))
    value = data.draw(WRONG)
    assume(not any(is_kind(kind, value) for kind in kinds[name].split("|")))
    with pytest.raises(nl.InputError) as caught:
        function(**{**dict(zip(kinds, needed)), name: value})
    assert name in str(caught.value) or name.replace("_", "-") in str(caught.value) or "row" in str(caught.value)


@pytest.mark.parametrize(
    "count", [pytest.param(400, marks=pytest.mark.slow), pytest.param(10_000, marks=pytest.mark.extra)]
)
def test_wrong_kinds_are_refused_by_name(count, unchecked):
    many = settings(max_examples=count, deadline=None, suppress_health_check=list(HealthCheck))
    many(given(st.data())(call_with_a_wrong_value))()


def test_paths_of_no_file_and_tensors_that_are_no_arrays_are_refused_by_name(tmp_path, unchecked):
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    paths = ("x" * 300, "y" * 300 + "/a", "z/" * 3000, tmp_path / "file" / "a", tmp_path / "loop", "a\ud800")
    tensors = (ONES.to_sparse(), ONES.to("meta"), torch.nested.nested_tensor([ONES]), ONES.to(torch.float8_e4m3fn))
    others = [row(nl.SplatOptions, "colmap path"), row(nl.SourceOptions, "regions_dir path")]
    for function, kinds, needed in (*TABLE, *others):
        for name, kind in kinds.items():
            wrongs = {"path": paths, "float": tensors, "whole": tensors[: 4 * (" " in kind)]}
            for wrong in wrongs.get(kind.partition("|")[0].split()[0], ()):
                with pytest.raises(nl.InputError, match=name):
                    function(**{**dict(zip(kinds, needed)), name: wrong})
    for write, wrong in ((FIELD.save, tmp_path / "file"), (EVIDENCE.save, tmp_path)):
        with pytest.raises(nl.InputError, match=str(wrong)):
            write(wrong)


def test_functions_that_are_given_return_what_they_should(unchecked):
    config, needed = nl.RefineConfig(k=2), {"reliability": ONES, "own": ONES}
    expected = nl.refine(MEANS, UNIT, config=config, **needed)
    for right in (lambda m: UNIT[m], lambda m: UNIT[m].numpy(), lambda m: UNIT[m].tolist(), UNIT.__getitem__):
        assert torch.equal(nl.refine(MEANS, right, config=config, **needed), expected)
    for wrong in (
        lambda m: None, lambda m: UNIT[m, 0], lambda m: UNIT[m][1:], lambda m: UNIT[m].int(), lambda m, n: UNIT[m],
        lambda: UNIT, lambda m: UNIT[m].to("meta"),
    ):  # fmt: skip
        with pytest.raises(nl.InputError, match="directions"):
            nl.refine(MEANS, wrong, config=config, **needed)
    for failing in ({"directions": lambda m: UNIT[7]}, {"directions": UNIT, "progress": lambda *_: UNIT[7]}):
        with pytest.raises(IndexError, match="index 7"):
            nl.refine(MEANS, config=config, **needed, **failing)


def test_arrays_of_every_library_give_the_same(unchecked):
    expected = nl.relevancy(UNIT, rule="cosine")
    assert torch.equal(nl.relevancy(UNIT.tolist()), expected)
    assert np.array_equal(nl.relevancy(UNIT.numpy(), UNIT[:, :2], rule="lerf").shape, (N, 4))
    assert nl.nearest_neighbors(MEANS.tolist(), np.int64(2)).index.tolist() == NEAR.index.tolist()
    assert nl.nearest_neighbors(MEANS.numpy()[::-1], 2).index.shape == (N, 2)
    camera = nl.Camera(K.tolist(), POSE.numpy(), np.int32(16), 16)
    assert camera.width == 16 and torch.equal(camera.K, K)
    labels = np.zeros((16, 16), np.int32)
    one = nl.rasterize_evidence(SCENE, [camera], [labels], backend="torch")
    two = nl.rasterize_evidence(SCENE, iter([CAMERA]), (x for x in [labels.tolist()]), backend="torch")
    assert torch.equal(one.rows.weight, two.rows.weight)
    with pytest.raises(nl.InputError, match="reliability must"):
        nl.unsupported(NEAR, np.float32(1) * np.ones(()))
    with pytest.raises(nl.InputError, match=r"neighbors.index must be in -1\.\.0"):
        nl.unsupported(NEAR, [1.0])
    assert torch.equal(FIELD.query(FEATURES.tolist()), FIELD.query(FEATURES.numpy()))


def test_numbers_out_of_range_are_refused_by_name(tmp_path) -> None:

    def near(rows: torch.Tensor) -> nl.Neighbors:  # in which -1 stands for none
        return NEAR._replace(index=(rows - (rows < 0).int()).int().expand(N, 2))

    for wrong in ([-1], [N], [-99]):
        rows = torch.tensor(wrong)
        for name, call in {
            "gaussians": EVIDENCE.select_gaussians, "^gaussians": LIFTED.directions, "^gaussians ": FIELD.directions,
            "of": lambda x: nl.nearest_neighbors(MEANS, 2, of=x), "neighbors": lambda x: nl.unsupported(near(x), ONES),
            "source": lambda x: nl.SemanticField.build(LIFTED, MEANS, source=x.expand(N)),
            "index": lambda x: nl.refine(MEANS, UNIT, ONES, nl.RefineConfig("paper", k=2), neighbors=near(x)),
        }.items():  # fmt: skip
            with pytest.raises(nl.InputError, match=name):
                call(rows)
    with pytest.raises(nl.InputError, match=f"got {N}"):
        EVIDENCE.select_gaussians(torch.tensor([0, N]))
    for name, call in {
        "num_gaussians": lambda x: nl.Evidence.from_entries([], x), "size": lambda x: nl.Camera(K, POSE, x, 16),
        "factor": CAMERA.downscaled, "sample": lambda x: nl.consensus(EVIDENCE, FEATURES, sample=x),
        "num_regions": lambda x: nl.rasterize_evidence(SCENE, [CAMERA], [MAP - 1], num_regions=[x]),
        "weight_power": lambda x: nl.rasterize_evidence(SCENE, [CAMERA], [MAP], weight_power=x),
        "dtype": lambda x: nl.rasterize_evidence(SCENE, [CAMERA], [MAP], dtype=torch.float16 if x < 0 else torch.bool),
        "dtype must be": lambda x: LIFTED.directions(dtype=torch.int8),
        "JSON": lambda x: nl.SemanticField.build(LIFTED, MEANS, provenance={"a": {x}}).save(tmp_path / "a"),
        "metadata": lambda x: EVIDENCE.save(tmp_path / "a", remarks={"a": "\ud800"}),
    }.items():  # fmt: skip
        for count in (-5, 10**30) if name != "factor" else (-5, -math.inf, 0):
            with pytest.raises(nl.InputError, match=name):
                call(count)
    assert list(tmp_path.iterdir()) == []
    assert nl.nearest_neighbors(MEANS.double() * 1e200, 2).index.tolist() == [[-1, -1]] * N
    for part, more, name in (
        (([0], [2], [1.0], (1,)), {}, "column"), (([0], [-1], [1.0], (1,)), {}, "column"),
        (([N], [1], [1.0], (1,)), {}, "gaussian"), (([-1], [1], [1.0], (1,)), {}, "gaussian"),
        *((([0], [1], [value], (1,)), {}, "weight") for value in (math.nan, math.inf, -1.0)),
        (([1, 0], [1, 1], [1.0, 1.0], (1,)), {}, "sorted"), (([0, 0], [1, 1], [1.0, 1.0], (1,)), {}, "distinct"),
        *((([0], [1], [1.0], (1, count)), {}, "num_regions") for count in (-1, 2**31, 10**30)),
        *((([0], [1], [1.0], (1,)), {"weight_power": power}, "weight_power") for power in (-3, 3)),
        *((([0], [1], [1.0], (1,)), {"num_excluded": count}, "num_excluded") for count in (-1, N + 1)),
    ):  # fmt: skip
        with pytest.raises(nl.InputError, match=name):
            nl.Evidence.from_entries([Entries(*part)], N, **more)


def test_the_table_has_every_public_name():
    made = {"Answer", "Finding", "Histogram", "Why", "Coverage", "Consensus", "Scalars", "Evidence", "LiftedRun"}
    made |= {"RemoteRun"}
    named = {getattr(function, "__name__", "") for function, *_ in TABLE}
    rest = {name for name in nl.__all__ if callable(getattr(nl, name))} - made - {"Scene", "InputError"}
    assert rest - named - {"SemanticField"} == set()
    assert set(nl.__all__) <= set(dir(nl))
    with pytest.raises(AttributeError, match="nothing"):
        _ = nl.nothing
    assert all(is_dataclass(getattr(nl, name)) or name == "Consensus" for name in made)
