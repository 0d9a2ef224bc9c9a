"""The table of options: what is in no range is refused by every dataclass of options, with a message that names it."""

import math
import re
import warnings
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
import torch
import tyro

from normlift_ns import InputError, nearest_neighbors
from normlift_ns.analysis.objects import connected_components
from normlift_ns.cli.batch import NormLiftBatch
from normlift_ns.cli.check import NormLiftCheck
from normlift_ns.cli.demo import Demo
from normlift_ns.cli.evaluate import NormLiftEval
from normlift_ns.cli.export import NormLiftExport
from normlift_ns.cli.lift import NormLift
from normlift_ns.cli.query import NormLiftQuery
from normlift_ns.cli.view import NormLiftView
from normlift_ns.core.refine import MAX_VOTERS, clamp_k
from normlift_ns.evaluation.options import LerfOptions, MaskOptions, ScannetOptions
from normlift_ns.options import (
    MAX_PROMPT_LENGTH,
    OPTION_RANGES,
    AskOptions,
    LiftOptions,
    RefineConfig,
    SourceOptions,
    SplatOptions,
    check_device,
    check_number,
    check_prompt_list,
    named_as_flags,
)

OPTIONS: dict[type, dict[str, Any]] = {
    **{cls: {} for cls in (LiftOptions, RefineConfig, SourceOptions, SplatOptions, AskOptions, NormLift, Demo)},
    NormLiftCheck: {},
    **{cls: {} for cls in (ScannetOptions, LerfOptions, MaskOptions)},
    NormLiftBatch: {"captures": Path("captures.txt")},
    NormLiftQuery: {"load_config": Path("config.yml"), "text": ("red",)},
    NormLiftExport: {"load_config": Path("config.yml"), "output_dir": Path("out")},
    NormLiftView: {"load_config": Path("config.yml")},
    NormLiftEval: {"protocol": "masks", "load_config": (Path("config.yml"),), "labels": (Path("labels"),)},
}
"""With the options that have no default."""


def kinds(hint: Any) -> set[Any]:
    return set(get_args(hint)) - {type(None)} or {hint}


FIELDS = [(cls, field.name, kinds(get_type_hints(cls)[field.name])) for cls in OPTIONS for field in fields(cls)]
NUMBERS = [(cls, name, kind) for cls, name, kind in FIELDS if kind & {int, float}]
HOSTILE = [math.nan, math.inf, -math.inf, 10**400, -(10**400), 10**5000, True, False, "1", b"1", [1], {}, object(), 1j]


def test_every_number_has_a_range_and_defaults_are_in_it():
    named = {(cls, name) for cls, name, _ in NUMBERS}
    assert {name for _, name in named} == set(OPTION_RANGES)
    for cls, given_ in OPTIONS.items():
        made = cls(**given_)
        for one in fields(cls):
            if one.default is not MISSING and one.name not in given_:
                assert getattr(made, one.name) == one.default


def refused(cls: type, name: str, value: Any, words: str = "") -> None:
    """An option takes no such value; the message begins with its name."""
    with pytest.raises(InputError) as told:
        cls(**{**OPTIONS[cls], name: value})
    assert str(told.value).startswith(f"{name} {words}"), (cls, value)


def test_what_is_no_number_or_in_no_range_is_refused_and_the_ends_of_the_range_are_not():
    for cls, name, kind in NUMBERS:
        bounds = OPTION_RANGES[name]
        ends = [bounds.low - 1 - abs(bounds.low), bounds.high * 2 + 1]
        if int in kind:
            ends += [bounds.low - 1, bounds.high + 1]
        for value in [*HOSTILE, *ends, *([1.5] if kind == {int} else [])]:
            refused(cls, name, value, "must be ")
        for value in (bounds.low, bounds.high):
            number = int(value) if int in kind else float(value)
            assert getattr(cls(**{**OPTIONS[cls], name: number}), name) == number, (cls, name)


def test_values_of_other_types_are_refused():
    for cls, name, kind in FIELDS:
        if name != "eval_images":  # where a number is a share
            for value in (object(), {}, 1j, b"x", *(() if bool in kind else (True,))):
                refused(cls, name, value)


def test_a_message_names_the_flag_or_the_field_and_values_take_the_type_of_their_field():
    with pytest.raises(InputError, match=r"^sigma_d must be positive, at least 1e-06, got nan$"):
        RefineConfig(sigma_d=math.nan)
    with (
        named_as_flags(),
        pytest.raises(InputError, match=r"^--vote-sigma-d must be positive, at least 1e-06, got nan"),
    ):
        RefineConfig(sigma_d=math.nan)
    with pytest.raises(InputError, match=r"^sigma_d must be finite, got inf$"):
        RefineConfig(sigma_d=math.inf)
    vote = RefineConfig(k=np.int64(7), sigma_d=2, tau=np.float32(0.5))
    assert [type(x) for x in (vote.k, vote.sigma_d, vote.tau)] == [int, float, float]
    assert SourceOptions(regions_dir="maps").regions_dir == Path("maps")  # type: ignore[arg-type]
    assert AskOptions(negatives=["a", "b"]).negatives == ("a", "b")  # type: ignore[arg-type]
    assert SplatOptions(eval_images=0.1).eval_images == ("0.1",)  # type: ignore[arg-type]


def test_words_are_those_of_the_list_and_hold_characters_only():
    for name in ("regions", "features", "crop_fill", "features_missing"):
        for value in ("x", "", 1, None):
            refused(SourceOptions, name, value, "must be one of ")
    for name in ("precision", "image_source", "storage", "unlabeled", "weight_power"):
        refused(LiftOptions, name, 0 if name == "weight_power" else "x", "must be one of ")
    refused(RefineConfig, "vote", "mean", "must be one of ")
    for name in ("encoder", "encoder_model", "encoder_pretrained", "level", "prompt_template"):
        for value in ("a\0b", "a\udc80"):
            refused(SourceOptions, name, value)


def test_texts_and_devices_that_can_and_that_cannot_be():
    for texts, fact in (
        (["a", ""], "prompt 2 of 2 in queries"),
        ([" \n\t"], "empty"),
        (["a", "b", "a"], "prompt 3 of 3 in queries, 'a'"),
        (["a\0"], "character"),
        (["\udc80"], "character"),
        (["x" * (MAX_PROMPT_LENGTH + 1)], "10,001 characters"),
        ("red", "list"),
        ([3], "got 3"),
    ):
        with pytest.raises(InputError) as told:
            check_prompt_list("queries", texts)
        assert fact in str(told.value) and len(str(told.value)) < 300
    fine = ["x" * MAX_PROMPT_LENGTH, "[/red]", ":smile:", "$\\frac{$", "two\nlines", "\x1b[31m", "\u202eright to left"]
    check_prompt_list("text", fine)

    assert [check_device(name) for name in ("auto", "cpu", "cuda", "cuda:3")] == ["auto", "cpu", "cuda", "cuda:3"]
    for name in ("gpu", "cuda:x:", "cuda:-1", "cuda:", "cuda:99999", "cudax", "cpu:0", "", "CPU", None, "cuda:٣"):
        with pytest.raises(InputError, match="device must be"):
            check_device(name)


def test_more_neighbours_than_there_are_and_a_reach_that_cannot_be():
    means = torch.rand(6, 3, generator=torch.Generator().manual_seed(0))
    for count, most in ((6, 5), (6000, MAX_VOTERS)):
        with pytest.warns(UserWarning, match=f"k is 100,000.* {most} "):
            assert clamp_k(RefineConfig(k=100_000), count).k == most
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept = clamp_k(RefineConfig(), 6000)
        given = kept.numbers._asdict() | {"tau": None, "gamma": None}  # which may still be measured
    assert kept == replace(RefineConfig(), **given)  # the defaults in numbers
    for k, message in ((100_000, "k must be at most 1,024, got 100,000"), (0, "k .* 0")):
        with pytest.raises(InputError, match=message):
            nearest_neighbors(means, k)
    with pytest.raises(InputError, match="object_max_gap must be"):
        connected_components(means, means[:, 0] >= 0, max_gap=0.0)
    assert check_number("object_max_gap", 4) == 4.0


@dataclass
class Pipeline:
    lift: LiftOptions = field(default_factory=LiftOptions)


def test_options_within_options_of_a_command_are_a_message(monkeypatch, capsys):
    """As in ns-train normlift, which reads its flags with tyro, before it trains."""
    monkeypatch.setitem(LiftOptions.__annotations__, "vote", RefineConfig)  # as before a command of ours has named it
    monkeypatch.setitem(RefineConfig.__annotations__, "sigma_d", "float | None")
    with pytest.raises(SystemExit) as stop:
        tyro.cli(Pipeline, args=["--lift.vote.sigma-d", "nan"])
    shown = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert stop.value.code != 0
    assert re.search("sigma_d must be .* 1e-06, got nan", shown) and "Traceback" not in shown


def test_sam3_without_prompts_looks_for_the_queries():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = SourceOptions(regions="sam3").looking_for(["mug", "bowl"])
    assert found.sam3_prompts == ("mug", "bowl")
    own = SourceOptions(regions="sam3", sam3_prompts=("fox",))
    assert own.looking_for(["mug"]) == own
