"""Pictures of --render-dir: their names, what their pixels mean, and texts that are drawn as they are."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from normlift_ns.errors import InputError
from normlift_ns.rendering import figures
from tests.test_pipeline import HEIGHT, WIDTH, scene

SHEET = figures.FigureStyle("viridis", (0.0, 1.0), 0.5)


def test_pictures_that_would_replace_each_other_are_refused(tmp_path: Path) -> None:
    for names, texts, twice in (
        (("a.png", "a_0_x.png"), ("x 1 y", "y"), "a_0_x_1_y"),
        (("contact_sheet.png", "b.png"), ("x",), "contact_sheet_0_x"),
    ):
        made, answer = scene(*names), SimpleNamespace(texts=texts)
        with pytest.raises(InputError, match=rf"{twice}\.png"):
            figures.save_overlays(made, answer, figures.training_cameras(made), tmp_path)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_a_text_is_drawn_as_it_is() -> None:
    sizes = ((HEIGHT, WIDTH), (1, 300), (300, 1))
    for i, text in enumerate((r"$\frac{$", "$", "a\nb", "[/red]", "\ud800", "x\0y", "", "x" * 3000, "מים")):
        size = sizes[i % 3]
        image, selected = torch.zeros(*size, 3, dtype=torch.uint8), torch.zeros(size, dtype=torch.bool)
        found = figures.FigureHeader(text, "x" * 300)
        assert figures.view_figure(SHEET, found, text, image, image, selected).size[0] > 500, text
        panel = Image.new("RGB", (size[1], size[0]))
        assert figures.contact_sheet(SHEET, found, [panel] * 5, [text] * 5).size[0] > 500, text


def test_the_outline_goes_around_what_is_selected_and_the_photograph_stands_beside_it() -> None:
    red, blue = torch.tensor([200, 10, 10], dtype=torch.uint8), torch.tensor([10, 90, 200], dtype=torch.uint8)
    photograph, overlay = red.expand(60, 80, 3).contiguous(), blue.expand(60, 80, 3).contiguous()
    selected = torch.zeros(60, 80, dtype=torch.bool)
    selected[20:40, 20:60] = True
    page = np.asarray(figures.view_figure(SHEET, figures.FigureHeader("x", "y"), "0001", photograph, overlay, selected))
    left, right = page[:, :656], page[:, 656:]
    assert (left == red.numpy()).all(axis=2).sum() == 640 * 480
    inside = (right == blue.numpy()).all(axis=2)
    rows, columns = np.nonzero(inside)
    found = inside[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    assert found.shape == (480, 640)
    line = ~found
    rows, columns = np.nonzero(line)
    assert abs(rows.min() - 160) <= 4 and abs(rows.max() - 319) <= 4
    assert abs(columns.min() - 160) <= 4 and abs(columns.max() - 479) <= 4
    assert found[240, 320] and 3 * 900 < line.sum() < 7 * 1100  # a closed line of 3 to 7 pixels
    none = np.asarray(
        figures.view_figure(SHEET, figures.FigureHeader("x", "y"), "0001", None, overlay, ~selected & selected)
    )
    assert (none == blue.numpy()).all(axis=2).sum() == 640 * 480


def test_the_title_says_how_much_and_on_what_evidence() -> None:
    scalars = SimpleNamespace(weight=torch.ones(4), n_eff=torch.full((4,), 3.0), reliability=torch.full((4,), 0.5))
    answer = SimpleNamespace(field=SimpleNamespace(scalars=scalars), question=SimpleNamespace(threshold=0.5))
    finding: Any = SimpleNamespace(
        text="x", answer=answer, mask=torch.tensor([True, False, True, False]), fraction=0.5, mean_reliability=0.5,
        peak=0.9, verdict="found",
    )  # fmt: skip
    for facts in ("50.0 %", "R 0.50", "3.0 views", "100 %", "R < 0.6"):
        assert facts in figures.FigureHeader.of(finding).summary
    finding.mask = torch.zeros(4, dtype=torch.bool)
    assert re.fullmatch(r"[^\d]* 0\.5; [^\d]* 0\.90", figures.FigureHeader.of(finding).summary)  # threshold and peak
    for verdict in ("found", "probably not here", None):  # None: nobody can tell
        finding.verdict = verdict
        assert figures.FigureHeader.of(finding).title.split("   ·   ") == ["x", verdict][: 1 + (verdict is not None)]
