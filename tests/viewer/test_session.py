"""What a panel does, without any viewer: every action returns another session."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from plyfile import PlyData

from normlift_ns import SemanticField, lift
from normlift_ns.question import Question
from normlift_ns.runs.question import load_question
from normlift_ns.viewer.display import PARTS
from normlift_ns.viewer.session import CLICKED, MOST_PROMPTS, Session, check_prompts, split_prompts
from tests.processes import killed_at
from tests.scenes import random_evidence, unit_rows

N, D = 40, 6
BOTH = Question(("a", "b"), torch.eye(D)[:2], threshold=0.1)


@pytest.fixture(scope="module")
def session() -> Session:
    evidence = random_evidence(N, [3, 2], 0, dtype=torch.float32)
    means = torch.rand(N, 3, generator=torch.Generator().manual_seed(1))
    return Session(SemanticField.build(lift(evidence, unit_rows(5, D, 2, torch.float32)), means), means)


def test_an_answer_is_shown_for_all_prompts(session: Session) -> None:
    assert (session.chosen, session.prompts, session.report) == (None, ["all prompts"], "No query yet.")
    asked = session.ask(BOTH)
    assert session.answer is None  # never changed
    assert asked.answer is not None
    assert asked.prompts == ["all prompts", "0: a", "1: b"]
    assert torch.equal(asked.chosen, asked.answer.mask)
    assert 0 < int(asked.chosen.sum()) < N
    assert f"**{int(asked.chosen.sum())}** of {N} Gaussians selected" in asked.report
    one = asked.show(1, PARTS[2], "viridis")
    assert torch.equal(one.chosen, asked.answer["b"].mask)
    assert torch.equal(one.display.drawn, one.chosen)
    assert one.show(1, PARTS[2], "viridis") is one
    assert one.clear().prompts == ["all prompts"]


def test_the_selection_follows_the_sliders(session: Session) -> None:
    asked = session.ask(BOTH).show(0, PARTS[0], "magma")
    counts = [int(asked.reselect(threshold, 0.0).chosen.sum()) for threshold in (-2.0, 0.1, 0.5, 2.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == 0
    strict = asked.reselect(-2.0, 0.5)
    assert (session.field.scalars.reliability[strict.chosen] >= 0.5).all()
    assert (strict.shown, strict.colormap) == (0, "magma")
    assert asked.reselect(0.1, 0.0) is asked
    assert session.reselect(0.3, 0.3) is session


def test_the_threshold_stays_for_questions_of_the_same_rule(session: Session) -> None:
    assert session.ask_next(BOTH, 0.7).answer.question.threshold == 0.1
    asked = session.ask(BOTH)
    assert asked.ask_next(BOTH, 0.7).answer.question.threshold == 0.7
    lerf = Question(("a",), torch.eye(D)[:1], ("c",), torch.eye(D)[3:4], rule="lerf")
    assert asked.ask_next(lerf, 0.7).answer.question.threshold == 0.5
    clicked, _ = asked.ask_like(torch.ones(N), min_reliability=0.0, refined=True)
    assert clicked.ask_next(BOTH, 0.7).answer.question.threshold == 0.1


def test_unrefined_features_are_asked_for_the_same_prompt(session: Session) -> None:
    asked = session.ask(BOTH).show(1, PARTS[0], "turbo")
    plain = asked.use_refined(False)
    assert plain.shown == 1
    assert plain.answer.question.refined is False
    assert plain.use_refined(False) is plain
    assert session.use_refined(False) is session


def test_a_click_asks_for_what_is_similar(session: Session) -> None:
    weights = torch.zeros(N)
    weights[7], weights[9] = 0.4, 0.3
    assert bool(session.field.valid()[7])
    found, message = session.ask_like(weights, min_reliability=0.2, refined=True)
    assert found.answer.texts == (CLICKED,)
    assert message == f"Clicked Gaussian 7, reliability {float(session.field.scalars.reliability[7]):.2f}."
    cosine = session.field.directions() @ session.field.directions(torch.tensor([7]))[0]
    sure = (session.field.scalars.reliability >= 0.2) & session.field.valid()
    assert torch.equal(found.chosen, (cosine > 0.9) & sure)
    nothing, message = session.ask_like(torch.zeros(N), min_reliability=0.0, refined=True)
    assert nothing is session
    assert message == "There is nothing with semantics where you clicked."


def parameters_of(session: Session) -> dict[str, torch.Tensor]:
    return {
        "means": session.means,
        "quats": torch.ones(N, 4),
        "scales": torch.zeros(N, 3),
        "opacities": torch.zeros(N, 1),
        "features_dc": torch.zeros(N, 3),
        "features_rest": torch.zeros(N, 3, 3),
    }


def test_a_killed_export_claims_no_name(session: Session, tmp_path: Path) -> None:
    """At every access to the disk: no empty or lonely file is left once the next export has looked."""
    parameters, asked, step = parameters_of(session), session.ask(BOTH).show(1, PARTS[0], "turbo"), 0
    folder = tmp_path / "exports"

    def export() -> str:
        return asked.export(folder, parameters, spherical_harmonics=True, rasterize_mode="classic")

    expected = None
    while True:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        step += 1
        if not killed_at(step, export, folder):
            break
        export()
        found = {path.name: path.read_bytes() for path in folder.iterdir()}
        expected = expected or found
        numbers = [name[1:-4] for name in found if name.endswith(".ply")]
        assert set(found) == {f"b{number}{end}" for number in numbers for end in (".ply", "_rows.npy")}
        assert all(found[f"b{number}.ply"] == expected["b.ply"] for number in numbers)
    assert step > 10


def test_what_is_shown_is_exported_and_saved(session: Session, tmp_path: Path) -> None:
    parameters = parameters_of(session)
    asked = session.ask(BOTH).show(1, PARTS[0], "turbo")
    for name in ("b", "b_2"):  # nothing is replaced
        message = asked.export(tmp_path, parameters, spherical_harmonics=True, rasterize_mode="antialiased")
        assert message == f"{int(asked.chosen.sum())} Gaussians written to {tmp_path / f'{name}.ply'}"
        assert PlyData.read(tmp_path / f"{name}.ply")["vertex"].count == int(asked.chosen.sum())
    for empty in (session, session.ask(Question(("z",), torch.eye(D)[:1], threshold=2.0))):
        with pytest.raises(ValueError, match="Nothing is selected; there is nothing to export"):
            empty.export(tmp_path, parameters, spherical_harmonics=True, rasterize_mode="antialiased")
    faint = {**parameters, "opacities": torch.full((N, 1), -9.0)}
    with pytest.raises(ValueError, match="none of the"):  # nothing that is ever drawn; the name is free again
        asked.export(tmp_path, faint, spherical_harmonics=True, rasterize_mode="antialiased")
    assert len(list(tmp_path.iterdir())) == 4

    assert asked.save(tmp_path).startswith("Saved 2 queries in ")
    stored = load_question(tmp_path)
    assert stored is not None and (stored.texts, stored.threshold) == (("a", "b"), 0.1)
    for unsaved, folder in ((session, tmp_path), (asked, None)):
        with pytest.raises(ValueError, match="No query yet"):
            unsaved.save(folder)


def test_prompts_are_split_and_counted() -> None:
    assert split_prompts(" red mug ;; bowl\n;") == ["red mug", "bowl"]
    check_prompts(["a"] * MOST_PROMPTS)
    with pytest.raises(ValueError, match="Type what to look for"):
        check_prompts([])
    with pytest.raises(ValueError, match=f"{MOST_PROMPTS + 1} prompts; ask for {MOST_PROMPTS} at most"):
        check_prompts(["a"] * (MOST_PROMPTS + 1))
