from __future__ import annotations

import os
import re
import shutil
from pathlib import Path, PureWindowsPath

import pytest
import yaml

from normlift_ns.front_door import open_scene as load_scene
from normlift_ns.nerfstudio_plugin.config import read_config
from normlift_ns.scenes.nerfstudio import classes
from normlift_ns.scenes.nerfstudio.config import locate
from tests.nerfstudio_plugin.stock_run import StockRun, train_splatfacto, working_directory

HEADER = "!!python/object:nerfstudio.engine.trainer.TrainerConfig\nmethod_name: splatfacto\n"


def test_a_stock_config_is_read_as_nerfstudio_reads_it(stock: StockRun) -> None:
    assert read_config(stock.config) == yaml.load(stock.config.read_text(), Loader=yaml.Loader)


def test_splatfacto_big_is_read(workspace: Path) -> None:
    big = train_splatfacto(workspace, Path("scene"), method="splatfacto-big", timestamp="big")
    model = load_scene(big.config).model_config
    assert type(model) is classes.SplatfactoModelConfig
    assert model.cull_alpha_thresh == 0.005


def test_paths_of_another_operating_system_are_read(stock: StockRun, tmp_path: Path) -> None:
    text = stock.config.read_text().replace("pathlib.PosixPath", "pathlib.WindowsPath")
    (tmp_path / "config.yml").write_text(text)
    config = read_config(tmp_path / "config.yml")
    assert config.output_dir == Path("outputs")
    assert not isinstance(config.output_dir, PureWindowsPath)


@pytest.mark.parametrize("method", ["nerfacto", "splatfacto-w", "instant-ngp"])
def test_other_methods_are_refused_by_name(method: str, tmp_path: Path) -> None:
    file = tmp_path / "config.yml"
    file.write_text(
        f"!!python/object:not_installed.Config\nmethod_name: {method}\nx: !!python/name:not_installed.f ''\n"
    )
    with pytest.raises(
        ValueError, match=rf"run of method '{method}'; only Gaussians of splatfacto.*ns-train splatfacto"
    ):
        read_config(file)


def test_a_method_that_only_calls_itself_splatfacto_is_refused(stock: StockRun, tmp_path: Path) -> None:
    name = "nerfstudio.models.splatfacto.SplatfactoModelConfig"
    text = stock.config.read_text().replace(f"object:{name}", "object:nerfstudio.models.nerfacto.NerfactoModelConfig")
    (tmp_path / "config.yml").write_text(text)
    with pytest.raises(ValueError, match=r"NerfactoModelConfig is no part of a configuration"):
        read_config(tmp_path / "config.yml")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("method_name: [", "no valid YAML"),
        ("\x00\x01", "no valid YAML"),
        ("just text", "has no method_name"),
        ("", "has no method_name"),
        ("method_name: splatfacto", "has no method_name"),  # no object of nerfstudio's
        (HEADER, "TrainerConfig has no machine"),
    ],
)
def test_other_files_are_refused(text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_text(text)
    with pytest.raises(ValueError, match=rf"config\.yml .*{re.escape(problem)}"):
        read_config(tmp_path / "config.yml")


@pytest.mark.parametrize(
    "value",
    [
        "!!python/object/apply:os.system ['touch hacked']",
        "!!python/object/apply:nerfstudio.utils.scripts.run_command ['touch hacked']",
        "!!python/object/apply:nerfstudio.engine.trainer.Path.touch ['hacked']",
        "!!python/object/new:os.system ['touch hacked']",
        "!!python/object/apply:nerfstudio.engine.trainer.TrainerConfig []",
        "!!python/object:subprocess.Popen {}",
        "!!python/name:os.system ''",
        "!!python/name:nerfstudio.utils.scripts.run_command ''",
        "!!python/module:os ''",
    ],
)
def test_a_config_runs_no_code(value: str, tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_text(f"{HEADER}data: {value}\n")
    with working_directory(tmp_path), pytest.raises(ValueError, match=r"cannot be read: .*line 3"):
        read_config(tmp_path / "config.yml")
    assert os.listdir(tmp_path) == ["config.yml"]


def test_a_missing_config_is_named(stock: StockRun, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"No config at .*nowhere\.yml\. Expected the config\.yml"):
        read_config(tmp_path / "nowhere.yml")
    with pytest.raises(FileNotFoundError, match=rf"{stock.config} exists, give that"):
        read_config(stock.config.parent)


def test_files_are_found_from_the_place_of_the_config(stock: StockRun, copied: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    with working_directory(tmp_path):
        location = locate(read_config(copied), copied.relative_to(tmp_path))
    assert location.root == moved
    assert location.data == location.folder == moved / "scene"
    assert location.output_dir == moved / "outputs"
    assert not location.moved_data
    assert location.portable(moved / "outputs" / "x") == Path("outputs/x")
    assert location.portable(tmp_path) == tmp_path
    assert load_scene(copied).train.files[0] == moved / "scene" / "images" / "000.jpg"


def test_the_experiment_folder_is_not_taken_for_the_dataset(stock: StockRun) -> None:
    """outputs/scene/ exists too."""
    with working_directory(stock.workspace / "outputs"):
        assert locate(read_config(stock.config), stock.config).data == stock.workspace / "scene"


def test_a_moved_dataset_is_named_or_given(copied: Path, tmp_path: Path) -> None:
    (tmp_path / "moved" / "scene").rename(tmp_path / "elsewhere")
    with pytest.raises(FileNotFoundError, match=rf"not at {tmp_path}/moved/scene nor at .*'scene'.*--data"):
        load_scene(copied)
    with pytest.raises(FileNotFoundError, match=r"no dataset at .*/nowhere, given with --data"):
        load_scene(copied, data=tmp_path / "nowhere")
    with working_directory(tmp_path):
        for data in (Path("elsewhere"), Path("elsewhere/transforms.json")):
            run = load_scene(copied, data=data)
            assert run.location.moved_data
            assert run.location.data == tmp_path / data
            assert run.train.names[0] == "images/000.jpg"
            assert run.train[0].image.shape == (35, 47, 3)


def test_a_run_taken_out_of_its_folders_finds_its_dataset_in_the_current_directory(
    copied: Path, tmp_path: Path
) -> None:
    shutil.copytree(copied.parent, tmp_path / "alone")
    with working_directory(tmp_path / "moved"):
        location = load_scene(tmp_path / "alone" / "config.yml").location
    assert location.root is None
    assert location.moved_data
    assert location.data == tmp_path / "moved" / "scene"
    assert location.output_dir == tmp_path / "moved" / "outputs"


def test_an_absolute_output_directory_tells_no_root_but_relative_data_is_found_beside_it(
    tmp_path: Path, workspace
) -> None:
    shutil.copytree(workspace / "scene", tmp_path / "data" / "scene")

    def configure(config) -> None:
        config.output_dir = tmp_path / "data" / "runs" / "all"

    run = train_splatfacto(tmp_path / "data", Path("scene"), configure=configure)
    location = load_scene(run.config).location
    assert location.root is None
    assert location.data == tmp_path / "data" / "scene"
    assert location.output_dir == tmp_path / "data" / "runs" / "all"
    assert location.portable(location.output_dir) == location.output_dir


def test_runs_of_nerfstudios_main_branch_are_read_and_other_methods_refused_by_name(
    stock: StockRun, tmp_path: Path
) -> None:
    text, path = stock.config.read_text(), tmp_path / "config.yml"
    news = "    strategy: mcmc\n    max_gs_num: 1000000\n    noise_lr: 500000.0\n    mcmc_opacity_reg: 0.01\n"
    named = re.sub(r"^method_name: .*$", "method_name: splatfacto-mcmc", text, flags=re.MULTILINE)
    path.write_text(re.sub(r"^(  model: .*\n)", lambda found: found[1] + news, named, flags=re.MULTILINE))
    assert "strategy: mcmc" in path.read_text()
    assert read_config(path).pipeline == read_config(stock.config).pipeline
    for method in ("splatfacto-w-light", "feature-splatting", "dn-splatter"):
        path.write_text(named.replace("splatfacto-mcmc", method))
        with pytest.raises(ValueError, match=f"a run of method '{method}'; only .* splatfacto-mcmc.* --load-ply"):
            read_config(path)
    named = named.replace("splatfacto-mcmc", "splatfacto")
    path.write_text(named.replace("nerfstudio.models.splatfacto.SplatfactoModelConfig", "other.model.OtherModelConfig"))
    with pytest.raises(ValueError, match=r"other\.model\.OtherModelConfig is no part of a configuration"):
        read_config(path)
