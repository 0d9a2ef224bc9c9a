"""Only what is tested here may stand in a config.yml, and only values that splatfacto can be trained with."""

import os
import re
import shutil
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path, PureWindowsPath
from pkgutil import resolve_name
from typing import Any

import pytest
import yaml

from normlift_ns.data.nerfstudio.config import (
    CONFIG_TARGETS,
    check_config_values,
    dump_config,
    locate_run,
    read_trainer_config,
)
from normlift_ns.errors import InputError
from tests.hostile import damaged, fuzz
from tests.nerfstudio_plugin.conftest import opened, read
from tests.nerfstudio_plugin.stock_run import StockRun, working_directory


@pytest.fixture(scope="module")
def config(nerfstudio: Any) -> Callable[..., Any]:
    """Makes a config as ns-train saves it: `config(method)`."""
    from normlift_ns.method_configs.normlift import normlift_method  # noqa: PLC0415

    def make(method: str = "splatfacto") -> Any:
        made = deepcopy(normlift_method.config if method == "normlift" else nerfstudio.all_methods[method])
        made.experiment_name, made.timestamp, made.data = "scene", "run", Path("scene")
        made.pipeline.datamanager.data = made.data
        return made

    return make


@pytest.fixture(scope="module")
def texts(config: Any) -> tuple[str, str]:
    """A config.yml of splatfacto, and one of normlift."""
    return yaml.dump(config()), yaml.dump(config("normlift"))


def written(folder: Path, made: Any) -> Path:
    path = folder / "config.yml"
    path.write_text(made if isinstance(made, str) else yaml.dump(made))
    return path


def refusal(folder: Path, made: Any) -> str:
    before = set(os.listdir(folder)) | {"config.yml"}
    with pytest.raises(InputError) as caught:
        read_trainer_config(written(folder, made))
    assert set(os.listdir(folder)) == before
    assert str(folder / "config.yml") in str(caught.value)
    assert len(str(caught.value)) < 1200
    return str(caught.value)


def test_what_ns_train_saves_is_read_whole(tmp_path: Path, config: Any) -> None:
    from nerfstudio.engine import optimizers, schedulers  # noqa: PLC0415

    kinds = (schedulers.CosineDecaySchedulerConfig(), schedulers.MultiStepSchedulerConfig(), None)
    methods = {"splatfacto": "nerfstudio:Nerfstudio", "splatfacto-big": "colmap:Colmap", "normlift": "blender:Blender"}
    for method, parser in methods.items():
        made, (module, name) = config(method), parser.split(":")
        cls = resolve_name(f"nerfstudio.data.dataparsers.{module}_dataparser:{name}DataParserConfig")
        made.pipeline.datamanager.dataparser = cls(data=Path("scene"))
        for group, scheduler in zip(made.optimizers, kinds if method == "splatfacto" else ()):
            made.optimizers[group] = {"optimizer": optimizers.RAdamOptimizerConfig(lr=1e-3), "scheduler": scheduler}
        assert read(written(tmp_path, made)) == made, method


def test_the_pairs_are_those_of_the_classes() -> None:
    for name, pair in CONFIG_TARGETS.items():
        cls: Any = resolve_name(":".join(name.rsplit(".", 1)))
        target = getattr(cls() if "Scheduler" not in name else cls, "_target", None)
        assert not isinstance(target, type) or resolve_name(":".join(str(pair).rsplit(".", 1))) is target, name


def test_a_target_that_is_not_its_own_is_refused(tmp_path: Path, texts: tuple[str, str]) -> None:
    text, modules = texts[1], "nerfstudio.data.dataparsers"
    targets = [f"{modules}.minimal_dataparser.MinimalDataParser", "nerfstudio.utils.writer.TensorboardWriter"]
    targets.append(f"{modules}.colmap_dataparser.ColmapDataParser")  # which is allowed elsewhere
    found = list(re.finditer(r"_target: (&\w+ )?.*", text))
    assert len(found) > 15
    for number, place in enumerate(found):
        target = targets[number % 3]
        other = f"_target: {place[1] or ''}!!python/name:{target} ''"
        problem = refusal(tmp_path, text[: place.start()] + other + text[place.end() :])
        assert target.rpartition(".")[2] in problem, place[0]
    place = next(place for place in found if place[1] is None)
    assert "NoneType" in refusal(tmp_path, text[: place.start()] + "_target: null" + text[place.end() :])


PARSER, MODEL, NAN = "pipeline.datamanager.dataparser", "pipeline.model", float("nan")
HOSTILE_VALUES: dict[str, list[object]] = {
    "experiment_name": [None, 3, "", "..", "a/b", "/etc", "a\\b", "x" * 256, "a\nb", "a\0b", ["a"]],
    "timestamp": [None, 3, ".", "../x", "/tmp/x", True],
    "output_dir": [None, 3, "outputs"],
    "relative_model_dir": [Path("/etc"), Path("../.."), None],
    "viewer.relative_log_filename": ["../../x", "/tmp/x", None],
    "logging.relative_log_dir": [Path("/tmp"), Path("..")],
    "data": [5, ["scene"], {"a": 1}],
    "pipeline": [None, "x", {}],
    "pipeline.datamanager.data": [1, "scene"],
    PARSER: [None, "x"],
    f"{PARSER}.data": [None, 5],
    f"{PARSER}.scale_factor": [0.0, -1.0, NAN, float("inf"), "1", None, True],
    f"{PARSER}.downscale_factor": [0, -2, 1.5, "2", True, 1025, 10**400],
    f"{PARSER}.train_split_fraction": [0.0, 1.01, NAN, None],
    f"{PARSER}.eval_interval": [0, -1, 2.5],
    "pipeline.datamanager.camera_res_scale_factor": [0.0, -1.0, 1.01, float("inf")],
    MODEL: [None, {}],
    f"{MODEL}.sh_degree": ["x", -1, 5, True, 1.0, None],
    f"{MODEL}.sh_degree_interval": [0, -1],
    f"{MODEL}.rasterize_mode": ["fast", None, 1],
    f"{MODEL}.background_color": ["pink", None, [0, 0, 0]],
    f"{MODEL}.camera_optimizer.mode": ["on", False, None],
    "pipeline.lift.max_views": [0, "all", 1.5],
    "pipeline.queries": ["red", None, (1, 2), {"a": 1}],
    "optimizers": [None, [], {"means": None}, {"means": {"optimizer": None, "scheduler": None}}],
    "optimizers.means": [{"optimizer": [], "scheduler": None}],
}


def test_values_of_other_types_and_ranges_are_named(tmp_path: Path, texts: tuple[str, str]) -> None:
    made, path = read_trainer_config(written(tmp_path, texts[1])), tmp_path / "config.yml"
    for name, values in HOSTILE_VALUES.items():
        holder: Any = made
        *steps, last = name.split(".")
        for step in steps:
            holder = holder[step] if isinstance(holder, dict) else getattr(holder, step)
        fields = holder if isinstance(holder, dict) else vars(holder)
        before = fields[last]
        for value in values:
            fields[last] = value
            with pytest.raises(InputError) as caught:
                check_config_values(made, path)
            message = str(caught.value)
            assert last in message and str(path) in message and len(message) < 1200, (name, value)
        fields[last] = before
    check_config_values(made, path)
    made.pipeline.model.sh_degree = made.pipeline.datamanager.dataparser.downscale_factor = 4
    made.pipeline.model.sh_degree_interval = made.pipeline.datamanager.dataparser.eval_interval = 1
    made.pipeline.datamanager.camera_res_scale_factor = made.pipeline.datamanager.dataparser.train_split_fraction = 1.0
    check_config_values(made, path)  # the ends of the ranges
    assert "sh_degree" in refusal(tmp_path, re.sub(r"sh_degree: \d", "sh_degree: 9", texts[1]))


def test_missing_keys_are_named_unless_an_older_version_lacks_them(tmp_path: Path, texts: tuple[str, str]) -> None:
    text = texts[0]
    for key in ("  datamanager", "  model", "viewer", "machine", "optimizers"):
        block = re.search(rf"^{key}:.*\n((?:{' ' * (len(key) - len(key.lstrip()) + 1)}.*\n)*)", text, re.MULTILINE)
        assert block is not None
        assert f"has no {key.strip()}" in refusal(tmp_path, text.replace(block[0], ""))
    older = re.sub(r"    use_bilateral_grid: .*\n", "", text) + "from_another_version: 3\n"
    older = older.replace("method_name: splatfacto", "method_name: splatfacto-mcmc")  # of nerfstudio's main branch
    found = read(written(tmp_path, older))
    assert found.pipeline.model.use_bilateral_grid is False
    assert not hasattr(found, "from_another_version")
    newer, count = re.subn(r"(?m)^( +)(sigma_d: .*\n|max_views: .*\n)", r"\1\2\1from_another_version: 3\n", texts[1])
    assert count == 2 and "from_another_version" not in dump_config(read_trainer_config(written(tmp_path, newer)))


def test_odd_yaml_is_refused(tmp_path: Path, texts: tuple[str, str]) -> None:
    text = texts[0]
    added = {
        "timestamp: again": "twice",
        "x: " + "[" * 800 + "]" * 800: "nested too deeply",
        "<<: {data: null}": "<<",
        "x: " + "y" * 2**18: f"{2**18:,}",
        "data: *nowhere": "YAML",
    }
    for line, problem in added.items():
        assert problem in refusal(tmp_path, f"{text}{line}\n"), line[:40]
    exchanged = {
        ("prompt: null", "prompt: 2024-13-45"): "cannot be read",
        ("prompt: null", "prompt: !!python/tuple 3"): "cannot be read",
        ("prompt: null", "prompt: &a [*a]"): "recursive",
        ("method_name: splatfacto", "method_name: ../splatfacto"): "'../splatfacto'",
        ("- scene", "- 5"): "are not text",
        ("- Train Iter (time)", "- Nothing"): "cannot be read",
    }
    for (old, new), problem in exchanged.items():
        assert old in text
        assert problem in refusal(tmp_path, text.replace(old, new, 1)), new[:40]


def test_a_bomb_of_references_costs_nothing(tmp_path: Path, texts: tuple[str, str]) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 30)]
    bomb = texts[0] + "\n".join(lines)
    read_trainer_config(written(tmp_path, bomb))  # of fields that nobody has; left out
    bare = bomb.replace("\nprompt: null", "\ny: z", 1)
    target = "!!python/object:nerfstudio.configs.base_config.LocalWriterConfig {_target: *a29, enable: true}"
    for line, problem in (
        ("prompt: *a29", "is a list"),
        ("prompt: !!python/object/apply:pathlib.PosixPath [*a29]", "are not text"),
        (f"z: {target}", "is list, expected"),
    ):
        assert problem in refusal(tmp_path, f"{bare}\n{line}\n"), line


def test_damage_is_a_message(tmp_path: Path, texts: tuple[str, str]) -> None:
    path = tmp_path / "config.yml"
    for text in texts:
        fuzz(5, damaged(text.encode()), path, lambda: read(path))


def test_a_config_of_another_operating_system_is_read(stock: StockRun, tmp_path: Path) -> None:
    path = tmp_path / "config.yml"
    path.write_text(stock.config.read_text().replace("pathlib.PosixPath", "pathlib.WindowsPath"))
    output_dir = read_trainer_config(path).output_dir
    assert output_dir == Path("outputs") and not isinstance(output_dir, PureWindowsPath)


def test_other_methods_are_refused_by_name(stock: StockRun, tmp_path: Path) -> None:
    text = stock.config.read_text()
    for method in ("nerfacto", "splatfacto-w", "instant-ngp"):
        unknown = f"!!python/object:not_installed.Config\nmethod_name: {method}\nx: !!python/name:not_installed.f ''\n"
        told = refusal(tmp_path, unknown)
        assert re.search(f"'{method}'.* splatfacto-mcmc.*ns-train splatfacto.* --load-ply", told)
    for method in ("splatfacto-w-light", "feature-splatting", "dn-splatter"):
        told = refusal(tmp_path, re.sub("(?m)^method_name: .*$", f"method_name: {method}", text))
        assert re.search(f"'{method}'.* splatfacto-mcmc", told)
    for other in ("nerfstudio.models.nerfacto.NerfactoModelConfig", "other.model.OtherModelConfig"):
        assert other in refusal(tmp_path, text.replace("nerfstudio.models.splatfacto.SplatfactoModelConfig", other))


def test_other_files_are_refused(stock: StockRun, tmp_path: Path) -> None:
    for text, problem in (
        ("\x00\x01", "YAML"),
        ("", "no method_name"),
        ("method_name: splatfacto", "no method_name"),  # not an object of nerfstudio's
    ):
        assert re.search(problem, refusal(tmp_path, text))
    (tmp_path / "folder.yml").mkdir()
    os.mkfifo(tmp_path / "pipe.yml")
    for name in ("nowhere.yml", "folder.yml", "pipe.yml"):
        with pytest.raises(FileNotFoundError, match=name):
            read_trainer_config(tmp_path / name)
    with pytest.raises(FileNotFoundError, match=f"is not a file; give {stock.config}"):
        read_trainer_config(stock.config.parent)


def test_a_config_runs_no_code(tmp_path: Path) -> None:
    header = "!!python/object:nerfstudio.engine.trainer.TrainerConfig\nmethod_name: splatfacto\n"
    for value in (
        "object/apply:os.system ['touch hacked']",
        "object/new:os.system ['touch hacked']",
        "object/apply:nerfstudio.engine.trainer.TrainerConfig []",
        "object:subprocess.Popen {}",
        "name:nerfstudio.utils.scripts.run_command ''",
        "module:os ''",
    ):
        with working_directory(tmp_path):
            assert "line 3" in refusal(tmp_path, f"{header}data: !!python/{value}\n")


def test_files_are_found_from_the_place_of_the_config(stock: StockRun, copied: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    with working_directory(tmp_path):
        location = locate_run(read_trainer_config(copied), copied.relative_to(tmp_path))
    assert (location.root, location.output_dir, location.data_moved) == (moved, moved / "outputs", False)
    assert location.data == location.folder == moved / "scene"
    assert location.relative_to_root(moved / "outputs" / "x") == Path("outputs/x")
    assert location.relative_to_root(tmp_path) == tmp_path
    assert opened(copied).train.files[0] == moved / "scene" / "images" / "000.jpg"
    with working_directory(stock.workspace / "outputs"):  # outputs/scene/ is the experiment, not the dataset
        assert locate_run(read_trainer_config(stock.config), stock.config).data == stock.workspace / "scene"
    shutil.copytree(copied.parent, tmp_path / "alone")  # out of its folders
    with working_directory(moved):
        location = opened(tmp_path / "alone" / "config.yml").location
    assert (location.root, location.data_moved) == (None, True)
    assert (location.data, location.output_dir) == (moved / "scene", moved / "outputs")


def test_beside_an_absolute_output_directory_relative_data_is_found_and_others_are_not_used(copied: Path) -> None:
    config, moved = read_trainer_config(copied), copied.parents[4]
    config.output_dir = moved / "runs" / "all"
    location = locate_run(config, config.output_dir / copied.relative_to(moved / "outputs"))
    assert (location.root, location.data, location.data_moved) == (None, moved / "scene", True)
    assert location.output_dir == location.relative_to_root(config.output_dir) == config.output_dir
    for place in (Path("/etc/outputs"), Path("../../outputs")):  # where the run does not lie
        config.output_dir = place
        with working_directory(moved):
            assert locate_run(config, copied.with_name("config.yml")).output_dir == moved / "outputs"


def test_a_moved_dataset_is_named_or_given(copied: Path, tmp_path: Path) -> None:
    (tmp_path / "moved" / "scene").rename(tmp_path / "elsewhere")
    with pytest.raises(FileNotFoundError, match=f"{tmp_path}/moved/scene.*'scene'.*--data"):
        opened(copied)
    with pytest.raises(FileNotFoundError, match=r"/nowhere, given with --data"):
        opened(copied, data=tmp_path / "nowhere")
    with working_directory(tmp_path):
        for data in (Path("elsewhere"), Path("elsewhere/transforms.json")):
            run = opened(copied, data=data)
            assert (run.location.data_moved, run.location.data) == (True, tmp_path / data)
            assert (run.train.names[0], run.train[0].image.shape) == ("images/000.jpg", (35, 47, 3))
