"""The training views of a lifted run as the lift saw them: regions and features, made again or read from its cache."""

from __future__ import annotations

from collections.abc import Iterator

from normlift_ns.encoders.build import recorded_source
from normlift_ns.encoders.cache import cached
from normlift_ns.evaluation.protocols import EvaluatedRun
from normlift_ns.observing import BLOCK, Block, observe_views, spread


def seen_blocks(lifted: EvaluatedRun, device: str, *, most: int | None = None) -> Iterator[Block]:
    """Cameras, labels and features of the views of the lift, some views at a time.

    Args:
        device: where networks run.
        most: views, evenly spread; None: all of the lift.
    Raises:
        ValueError: the run does not say which features it was lifted from, they were the user's own, or they are not
            the same any more.
        FileNotFoundError: files of the features are gone.
    """
    manifest, scene = lifted.field.manifest, lifted.scene
    source = recorded_source(manifest, device)
    source = source if lifted.cache is None else cached(source, lifted.cache)
    options = manifest.get("options", {})
    names = set(source.available(scene.train.names))
    usable = [index for index, name in enumerate(scene.train.names) if name in names]
    used = [usable[i] for i in spread(len(usable), options.get("max_views"))]
    used = [used[i] for i in spread(len(used), most)]
    rendered = lifted.settings if options.get("image_source") == "render" else None
    how = {"rendered": rendered, "divisor": options.get("lift_downscale", 1), "done": lambda view: None}
    for start in range(0, len(used), BLOCK):
        yield observe_views(scene, used[start : start + BLOCK], source, **how)
