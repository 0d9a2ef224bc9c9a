"""Encoding of the prompts typed into the panel, with the text encoder of the run."""

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
    """Encoder of the panel's prompts. The text encoder is loaded at the first prompt and then kept."""

    def __init__(self) -> None:
        self.encoder: list[Texts] = []
        """The text encoder as the only item once it is loaded; empty before."""
        self._lock = Lock()

    def pose(
        self,
        field: SemanticField,
        folder: Path | None,
        line: str,
        negatives: str,
        clicks: Mapping[str, Any],
        widgets: Widgets | None,
        is_current: Callable[[], bool],
    ) -> tuple[tuple[Prompt, ...], Question] | None:
        """Encode a line of prompts and build its query.

        Args:
            folder: folder of the semantic field; None: no stored prompts and no text embedding cache.
            line: prompts as typed.
            negatives: negative prompts as typed.
            clicks: directions of clicked Gaussians, by the names of their prompts.
            widgets: where the rule, the minimum reliability and the choice of features are set; None: defaults.
            is_current: returns False once the request is stale.
        Returns:
            The prompts and their query; None if the request is stale.
        Raises:
            ValueError, OSError: as `read_prompts` and `session.prompts.pose`.
        """
        vectors: dict[str, Any] = dict(clicks)
        with suppress(ValueError, OSError):  # a damaged file is reported when it is shown or replaced
            vectors |= {prompt.text: prompt.vector for prompt in prompts_of(stored(folder))}
        options: dict[str, Any] = {}
        if widgets is not None:
            options = {
                "rule": widgets.rule.value,
                "min_reliability": widgets.reliability.value,
                "refined": widgets.refined.value,
            }

        def encode(texts: Sequence[str]) -> Any:
            if len(self.encoder) == 0:
                cache = None if folder is None else texts_cache(folder.parent)
                self.encoder.append(encoder_of(field, str(field.source.device), cache))
            return self.encoder[0].rows(texts)

        with self._lock:  # so that two threads do not both load the encoder
            if not is_current():
                return None
            prompts = read_prompts(line, encode, vectors)
            return pose(field, prompts, encode, negatives=split_prompts(negatives), **options)


def stored(folder: Path | None) -> Question | None:
    """Return the query stored in a run, or None if it stores none."""
    return None if folder is None else load_question(folder)
