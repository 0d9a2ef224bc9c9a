"""What the views of a scene say, to one process or to several: chunk by chunk, so that an interrupted lift resumes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from normlift_ns.core.evidence import Evidence
from normlift_ns.core.gaussians import GaussianScene
from normlift_ns.core.portions import Portion, Team
from normlift_ns.core.scene import Scene, View
from normlift_ns.encoders.cache import cached
from normlift_ns.encoders.langsplat.source import write_langsplat
from normlift_ns.encoders.source import FeatureSource
from normlift_ns.observing import Block, block_evidence, in_chunks, observe_views, region_levels
from normlift_ns.options import BackendName, LiftOptions
from normlift_ns.raster.settings import RasterSettings
from normlift_ns.stages import Stages
from normlift_ns.team.exchange import Piece, share_evidence


class Export(NamedTuple):
    """Where 2D features go besides the lift."""

    folder: Path
    overwrite: bool
    """Replace files of other content."""


class Drawing(NamedTuple):
    """How the weights of a lift are rasterized."""

    rules: str
    """Version of gsplat that says what is drawn."""
    backend: BackendName
    """What computes it."""
    dtype: torch.dtype

    @property
    def settings(self) -> RasterSettings:
        """The constants of the rules."""
        return RasterSettings.of_gsplat(self.rules)


class Seen(NamedTuple):
    """What the chosen views say, for the Gaussians of this process."""

    evidence: Evidence
    features: Float[Tensor, "s d"]
    level: Int64[Tensor, " s"]


def look(
    scene: Scene,
    gaussians: GaussianScene,
    used: Sequence[int],
    source: FeatureSource,
    options: LiftOptions,
    drawing: Drawing,
    cache: Path,
    export: Export | None,
    stages: Stages,
    ready: Callable[[], None],
    portion: Portion,
) -> Seen:
    """Evidence, feature table and levels of the regions of some training views.

    Args:
        used: numbers of the views.
        ready: waits until kernels can be used.
        portion: of this process, in whose team the chunks of views are divided.
    """
    team, views = portion.team, len(used)
    seen = cached(source, cache) if options.reuse_evidence else source
    rendered = drawing.settings if options.image_source == "render" else None
    chunks = in_chunks(used, team.size)
    tables: dict[int, tuple[Tensor, Tensor]] = {}
    whole: list[Evidence] = []
    pieces: dict[int, Piece] = {}
    for number in team.chunks(len(chunks)):
        with stages("features", views) as step:

            def done(view: View, step: Callable[[], None] = step) -> None:
                if export is not None:
                    write_langsplat(seen, view.image, view.name, *export)
                step()

            block = observe_views(
                scene, chunks[number], seen, rendered=rendered, divisor=options.lift_downscale, done=done
            )
            tables[number] = _table(block)
        with stages("evidence", views) as step:
            ready()
            evidence = block_evidence(
                gaussians,
                block,
                cache / "evidence",
                rasterize_mode=scene.rasterize_mode,
                settings=drawing.settings,
                backend=drawing.backend,
                weight_power=options.weight_power,
                dtype=drawing.dtype,
                reuse=options.reuse_evidence,
                done=step,
            )
            if team.size > 1:
                pieces[number] = Piece.of(evidence, portion)
            else:
                whole.append(evidence)
    with stages("exchange") if team.size > 1 else stages("evidence", views):
        evidence = Evidence.merge(*whole) if team.size == 1 else share_evidence(pieces, portion, len(chunks))
        features, level = _all_tables(tables, team)
    return Seen(evidence, features.to(gaussians.means.device, drawing.dtype), level)


def _table(block: Block) -> tuple[Tensor, Tensor]:
    """Feature rows and levels of the regions of a block."""
    levels = [region_levels(regions, len(rows)) for regions, rows in zip(block.regions, block.features)]
    return torch.cat(block.features), torch.cat(levels)


def _all_tables(tables: dict[int, tuple[Tensor, Tensor]], team: Team) -> tuple[Tensor, Tensor]:
    """Rows and levels of the regions of all chunks, in their order."""
    if team.size == 1:
        features, levels = zip(*tables.values())
        return torch.cat(features), torch.cat(levels)
    mine = sorted(tables)
    said = team.tell_all([[(number, *tables[number][0].shape) for number in mine]])
    widths = {width for (facts,) in said for _, _, width in facts}
    counts = [(number, count) for (facts,) in said for number, count, _ in facts]
    none = torch.zeros(0, max(widths)), torch.zeros(0, dtype=torch.int64)
    parts = (torch.cat([none[i], *(tables[number][i] for number in mine)]) for i in range(2))
    features, levels = (team.join(part).split([count for _, count in counts]) for part in parts)
    order = sorted(range(len(counts)), key=lambda i: counts[i][0])
    return torch.cat([features[i] for i in order]), torch.cat([levels[i] for i in order])
