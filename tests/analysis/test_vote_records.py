"""The votes of a lifted run, opened again from the run and its cache."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

import normlift_ns as nl
from normlift_ns.analysis.explain import RecordedVotes
from normlift_ns.core.lowrank import StoredEvidence
from normlift_ns.demo.room import DemoRoom


@pytest.fixture(scope="module", params=["evidence", "float16"])
def run(request, trained: Path, made_once) -> nl.LiftedRun:
    """A run that holds its evidence, and one that leaves it in the cache."""

    def make(folder: Path) -> None:
        options = nl.LiftOptions(storage=request.param, max_views=6, consensus=request.param == "float16")
        source = nl.SourceOptions(encoder="color")
        nl.lift_run(trained, source=source, lift=options, output_dir=folder, timestamp="one", check_alignment=False)

    return nl.open_run(next(made_once(f"votes-{request.param}", make).glob("*/normlift/one/config.yml")))


def test_the_votes_are_those_of_the_lift(run: nl.LiftedRun) -> None:
    seen = (run.field.scalars.norm > 0).nonzero().squeeze(1)
    for j in seen[:: len(seen) // 8].tolist():
        mask = torch.zeros(len(run.field), dtype=torch.bool)
        mask[j] = True
        why = run.votes.explain(mask, refined=False)
        for name in ("norm", "c_intra", "c_inter", "n_eff", "reliability"):
            assert getattr(why, name) == pytest.approx(float(getattr(run.field.scalars, name)[j]), abs=2e-5), name
        assert sum(vote.weight for vote in why.views) == pytest.approx(float(run.field.scalars.weight[j]), rel=1e-4)
        assert len(why.views) == int(run.field.scalars.view_count[j])


def test_a_finding_is_explained_with_the_evidence_that_the_vote_gave_it(run: nl.LiftedRun) -> None:
    red = run.ask("red")["red"]
    why = run.why(red)
    own, used = (run.field.directions(red.mask.nonzero().squeeze(1), refined=x) for x in (False, True))
    changed = float(((own * used).sum(dim=1) < 0.98).float().mean())
    assert why.changed == pytest.approx(changed, abs=0.01)
    assert 0 < why.changed < 1
    assert run.why(run.ask("red", refined=False)).changed == 0
    assert why.c_inter > 0.9 and len(why.words) > 0
    with pytest.raises(nl.InputError, match="part "):
        run.why("red")  # type: ignore[arg-type]
    with pytest.raises(nl.InputError, match="nothing is selected"):
        run.why(torch.zeros(len(run.field), dtype=torch.bool))


def test_pictures_outline_what_is_red(run: nl.LiftedRun) -> None:
    why = run.why(run.ask("red")["red"])
    pictures = list(run.votes.pictures(why.views[:3]))
    assert [picture.name for picture in pictures] == [run.votes.names[vote.view] for vote in why.views[:3]]
    for picture in pictures:
        place = list(run.scene.train.names).index(picture.name)
        photograph = run.scene.train[place].image
        line = (picture.image == torch.tensor([255, 176, 0])).all(dim=2)
        assert 10 < int(line.sum()) < 0.3 * line.numel()
        inside = photograph[(picture.image == photograph).all(dim=2) & (photograph > 0).any(dim=2)].float()
        assert float((inside[:, 0] > inside[:, 1] + 40).float().mean()) > 0.5  # most of what is not dimmed is red


def test_what_the_cache_no_longer_holds_is_named(run: nl.LiftedRun, tmp_path: Path) -> None:
    mask = run.ask("red").mask
    votes = RecordedVotes(run.scene, run.field, tmp_path / "emptied")
    if isinstance(run.field.store, StoredEvidence):
        assert votes.explain(mask).views == run.why(run.ask("red")).views
        return
    with pytest.raises(nl.InputError, match=r"emptied/evidence .*ns-normlift"):
        votes.explain(mask)
    assert list(tmp_path.iterdir()) == []


def test_photographs_that_are_gone_replaced_or_unknown_are_named(run, trained: Path, tmp_path: Path) -> None:
    names = run.field.manifest["views_lifted"]
    for told, message in ((None, "not record"), ([1], "not record"), ([*names, "x.png"], r"1 of 7 .*x\.png")):
        other = replace(run.field, manifest={**run.field.manifest, "views_lifted": told})
        with pytest.raises(nl.InputError, match=message):
            _ = RecordedVotes(run.scene, other, tmp_path).names
    if not isinstance(run.field.store, StoredEvidence):
        return  # such a run finds its evidence by the content of the photographs
    fewer = replace(run.field, manifest={**run.field.manifest, "views_lifted": names[:-1]})
    with pytest.raises(nl.InputError, match=r" 5 .* 6"):
        _ = RecordedVotes(run.scene, fewer, tmp_path).names
    for option in ("reliability_beta", "unlabeled"):
        wrong = replace(run.field, manifest={**run.field.manifest, "options": {option: [1]}})
        with pytest.raises(nl.InputError, match=f"damaged: .*{option} is"):
            RecordedVotes(run.scene, wrong, tmp_path).explain(run.ask("red").mask)
    moved = shutil.copytree(trained.parents[4] / "room", tmp_path / "room")
    opened = nl.open_run(run.config, data=moved)
    first = opened.why(opened.ask("red")).views[0]
    file = moved / opened.votes.names[first.view]
    Image.new("RGB", Image.open(file).size, "green").save(file)
    with pytest.raises(nl.InputError, match="regions"):
        list(opened.votes.pictures([first]))
    file.unlink()
    with pytest.raises((nl.InputError, FileNotFoundError), match=file.name):
        list(opened.votes.pictures([first]))


def test_features_of_ones_own_have_votes_but_no_pictures(trained: Path, room: DemoRoom, tmp_path: Path) -> None:
    scene = nl.open_scene(trained)
    halves = [(torch.arange(160).expand(120, 160) // 80, torch.eye(2)) for _ in scene.train.names]
    how = {"lift": nl.LiftOptions(storage="evidence", refine=False), "output_dir": tmp_path, "check": False}
    run = nl.lift_run(scene, features=halves, texts={"left": torch.tensor([1.0, 0.0])}, **how)
    found = run.ask("left")
    assert 0 < int(found.mask.sum()) < len(found.mask)  # cosines of an unknown encoder: the threshold is suggested
    why = run.why(found)
    assert {one.region for vote in why.views for one in vote.regions} == {0, 1}
    with pytest.raises(nl.InputError, match="Python"):
        list(run.votes.pictures(why.views[:1]))
