"""Options and keywords by their names of version 0.2, which work for one version."""

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

import normlift_ns as nl
from normlift_ns.cli.batch import _capture_key
from normlift_ns.cli.check import NormLiftCheck
from normlift_ns.cli.common import parse_flags
from normlift_ns.cli.evaluate import NormLiftEval
from normlift_ns.cli.export import NormLiftExport
from normlift_ns.cli.lift import NormLift
from normlift_ns.cli.query import NormLiftQuery
from normlift_ns.cli.view import NormLiftView
from normlift_ns.data.nerfstudio.config import read_trainer_config
from normlift_ns.encoders.registry import make_encoder
from normlift_ns.errors import InputError
from normlift_ns.io.run_dir import read_manifest, write_manifest
from normlift_ns.options import VOTE_FLAGS, AskOptions, LiftOptions, SourceOptions, SplatOptions, _print_renamed
from normlift_ns.query.text_encoder import encoder_settings, text_encoder_for

VALUES = {
    **{"holdout": ("a.png",), "text_template": "a {}", "text_vectors": Path("t.npz"), "region_texts": ("mug",)},
    **{"rule": "margin", "beta": 2.0, "consensus_least": 0.1, "gsplat_rules": "1.5", "check": False, "save": True},
    **{"json": Path("a.json"), "output_path": Path("a.npz"), "why": True, "why_dir": Path("w"), "reach": 2.0},
    **{"metres_per_unit": 0.5, "part": "rest", "min_size": 3, "floater_limit": 1.0, "share_readonly": True},
    "most_drawn": 9,
}
ONE, MORE = {"load_config": Path("c.yml")}, {"load_config": Path("c.yml"), "output_dir": Path("o")}
COMMANDS = {NormLift: ONE, NormLiftCheck: ONE, NormLiftQuery: ONE, NormLiftExport: MORE, NormLiftView: ONE}
COMMANDS |= {NormLiftEval: {"load_config": (Path("c.yml"),)}}
OPTIONS = {SourceOptions: {}, SplatOptions: {}, LiftOptions: {}, AskOptions: {}, **COMMANDS}


def flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def words(values) -> list[str]:
    return [word for name, x in values.items() for word in (name, *map(str, x if isinstance(x, tuple) else (x,)))]


@pytest.mark.parametrize("options", OPTIONS)
def test_constructors_attributes_and_stored_objects_have_old_names(options):
    needed = OPTIONS[options]
    for old, new in options.old_names.items():
        with pytest.warns(DeprecationWarning, match=f"^{old} is now {new};"):
            made = options(**needed, **{old: VALUES[old]})
        with pytest.warns(DeprecationWarning, match=f"^{old} is now {new};"):
            assert getattr(made, old) == getattr(made, new) == VALUES[old] != getattr(options(**needed), new)
        with pytest.warns(DeprecationWarning, match=f"^{old} is now {new};"):
            assert replace(options(**needed), **{old: VALUES[old]}) == made
        restored = options.__new__(options)
        restored.__setstate__({old if name == new else name: value for name, value in vars(made).items()})
        assert restored == made
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = options(**needed).nothing


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_have_old_flags(command, capsys):
    _print_renamed.cache_clear()
    names = dict(command.old_names)
    if command is NormLift:
        names |= {**SourceOptions.old_names, **SplatOptions.old_names, **LiftOptions.old_names, **VOTE_FLAGS}
    if command in (NormLiftQuery, NormLiftExport):
        names |= AskOptions.old_names
    values = {old: VALUES.get(old, 0.5 if old != "k" else 7) for old in names}
    needed = words({flag(name): value for name, value in COMMANDS[command].items()})
    old = [*needed, *words({flag(name): value for name, value in values.items()})]
    made = parse_flags(command, [*needed, *words({flag(names[name]): value for name, value in values.items()})])
    assert capsys.readouterr().err == ""
    underlined = [word.replace("-", "_").replace("__", "--") for word in old]
    assert parse_flags(command, old) == parse_flags(command, underlined) == made
    told = capsys.readouterr().err.splitlines()
    for name, new in names.items():
        assert sum(line.startswith(f"{flag(name)} is now {flag(new)};") for line in told) == 1
    with pytest.raises(InputError, match="--no-check"):  # tyro knows no such flags
        parse_flags(command, [*needed, "--no-check"])


def test_functions_have_old_keywords_and_every_option_of_version_0_2_is_tried():
    assert set(VALUES) == {old for options in OPTIONS for old in options.old_names}
    run, open_run = nl.LiftedRun, {"text_vectors": "a", "text_template": "b"}
    old = {nl.open_run: open_run, nl.lift_run: {"check": False}, run.ask: {"rule": "lerf"}}
    old |= {run.export: {"reach": 1.0, "min_size": 2}, run.catalogue: {"metres_per_unit": 1.0}}
    for function, keywords in old.items():
        for name, value in keywords.items():
            with pytest.warns(DeprecationWarning, match=f"^{name} is now"), pytest.raises((AttributeError, TypeError)):
                function(*[None] * (function is run.catalogue), **{name: value})


@pytest.mark.slow
def test_ns_train_has_old_options_of_our_methods(capsys):
    from normlift_ns.method_configs import entry  # noqa: PLC0415

    _print_renamed.cache_clear()
    old = ["normlift", "--pipeline.lift.beta", "2", "--pipeline.source.text_template=a {}"]
    old += ["--pipeline.lift.vote.k", "7"]
    new = [*old[:1], "--pipeline.lift.reliability-beta", "2", "--pipeline.source.prompt-template=a {}", *old[4:]]
    assert entry._rename_flags(["/bin/ns-train", *old]) == ["/bin/ns-train", *new]
    renamed = [line.partition(" is now ")[0] for line in capsys.readouterr().err.splitlines()]
    assert renamed == [old[1], old[3].partition("=")[0]]
    for others in (["/bin/ns-viewer", *old], ["/bin/ns-train", "splatfacto", *old[1:]], ["ns-train"], []):
        assert entry._rename_flags(others) == others


def test_configs_of_version_0_2_are_read_and_new_ones_written(tmp_path):
    text = "!!python/object:normlift_ns.options.LiftOptions\nbeta: 2.5\nconsensus: true\nconsensus_least: 0.1\n"
    made = yaml.load(text, yaml.UnsafeLoader)
    assert (made.reliability_beta, made.consensus_min_agreement, made.gsplat_version) == (2.5, 0.1, "auto")
    written = yaml.dump(LiftOptions(reliability_beta=2.5, consensus_min_agreement=0.1))
    assert "\nreliability_beta: 2.5\n" in written and "\nbeta:" not in written
    assert yaml.load(written, yaml.UnsafeLoader) == LiftOptions(reliability_beta=2.5, consensus_min_agreement=0.1)
    config = Path(__file__).parent / "io/version_0_1/runs/scene/normlift/trained/config.yml"
    (tmp_path / "config.yml").write_text(config.read_text().replace("beta: 1.0\n", "beta: 2.5\n"))
    assert read_trainer_config(tmp_path / "config.yml").pipeline.lift.reliability_beta == 2.5


def test_manifests_and_keys_of_version_0_2_stay_valid(tmp_path):
    encoder = {"encoder": "colour", "encoder_model": "ViT-B-16", "encoder_pretrained": "laion2b_s34b_b88k"}
    encoder |= {"crop_fill": "black", "text_template": "{}", "text_vectors": None}
    facts = {"schema_version": 1, "num_gaussians": 1, "dimension": 343, "means_fingerprint": "", "form": "evidence"}
    facts |= {"encoder": encoder, "options": {"beta": 2.5, "gsplat_rules": "1.5"}, "source": {"region_texts": ["a"]}}
    write_manifest(tmp_path, facts, {})
    manifest, _ = read_manifest(tmp_path)
    assert manifest["options"] == {"reliability_beta": 2.5, "gsplat_version": "1.5"}
    assert manifest["source"] == {"sam3_prompts": ["a"]}
    for name in ("color", "colour"):
        assert encoder_settings(SourceOptions(encoder=name)) == encoder
    field = type("Field", (), {"manifest": manifest})
    assert text_encoder_for(field).identity == make_encoder(SourceOptions(encoder="color")).identity
    typed = "--load-ply /x.ply --colmap /c --encoder color --reliability-beta 2 --consensus-min-agreement 0.3"
    typed += " --vote-k 12 --eval-images 0.1 --gsplat-version 1.5 --check-alignment False --prompt-template {}"
    assert _capture_key(parse_flags(NormLift, typed.split())) == "495e8479442da25a"  # of version 0.2
