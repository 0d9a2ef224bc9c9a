"""Reads what is typed into the panel, with the encoder of the run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any

from normlift_ns.core.field import SemanticField
from normlift_ns.nerfstudio_plugin.widgets import Widgets
from normlift_ns.question import Question
from normlift_ns.runs.files import texts_cache
from normlift_ns.runs.question import load_question
from normlift_ns.session.prompts import Prompt, pose, prompts_of, read_prompts, split_prompts
from normlift_ns.text_encoders import Texts, encoder_of


class Asker:
    """The encoder is loaded at its first text, and is kept."""

    def __init__(self) -> None:
        self.encoder: list[Texts] = []
        """One, once it is loaded."""
        self._lock = Lock()

    def pose(
        self,
        field: SemanticField,
        folder: Path | None,
        line: str,
        negatives: str,
        clicks: Mapping[str, Any],
        widgets: Widgets | None,
        wanted: Callable[[], bool],
    ) -> tuple[tuple[Prompt, ...], Question] | None:
        """The rows of a line of prompts, and their question; None where nobody waits for it any more.

        Raises:
            ValueError, OSError: as `read_prompts` and `session.prompts.pose`.
        """
        known: dict[str, Any] = dict(clicks)
        with suppress(ValueError, OSError):  # a damaged file is told where it is read to be shown or replaced
            known |= {prompt.text: prompt.vector for prompt in prompts_of(stored(folder))}
        how: dict[str, Any] = {}
        if widgets is not None:
            how = {
                "rule": widgets.rule.value,
                "min_reliability": widgets.reliability.value,
                "refined": widgets.refined.value,
            }

        def read(texts: Sequence[str]) -> Any:
            if len(self.encoder) == 0:
                cache = None if folder is None else texts_cache(folder.parent)
                self.encoder.append(encoder_of(field, str(field.source.device), cache))
            return self.encoder[0].rows(texts)

        with self._lock:  # it must not be loaded twice
            if not wanted():
                return None
            prompts = read_prompts(line, read, known)
            return pose(field, prompts, read, negatives=split_prompts(negatives), **how)


def stored(folder: Path | None) -> Question | None:
    """The question of a run; None: there is none."""
    return None if folder is None else load_question(folder)
