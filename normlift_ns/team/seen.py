"""Collection of 2D features and evidence from views, by one process or several.

Views are processed in chunks whose results are cached, so an interrupted lift can resume.
"""

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
    """Export of 2D features to files, in addition to the lift."""

    folder: Path
    overwrite: bool
    """Replace files with other content."""


class Drawing(NamedTuple):
    """Rasterization settings of a lift."""

    rules: str
    """Version of gsplat whose rasterization rules apply."""
    backend: BackendName
    """Backend that rasterizes."""
    dtype: torch.dtype

    @property
    def settings(self) -> RasterSettings:
        """Constants of the rasterization rules."""
        return RasterSettings.of_gsplat(self.rules)


class Seen(NamedTuple):
    """Evidence, features and levels from some views, for the Gaussians of this process."""

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
    """Collect evidence, feature table and region levels from some training views.

    Args:
        used: indices of the views.
        source: encoder or files that the features come from.
        cache: directory of cached features and evidence.
        export: destination of the 2D features; None: no export.
        stages: progress of the lift.
        ready: function that waits until kernels are compiled.
        portion: Gaussians of this process; its team divides the chunks of views.
    """
    team, views = portion.team, len(used)
    source = cached(source, cache) if options.reuse_evidence else source
    rendered = drawing.settings if options.image_source == "render" else None
    chunks = in_chunks(used, team.size)
    tables: dict[int, tuple[Tensor, Tensor]] = {}
    parts: list[Evidence] = []
    pieces: dict[int, Piece] = {}
    for index in team.chunks(len(chunks)):
        with stages("features", views) as step:

            def done(view: View, step: Callable[[], None] = step) -> None:
                if export is not None:
                    write_langsplat(source, view.image, view.name, *export)
                step()

            block = observe_views(
                scene, chunks[index], source, rendered=rendered, divisor=options.lift_downscale, done=done
            )
            tables[index] = _table(block)
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
                pieces[index] = Piece.of(evidence, portion)
            else:
                parts.append(evidence)
    with stages("exchange") if team.size > 1 else stages("evidence", views):
        evidence = Evidence.merge(*parts) if team.size == 1 else share_evidence(pieces, portion, len(chunks))
        features, level = _all_tables(tables, team)
    return Seen(evidence, features.to(gaussians.means.device, drawing.dtype), level)


def _table(block: Block) -> tuple[Tensor, Tensor]:
    """Return features and levels of the regions of a block."""
    levels = [region_levels(regions, len(rows)) for regions, rows in zip(block.regions, block.features)]
    return torch.cat(block.features), torch.cat(levels)


def _all_tables(tables: dict[int, tuple[Tensor, Tensor]], team: Team) -> tuple[Tensor, Tensor]:
    """Return features and levels of the regions of all chunks, in order."""
    if team.size == 1:
        features, levels = zip(*tables.values())
        return torch.cat(features), torch.cat(levels)
    local_chunks = sorted(tables)
    gathered = team.tell_all([[(chunk, *tables[chunk][0].shape) for chunk in local_chunks]])
    widths = {width for (shapes,) in gathered for _, _, width in shapes}
    counts = [(chunk, count) for (shapes,) in gathered for chunk, count, _ in shapes]
    empty = torch.zeros(0, max(widths)), torch.zeros(0, dtype=torch.int64)
    parts = (torch.cat([empty[i], *(tables[chunk][i] for chunk in local_chunks)]) for i in range(2))
    features, levels = (team.join(part).split([count for _, count in counts]) for part in parts)
    order = sorted(range(len(counts)), key=lambda i: counts[i][0])
    return torch.cat([features[i] for i in order]), torch.cat([levels[i] for i in order])
