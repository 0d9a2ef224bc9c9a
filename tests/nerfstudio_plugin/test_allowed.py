"""Only what is tested here may stand in a config.yml, and only values that splatfacto can be trained with."""

from __future__ import annotations

import os
import random
import re
from copy import deepcopy
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine import optimizers, schedulers

from normlift_ns.errors import InputError
from normlift_ns.method_configs.normlift import normlift_method
from normlift_ns.nerfstudio_plugin.config import read_config
from normlift_ns.scenes.nerfstudio.allowed import PAIRS
from normlift_ns.scenes.nerfstudio.config import locate

READ = (NerfstudioDataParserConfig, ColmapDataParserConfig, BlenderDataParserConfig)


def config(method: str = "splatfacto") -> Any:
    """As ns-train saves it."""
    made: Any = deepcopy(normlift_method.config if method == "normlift" else all_methods[method])
    made.experiment_name, made.timestamp, made.data = "scene", "run", Path("scene")
    made.pipeline.datamanager.data = made.data
    return made


def written(folder: Path, made: Any) -> Path:
    path = folder / "config.yml"
    path.write_text(made if isinstance(made, str) else yaml.dump(made))
    return path


def refusal(folder: Path, made: Any) -> str:
    before = set(os.listdir(folder)) | {"config.yml"}
    with pytest.raises(InputError) as caught:
        read_config(written(folder, made))
    assert set(os.listdir(folder)) == before
    assert str(folder / "config.yml") in str(caught.value)
    assert len(str(caught.value)) < 1200
    return str(caught.value)


@pytest.mark.parametrize("method", ["splatfacto", "splatfacto-big", "normlift"])
@pytest.mark.parametrize("parser", READ)
def test_what_ns_train_saves_is_read_whole(tmp_path: Path, method: str, parser: type) -> None:
    made = config(method)
    made.pipeline.datamanager.dataparser = parser(data=Path("scene"))
    assert read_config(written(tmp_path, made)) == made


def test_optimizers_and_schedulers_of_nerfstudio_are_read(tmp_path: Path) -> None:
    made = config()
    kinds = (schedulers.CosineDecaySchedulerConfig(), schedulers.MultiStepSchedulerConfig(), None)
    for name, scheduler in zip(made.optimizers, kinds):
        made.optimizers[name] = {"optimizer": optimizers.RAdamOptimizerConfig(lr=1e-3), "scheduler": scheduler}
    assert read_config(written(tmp_path, made)) == made


@pytest.mark.parametrize("name", PAIRS)
def test_the_pairs_are_those_of_the_classes(name: str) -> None:
    module, _, attribute = name.rpartition(".")
    cls: Any = getattr(import_module(module), attribute)
    target = getattr(cls() if "Scheduler" not in name else cls, "_target", None)
    if isinstance(target, type):
        module, _, attribute = str(PAIRS[name]).rpartition(".")
        assert getattr(import_module(module), attribute) is target


@pytest.mark.parametrize("name", sorted(set(all_dataparsers) - {"nerfstudio-data", "colmap", "blender-data"}))
def test_every_other_data_parser_is_refused_by_name(tmp_path: Path, name: str) -> None:
    made = config()
    made.pipeline.datamanager.dataparser = all_dataparsers[name]
    text = refusal(tmp_path, made)
    assert type(all_dataparsers[name]).__name__ in text
    assert "data parsers nerfstudio-data, colmap and blender-data" in text


TARGETS = re.findall(r"_target: .*", yaml.dump(config("normlift")))


@pytest.mark.parametrize("number", range(len(TARGETS)))
def test_a_target_that_is_not_its_own_is_refused(tmp_path: Path, number: int) -> None:
    """At every level: by the code of a data parser that unpickles, and by one that is itself allowed elsewhere."""
    text = yaml.dump(config("normlift"))
    place = [found.start() for found in re.finditer(r"_target: ", text)][number]
    line = text[place:].splitlines()[0]
    anchor = re.search(r"&\w+ ", line)
    for target in (
        "nerfstudio.data.dataparsers.minimal_dataparser.MinimalDataParser",
        "nerfstudio.utils.writer.TensorboardWriter",
        "nerfstudio.data.dataparsers.colmap_dataparser.ColmapDataParser",
    ):
        other = f"_target: {anchor[0] if anchor else ''}!!python/name:{target} ''"
        assert target.rpartition(".")[2] in refusal(tmp_path, text[:place] + other + text[place + len(line) :])
    if anchor is None:
        assert "is NoneType, expected" in refusal(tmp_path, text[:place] + "_target: null" + text[place + len(line) :])


HOSTILE_VALUES = {
    "experiment_name": [None, 3, "", "..", "a/b", "/etc", "a\\b", "x" * 300, "a\nb", ["a"]],
    "timestamp": [None, 3, ".", "../x", "/tmp/x", True],
    "output_dir": [None, 3, "outputs"],
    "relative_model_dir": [Path("/etc"), Path("../.."), None],
    "viewer.relative_log_filename": ["../../x", "/tmp/x", None],
    "logging.relative_log_dir": [Path("/tmp"), Path("..")],
    "data": [5, ["scene"], {"a": 1}],
    "pipeline": [None, "x", {}],
    "pipeline.datamanager": [None, {}],
    "pipeline.datamanager.data": [1, "scene"],
    "pipeline.datamanager.dataparser": [None, "x"],
    "pipeline.datamanager.dataparser.data": [None, 5],
    "pipeline.datamanager.dataparser.scale_factor": [0.0, -1.0, float("nan"), float("inf"), "1", None, True],
    "pipeline.datamanager.dataparser.downscale_factor": [0, -2, 1.5, "2", True, 10**400],
    "pipeline.datamanager.dataparser.train_split_fraction": [0.0, 1.5, float("nan"), None],
    "pipeline.datamanager.dataparser.eval_interval": [0, -1, 2.5],
    "pipeline.datamanager.dataparser.eval_mode": ["some", None, 1],
    "pipeline.datamanager.camera_res_scale_factor": [0.0, -1.0, 2.0, float("inf")],
    "pipeline.model": [None, {}],
    "pipeline.model.sh_degree": ["x", -1, 5, True, 1.0, None],
    "pipeline.model.sh_degree_interval": [0, -1],
    "pipeline.model.rasterize_mode": ["fast", None, 1],
    "pipeline.model.background_color": ["pink", None, [0, 0, 0]],
    "pipeline.model.camera_optimizer": [None, {}, "off"],
    "pipeline.model.camera_optimizer.mode": ["on", False, None],
    "pipeline.lift": [None, {}],
    "pipeline.lift.max_views": [0, "all", 1.5],
    "pipeline.lift.beta": ["x", float("nan")],
    "pipeline.lift.vote": [None],
    "pipeline.lift.vote.k": [0, 1.5, None],
    "pipeline.source.encoder": [None, 5],
    "pipeline.queries": ["red", None, (1, 2), {"a": 1}],
    "machine": [None],
    "viewer.websocket_port": ["x"],
    "optimizers": [None, [], {"means": None}, {"means": {"optimizer": None, "scheduler": None}}],
    "optimizers.means": [{"optimizer": [], "scheduler": None}],
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name in HOSTILE_VALUES for value in HOSTILE_VALUES[name]]
)
def test_values_of_other_types_and_ranges_are_named(tmp_path: Path, name: str, value: object) -> None:
    made = config("normlift")
    holder = made
    *steps, last = name.split(".")
    for step in steps:
        holder = holder[step] if isinstance(holder, dict) else getattr(holder, step)
    holder.__setitem__(last, value) if isinstance(holder, dict) else object.__setattr__(holder, last, value)
    assert last in refusal(tmp_path, made)


def test_keys_that_are_missing_are_named_and_those_that_an_older_version_lacks_are_not_missed(tmp_path: Path) -> None:
    text = yaml.dump(config())
    for key in ("  datamanager", "  model", "viewer", "machine", "optimizers"):
        block = re.search(rf"^{key}:.*\n((?:{' ' * (len(key) - len(key.lstrip()) + 1)}.*\n)*)", text, re.MULTILINE)
        assert block is not None
        assert f"has no {key.strip()}" in refusal(tmp_path, text.replace(block[0], ""))
    older = re.sub(r"    use_bilateral_grid: .*\n", "", text) + "from_another_version: 3\n"
    found: Any = read_config(written(tmp_path, older))
    assert found.pipeline.model.use_bilateral_grid is False
    assert not hasattr(found, "from_another_version")


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda text: text + "timestamp: again\n", "a key stands there twice"),
        (lambda text: text + "x: " + "[" * 3000 + "]" * 3000, "nested too deeply"),
        (lambda text: text + "x: " + "[" * 3000, "no valid YAML"),
        (lambda text: text + "<<: {data: null}\n", "<< is no part"),
        (lambda text: text + "x: " + "y" * 2**18, "bytes, more than"),
        (lambda text: text + "data: *nowhere\n", "no valid YAML"),
        (lambda text: text.replace("prompt: null", "prompt: 2024-13-45", 1), "cannot be read"),
        (lambda text: text.replace("prompt: null", "prompt: " + "9" * 6000, 1), "cannot be read"),
        (lambda text: text.replace("prompt: null", "prompt: !!binary x", 1), "cannot be read"),
        (lambda text: text.replace("prompt: null", "prompt: !!python/tuple 3", 1), "cannot be read"),
        (lambda text: text.replace("prompt: null", "prompt: &a [*a]", 1), "recursive node"),
        (lambda text: text.replace("method_name: splatfacto", "method_name: ../splatfacto"), "is a run of method '../"),
        (lambda text: text.replace("method_name: splatfacto", "method_name: null"), "is a run of method 'null'"),
        (lambda text: text.replace("- scene", "- 5", 1), "is made of other things than text"),
        (lambda text: text.replace("- Train Iter (time)", "- Nothing", 1), "cannot be read"),
    ],
)
def test_odd_yaml_is_refused(tmp_path: Path, change, problem: str) -> None:
    assert problem in refusal(tmp_path, change(yaml.dump(config())))


def test_a_bomb_of_references_costs_nothing(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 30)]
    bomb = yaml.dump(config()) + "\n".join(lines)
    read_config(written(tmp_path, bomb))  # of fields that nobody has; left out
    bare = bomb.replace("\nprompt: null", "\ny: z", 1)
    assert "is a list" in refusal(tmp_path, bare + "\nprompt: *a29\n")
    assert "other things than text" in refusal(
        tmp_path, bare + "\nprompt: !!python/object/apply:pathlib.PosixPath [*a29]\n"
    )
    target = "!!python/object:nerfstudio.configs.base_config.LocalWriterConfig {_target: *a29, enable: true}"
    assert "is list, expected" in refusal(tmp_path, f"{bare}\nz: {target}\n")


def test_no_folder_is_no_config(tmp_path: Path) -> None:
    (tmp_path / "config.yml").mkdir()
    with pytest.raises(FileNotFoundError):
        read_config(tmp_path / "config.yml")
    os.mkfifo(tmp_path / "pipe.yml")
    with pytest.raises(FileNotFoundError):
        read_config(tmp_path / "pipe.yml")


def test_a_run_that_was_moved_is_lifted_below_the_current_directory(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene").mkdir()
    for place in (Path("/etc/outputs"), Path("../../outputs"), tmp_path.parent / "elsewhere"):
        made = config()
        made.output_dir = place
        location = locate(read_config(written(tmp_path, made)), tmp_path / "config.yml")
        assert location.output_dir == tmp_path / "outputs"


VALUES = ["null", "3", "-1", ".nan", "1e400", "x", "[]", "{}", "[[[]]]", "*id001", "!!python/name:os.system ''", "''"]


def damaged(text: str, seed: int) -> str:
    """Lines left out, doubled, exchanged, cut or with other values."""
    chance = random.Random(seed)
    lines = text.splitlines()
    for _ in range(chance.randint(1, 4)):
        i, j = chance.randrange(len(lines)), chance.randrange(len(lines))
        key, colon, _ = lines[i].partition(": ")
        kind = chance.randrange(5)
        if kind == 0:
            del lines[i]
        elif kind == 1:
            lines.insert(j, lines[i])
        elif kind == 2:
            lines[i] = lines[i][: chance.randrange(len(lines[i]) + 1)]
        elif kind == 3:
            lines[i], lines[j] = lines[j], lines[i]
        elif colon:
            lines[i] = f"{key}: {chance.choice(VALUES)}"
        if len(lines) < 2:
            break
    return "\n".join(lines)


TEXTS = [yaml.dump(config()), yaml.dump(config("normlift"))]
FUZZ = {"which": st.sampled_from([0, 1]), "seed": st.integers(0, 2**32)}


def no_other_error(folder: Path, which: int, seed: int) -> None:
    try:
        read_config(written(folder, damaged(TEXTS[which], seed)))
    except (InputError, FileNotFoundError) as error:
        assert "config.yml" in str(error)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(**FUZZ)
def test_damage_is_a_message(tmp_path: Path, which: int, seed: int) -> None:
    no_other_error(tmp_path, which, seed)


@pytest.mark.slow
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(**FUZZ)
def test_damage_is_always_a_message(tmp_path: Path, which: int, seed: int) -> None:
    no_other_error(tmp_path, which, seed)
