"""The rule for defaults, on made tables that hit every clause."""

from collections.abc import Callable
from typing import Any

import pytest

from research.rule import CHOICE, LIMITS, Cell, cells_of, decide, verdict

NAMES = ("none", "one", "two")
CELLS = [cell for scene in CHOICE for cell in cells_of(scene)]
ROOM = cells_of("third")


def table(cells=CELLS, **given: float | Callable[[Cell], float]):
    """Rows in which none has 50 points; a gain is a number or a function of the cell."""
    gains: dict[str, Any] = {"one": 0.0, "two": 0.0} | given
    return {
        cell: {"none": [48.0, 52.0]} | {
            name: [50 + float(gain(cell) if isinstance(gain, Callable) else gain)] * 2 for name, gain in gains.items()
        }
        for cell in cells
    }  # fmt: skip


def some(count, loss, gain=3.0, cells=CELLS, chosen=lambda cell: True):
    """A gain everywhere, and a loss in so many of the chosen cells."""
    struck = [cell for cell in cells if chosen(cell)][:count]
    return lambda cell: -loss if cell in struck else gain


def test_the_best_mean_wins_a_tie_goes_to_the_simpler_and_none_is_the_fallback():
    found = decide(table(one=1.0, two=2.0), NAMES)
    assert (found.default, found.choice, found.confirmed) == ("two", "two", None)
    assert found.verdicts["two"].gain == pytest.approx(2) and found.verdicts["two"].mean == pytest.approx(52)
    assert found.verdicts["none"].gain == 0 and found.verdicts["none"].eligible
    assert decide(table(one=2.0, two=2.0), NAMES).default == "one"
    assert decide(table(one=0.0, two=0.0), NAMES).default == "none"
    assert decide(table(one=-0.1, two=-0.1), NAMES).default == "none"
    everything_fails = decide(table(one=-5.0, two=lambda cell: -5.0 if cell.views == "3" else 9.0), NAMES)
    assert everything_fails.default == "none"
    assert set(everything_fails.verdicts["one"].broken) == {"undamaged", "3 views", "overall", "column"}


def test_clauses_1_and_2_undamaged_and_three_views():
    clauses = (("undamaged", 0.2, lambda cell: cell.undamaged), ("3 views", 1.0, lambda cell: cell.views == "3"))
    for name, limit, struck in clauses:
        for loss in (limit, limit + 0.01):
            found = verdict(table(one=lambda cell, loss=loss, struck=struck: -loss if struck(cell) else 9.0), "one")
            assert (found.undamaged if name == "undamaged" else found.three_views) == pytest.approx(loss)
            assert (name in found.broken) is (loss > limit)


def test_clause_3_share_of_all_cells():
    spread = [cell for i, cell in enumerate(CELLS) if i % 17 == 0]
    most = int(LIMITS.overall * len(CELLS))
    for count, holds in ((most, True), (most + 1, False)):
        found = verdict(table(one=lambda cell, n=count: -1.5 if cell in spread[:n] else 5.0), "one")
        assert found.worse == pytest.approx(count / len(CELLS))
        assert ("overall" not in found.broken) is holds
    assert verdict(table(one=some(len(CELLS), 1.0)), "one").worse == 0  # exactly 1 point is not more


def test_clause_4_share_of_a_column():
    few = [cell for cell in CELLS if cell.damage == "few views"]
    assert len(few) == 22
    for count, broken in ((4, ()), (5, ("column",))):
        found = verdict(table(one=some(count, 2.0, chosen=lambda cell: cell.damage == "few views")), "one")
        assert (found.broken, found.column) == (broken, pytest.approx(count / 22))
        assert found.column_name in ("damage few views", "views 4")
        assert (found.worst, found.worst_cell in few) == (2.0, True)


def test_rooms_confirm_or_refute_and_are_never_chosen_on():
    choice = table(one=1.0, two=2.0)
    best_in_the_room = decide(choice | table(ROOM, one=9.0, two=1.0), NAMES)
    assert (best_in_the_room.default, best_in_the_room.confirmed) == ("two", True)
    assert best_in_the_room.verdicts["one"].mean == pytest.approx(51)  # the room does not count
    for gain in (0.0, -0.5, lambda cell: -0.3 if cell.undamaged else 3.0, some(15, 2.0, cells=ROOM)):
        refuted = decide(choice | table(ROOM, one=9.0, two=gain), NAMES)
        assert (refuted.default, refuted.choice, refuted.confirmed) == ("none", "two", False)
    second = table(cells_of("second"), one=9.0, two=1.0)
    assert decide(choice | second | table(ROOM, one=9.0, two=1.0), NAMES).default == "two"
    assert decide(choice | second | table(ROOM, one=9.0, two=0.0), NAMES).default == "none"  # one room is enough
    for count, confirmed in ((3, True), (4, False)):  # 2.2 of 11 cells of a column are allowed, and one more
        room = table(ROOM, two=some(count, 2.0, cells=ROOM, chosen=lambda cell: cell.damage == "few views"))
        assert decide(table(two=2.0) | room, NAMES).confirmed is confirmed
    none = decide(table(one=-1.0, two=-1.0) | table(ROOM, one=5.0, two=5.0), NAMES)
    assert (none.default, none.confirmed) == ("none", True)


def test_a_decision_needs_cells_and_none():
    with pytest.raises(ValueError, match="tabletop or demo"):
        decide(table(ROOM), NAMES)
    with pytest.raises(ValueError, match="candidate none"):
        decide(table(), ("one", "two"))
