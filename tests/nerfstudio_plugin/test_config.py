import re
import shutil
from pathlib import Path, PureWindowsPath

import pytest

from normlift_ns.data.nerfstudio.config import locate_run, read_trainer_config
from tests.nerfstudio_plugin.conftest import opened
from tests.nerfstudio_plugin.stock_run import StockRun, working_directory
from tests.nerfstudio_plugin.test_allowed import refusal

HEADER = "!!python/object:nerfstudio.engine.trainer.TrainerConfig\nmethod_name: splatfacto\n"


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


def test_runs_of_nerfstudios_main_branch_are_read(stock: StockRun, tmp_path: Path) -> None:
    text, path = stock.config.read_text(), tmp_path / "config.yml"
    news = "    strategy: mcmc\n    max_gs_num: 1000000\n    noise_lr: 500000.0\n    mcmc_opacity_reg: 0.01\n"
    named = re.sub("(?m)^method_name: .*$", "method_name: splatfacto-mcmc", text)
    path.write_text(re.sub("(?m)^(  model: .*\n)", lambda found: found[1] + news, named))
    assert "strategy: mcmc" in path.read_text()
    assert read_trainer_config(path).pipeline == read_trainer_config(stock.config).pipeline


def test_other_files_are_refused(stock: StockRun, tmp_path: Path) -> None:
    for text, problem in (
        ("\x00\x01", "YAML"),
        ("", "no method_name"),
        ("method_name: splatfacto", "no method_name"),  # not an object of nerfstudio's
    ):
        assert re.search(problem, refusal(tmp_path, text))
    with pytest.raises(FileNotFoundError, match=r"nowhere\.yml"):
        read_trainer_config(tmp_path / "nowhere.yml")
    with pytest.raises(FileNotFoundError, match=f"{stock.config}; give"):
        read_trainer_config(stock.config.parent)


def test_a_config_runs_no_code(tmp_path: Path) -> None:
    for value in (
        "object/apply:os.system ['touch hacked']",
        "object/apply:nerfstudio.engine.trainer.Path.touch ['hacked']",
        "object/new:os.system ['touch hacked']",
        "object/apply:nerfstudio.engine.trainer.TrainerConfig []",
        "object:subprocess.Popen {}",
        "name:nerfstudio.utils.scripts.run_command ''",
        "module:os ''",
    ):
        with working_directory(tmp_path):
            assert "line 3" in refusal(tmp_path, f"{HEADER}data: !!python/{value}\n")


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


def test_beside_an_absolute_output_directory_relative_data_is_found(copied: Path) -> None:
    config, moved = read_trainer_config(copied), copied.parents[4]
    config.output_dir = moved / "runs" / "all"
    location = locate_run(config, config.output_dir / copied.relative_to(moved / "outputs"))
    assert (location.root, location.data, location.data_moved) == (None, moved / "scene", True)
    assert location.output_dir == location.relative_to_root(config.output_dir) == config.output_dir


def test_a_moved_dataset_is_named_or_given(copied: Path, tmp_path: Path) -> None:
    (tmp_path / "moved" / "scene").rename(tmp_path / "elsewhere")
    with pytest.raises(FileNotFoundError, match=f"{tmp_path}/moved/scene or .*'scene'.*--data"):
        opened(copied)
    with pytest.raises(FileNotFoundError, match=r"/nowhere, given with --data"):
        opened(copied, data=tmp_path / "nowhere")
    with working_directory(tmp_path):
        for data in (Path("elsewhere"), Path("elsewhere/transforms.json")):
            run = opened(copied, data=data)
            assert (run.location.data_moved, run.location.data) == (True, tmp_path / data)
            assert (run.train.names[0], run.train[0].image.shape) == ("images/000.jpg", (35, 47, 3))
