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
MANY = torch.arange(N)
OPTIONS = {nl.LiftOptions, nl.RefineConfig, nl.SourceOptions, nl.SplatOptions}
Row = tuple[Callable[..., Any], dict[str, tuple[str, Any]]]
PART = {"part": ("bool n", NO)}
METHODS: list[Row] = [
    (
        nl.LiftedRun.ask,
        {
            "negatives": ("texts|None", None),
            "relevancy": ("word", "auto"),
            "threshold": ("number|word|None", None),
            "min_reliability": ("number", 0.0),
            "refined": ("bool", True),
        },
    ),
    (nl.LiftedRun.save, {"question": ("Answer", None)}),
    (
        nl.LiftedRun.export,
        {
            "path": ("path", "a.ply"),
            "part": ("bool n|None", None),
            "answer": ("Answer|None", None),
            "objects": ("dictionary|None", None),
            "object_max_gap": ("number", 2.0),
            "object_min_gaussians": ("whole", 5),
            "overwrite": ("bool", False),
        },
    ),
    (nl.LiftedRun.masks, {"folder": ("path", "a"), **PART, "rest": ("bool", False), "overwrite": ("bool", False)}),
    (
        nl.LiftedRun.transfer,
        {
            "cloud": ("path", "a.ply"),
            "path": ("path", "b.ply"),
            "part": ("Answer", object.__new__(nl.Answer)),
            "transfer_distance": ("number", 1.0),
            "coordinates": ("word", "scene"),
            "overwrite": ("bool", False),
        },
    ),
    (nl.LiftedRun.why, PART),
    (nl.LiftedRun.catalogue, {**PART, "meters_per_unit": ("number|None", None)}),
    (nl.LiftedRun.inventory, {"vocabulary": ("texts|None", None), "meters_per_unit": ("number|None", None)}),
    (nl.LiftedRun.floaters, {"limit": ("number", 1.0)}),
    (nl.LiftedRun.camera, {"view": ("path|whole", 0)}),
    (nl.LiftedRun.render, {"view": ("path|whole|Camera", 0), "found": ("Answer|None", None)}),
    (nl.RemoteRun.features, {"start": ("whole", 0), "stop": ("whole|None", None)}),
    (nl.RemoteRun.coverage, {"min_reliability": ("number|None", None)}),
    (nl.RemoteRun.camera, {"view": ("text|whole", 0)}),
    (
        nl.RemoteRun.ask,
        {
            "negatives": ("texts|None", None),
            "relevancy": ("word", "auto"),
            "threshold": ("number|word|None", None),
            "min_reliability": ("number", 0.0),
            "refined": ("bool", True),
        },
    ),
    (nl.Coverage.save, {"path": ("path", "a.json"), "overwrite": ("bool", False)}),
    (nl.Evidence.select_views, {"views": ("wholes|whole m", [0])}),
    (nl.Evidence.columns_of, {"views": ("wholes|whole m", [0])}),
    (nl.Evidence.select_gaussians, {"gaussians": ("whole m", MANY)}),
    (nl.Evidence.regroup, {"columns": ("whole levels s", MANY[None]), "region_view": ("whole m", MANY.int())}),
    (nl.Evidence.save, {"path": ("path", "a"), "key": ("text", ""), "remarks": ("dictionary|None", None)}),
    (nl.SemanticField.save, {"folder": ("path", "a"), "overwrite": ("bool", False), "beside": ("dictionary", {})}),
]
"""Methods, called without their object: wrong arguments are refused before it is used."""
TABLE: list[Row] = [
    (nl.GaussianScene, {"means": ("float n 3", MEANS), "quats": ("float n 4", torch.ones(N, 4)),
                        "scales": ("float n 3", torch.ones(N, 3)), "opacities": ("float n", ONES)}),
    (nl.Camera, {"K": ("float 3 3", K), "world_to_camera": ("float 4 4", POSE), "width": ("whole", 16),
                 "height": ("whole", 16)}),
    (CAMERA.downscaled, {"factor": ("number", 0.5)}),
    (CAMERA.project, {"points": ("float n 3", MEANS)}),
    (nl.View, {"camera": ("Camera", CAMERA), "image": ("uint8 h w 3", GRAY), "mask": ("bool h w|None", None),
               "name": ("text", "a"), "original": ("pair|None", None)}),
    (nl.rasterize_evidence, {"scene": ("GaussianScene", SCENE), "cameras": ("Cameras", [CAMERA]),
                             "labels": ("maps", [torch.zeros(16, 16).int()]), "num_regions": ("wholes|None", None),
                             "backend": ("word", "torch"), "rasterize_mode": ("word", "classic"),
                             "progress": ("function|None", None), "weight_power": ("whole", 1),
                             "settings": ("RasterSettings|None", None), "dtype": ("dtype|None", None)}),
    (nl.render, {"scene": ("GaussianScene", SCENE), "camera": ("Camera", CAMERA),
                 "values": ("float n c", ONES[:, None]),
                 "backend": ("word", "torch"), "rasterize_mode": ("word", "classic"),
                 "settings": ("RasterSettings|None", None), "dtype": ("dtype|None", None)}),
    (nl.contributors, {"scene": ("GaussianScene", SCENE), "camera": ("Camera", CAMERA),
                       "pixels": ("whole p 2", torch.tensor([[3, 4]])), "backend": ("word", "torch"),
                       "rasterize_mode": ("word", "classic"), "settings": ("RasterSettings|None", None)}),
    (nl.lift, {"evidence": ("Evidence", EVIDENCE), "features": ("float s d", FEATURES), "beta": ("number", 1.0),
               "unlabeled": ("word", "ignore")}),
    (nl.consensus, {"evidence": ("Evidence", EVIDENCE), "features": ("float s d", FEATURES), "power": ("number", 1.0),
                    "level": ("whole s|None", None), "sample": ("whole", 50), "least": ("number", 0.4)}),
    (nl.nearest_neighbors, {"means": ("float n 3", MEANS), "k": ("whole", 2), "of": ("whole m|None", None),
                            "progress": ("function|None", None)}),
    (nl.refine, {"means": ("float n 3", MEANS), "directions": ("float n d|function", UNIT),
                 "reliability": ("float n", ONES), "config": ("RefineConfig|None", nl.RefineConfig(k=2)),
                 "own": ("float n", ONES), "neighbors": ("Neighbors|None", None),
                 "progress": ("function|None", None)}),
    (nl.refine_variant, {"variant": ("word", "none"), "means": ("float n 3", MEANS), "lifted": ("Lifted", LIFTED),
                         "config": ("RefineConfig|None", None), "beta": ("number", 1.0)}),
    (nl.unsupported, {"neighbors": ("Neighbors", NEAR), "reliability": ("float n", ONES)}),
    (nl.relevancy, {"positive": ("float *", UNIT), "negative": ("float *|None", None), "rule": ("word", "cosine"),
                    "temperature": ("number", 10.0)}),
    (nl.SemanticField.build, {"lifted": ("Lifted", LIFTED), "means": ("float n 3", MEANS),
                              "source": ("whole n|None", None),
                              "tolerance": ("number", 1e-3), "storage": ("word", "auto"),
                              "provenance": ("dictionary|None", None)}),
    (FIELD.query, {"text_vectors": ("float q d", FEATURES), "refined": ("bool", True)}),
    (FIELD.relevancy, {"text_vectors": ("float q d", FEATURES), "negatives": ("float b d|None", None),
                       "rule": ("word", "cosine"), "refined": ("bool", True)}),
    (FIELD.directions, {"gaussians": ("whole m|None", None), "refined": ("bool", True)}),
    (FIELD.valid, {"refined": ("bool", True)}),
    (nl.SemanticField.load, {"folder": ("path", "/nowhere"), "means": ("float n 3|None", None)}),
    (nl.Neighbors, {"index": ("whole m k", NEAR.index), "distance": ("float m k", NEAR.distance),
                    "spacing": ("float m", NEAR.spacing)}),
    (nl.Contributors, {"offsets": ("whole p", MANY), "gaussian": ("whole m", MANY), "weight": ("float m", ONES)}),
    (nl.Floaters, {"score": ("float n", ONES), "mask": ("bool n", NO)}),
    (nl.Evidence.load, {"path": ("path", "/nowhere"), "key": ("text", "")}),
    (nl.Evidence.from_entries, {"parts": ("maps", []), "num_gaussians": ("whole", N), "weight_power": ("whole", 1),
                                "num_excluded": ("whole", 0)}),
    (nl.Lifted, {"scalars": ("Scalars", LIFTED.scalars), "evidence": ("Evidence", EVIDENCE),
                 "features": ("float s d", FEATURES)}),
    (LIFTED.directions, {"gaussians": ("whole m|None", None), "dtype": ("dtype|None", None)}),
    (nl.RasterSettings, {"near_plane": ("number", 0.01), "far_plane": ("number", 1e10), "eps2d": ("number", 0.3),
                         "per_axis": ("bool", False), "tile_size": ("whole", 16), "max_alpha": ("number", 0.99)}),
    (nl.RasterSettings.of_gsplat, {"version": ("text", "1.5")}),
    (nl.RasterSettings.recorded, {"manifest": ("dictionary", {})}),
    (nl.open_scene, {"load_config": ("path", "/nowhere"), "data": ("path|None", None),
                     "load_step": ("whole|None", None)}),
    (nl.open_splat, {"path": ("path", "/nowhere"),
                     "options": ("SplatOptions", nl.SplatOptions(colmap=Path("/nowhere")))}),
    (nl.connect, {"url": ("text", "http://127.0.0.1:9"), "run": ("text|None", None), "access_token": ("text", "")}),
    (nl.open_run, {"load_config": ("path", "/nowhere"), "data": ("path|None", None), "device": ("word", "cpu"),
                   "text_embeddings": ("path|None", None), "prompt_template": ("text|None", None)}),
    (nl.coverage, {"run": ("LiftedRun", None)}),
    (partial(nl.coverage, object.__new__(nl.LiftedRun)), {"min_reliability": ("number", 0.5),
                                                          "device": ("text|None", None)}),
    *((partial(method, None), arguments) for method, arguments in METHODS),
    (nl.lift_run, {"config_or_scene": ("path", "/nowhere"), "lift": ("LiftOptions|None", None),
                   "texts": ("none|None", None),
                   "queries": ("texts", ()), "load_step": ("whole|None", None), "overwrite": ("bool", False),
                   "output_dir": ("path|None", None), "device": ("word", "cpu"), "report": ("function", print)}),
    *((options, {field.name: ("option", None) for field in fields(options)}) for options in OPTIONS),
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
    """Whether a value is of a kind of the table."""
    word, *axes = kind.split()
    if word == "None":
        return value is None
    if len(axes) > 0:
        return is_array({"float": "f", "whole": "iu", "bool": "b", "uint8": "u"}[word], axes, value)
    if word == "function":
        return callable(value)
    return {
        "whole": isinstance(value, int) and not isinstance(value, bool),
        "number": isinstance(value, int | float)
        and not isinstance(value, bool)
        and not (isinstance(value, float) and math.isnan(value)),
        "bool": isinstance(value, bool),
        "text": isinstance(value, str),
        "path": isinstance(value, str | Path),
        "dictionary": isinstance(value, Mapping),
        "texts": isinstance(value, list | tuple) and all(isinstance(item, str) for item in value),
        "wholes": isinstance(value, list | tuple | range),
        "Cameras": isinstance(value, list | tuple) and len(value) == 0,
        "maps": isinstance(value, list | tuple),
        "option": not isinstance(value, Nothing) and not callable(value),
    }.get(word, False)


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
    function, arguments = data.draw(st.sampled_from(TABLE))
    name = data.draw(st.sampled_from(sorted(arguments)))
    value = data.draw(WRONG)
    assume(not any(is_kind(kind, value) for kind in arguments[name][0].split("|")))
    good = {} if function in OPTIONS else {key: one for key, (_, one) in arguments.items()}
    with pytest.raises(nl.InputError) as caught:
        function(**{**good, name: value})
    assert name in str(caught.value) or name.replace("_", "-") in str(caught.value) or "row" in str(caught.value)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@settings(max_examples=400, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_wrong_kinds_are_refused_by_name(data):
    call_with_a_wrong_value(data)


@pytest.mark.extra
@pytest.mark.usefixtures("unchecked")
@settings(max_examples=10_000, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_wrong_kinds_are_refused_by_name_in_10_000_calls(data):
    call_with_a_wrong_value(data)


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
    with pytest.raises(nl.InputError, match="reliability has 1 rows"):
        nl.unsupported(NEAR, [1.0])
    assert torch.equal(FIELD.query(FEATURES.tolist()), FIELD.query(FEATURES.numpy()))


@pytest.mark.parametrize(
    "change",
    [torch.Tensor.to_sparse, lambda x: x.to("meta"), lambda x: torch.nested.nested_tensor([x]),
     lambda x: x.to(torch.float8_e4m3fn)],
)  # fmt: skip
def test_tensors_that_are_no_arrays_are_refused(change: Callable[[torch.Tensor], torch.Tensor], unchecked) -> None:
    calls = {
        "reliability": lambda: nl.unsupported(NEAR, change(ONES)),
        "text_vectors": lambda: FIELD.query(change(FEATURES)),
        "positive": lambda: nl.relevancy(change(UNIT), change(UNIT), rule="lerf"),
        "K": lambda: nl.Camera(change(K), POSE, 16, 16),
        "means": lambda: nl.GaussianScene(change(MEANS), torch.ones(N, 4), torch.ones(N, 3), ONES),
        "features": lambda: nl.lift(EVIDENCE, change(FEATURES)),
    }
    for name, call in calls.items():
        with pytest.raises(nl.InputError, match=name):
            call()


def test_numbers_of_gaussians_are_checked() -> None:
    for wrong in ([-1], [N], [-99]):
        with pytest.raises(nl.InputError, match="gaussians"):
            EVIDENCE.select_gaussians(torch.tensor(wrong))
    for count in (-5, 10**30):
        with pytest.raises(nl.InputError, match="num_gaussians"):
            nl.Evidence.from_entries([], count)
    with pytest.raises(nl.InputError, match="size"):
        nl.Camera(K, POSE, 10**30, 16)
    with pytest.raises(nl.InputError, match="encoded"):
        EVIDENCE.save("a\ud800.safetensors")


def test_the_table_has_every_public_name():
    made = {"Answer", "Finding", "Histogram", "Why", "Coverage", "Consensus", "Scalars", "Evidence", "LiftedRun"}
    made |= {"RemoteRun"}
    named = {getattr(function, "__name__", "") for function, _ in TABLE}
    rest = {name for name in nl.__all__ if callable(getattr(nl, name))} - made - {"Scene", "InputError"}
    assert rest - named - {"SemanticField"} == set()
    assert all(is_dataclass(getattr(nl, name)) or name == "Consensus" for name in made)
