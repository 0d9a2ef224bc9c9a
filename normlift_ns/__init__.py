"""Training-free open-vocabulary semantics for trained Gaussian splats. See README.md and docs/method.md.

The names below are imported lazily, on first use, so importing the package is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from normlift_ns.asking import Answer as Answer
    from normlift_ns.asking import Finding as Finding
    from normlift_ns.core.ablations import refine_variant as refine_variant
    from normlift_ns.core.consensus import Consensus as Consensus
    from normlift_ns.core.consensus import consensus as consensus
    from normlift_ns.core.evidence import Evidence as Evidence
    from normlift_ns.core.field import SemanticField as SemanticField
    from normlift_ns.core.gaussians import Camera as Camera
    from normlift_ns.core.gaussians import GaussianScene as GaussianScene
    from normlift_ns.core.lift import Lifted as Lifted
    from normlift_ns.core.lift import Scalars as Scalars
    from normlift_ns.core.lift import lift as lift
    from normlift_ns.core.neighbors import Neighbors as Neighbors
    from normlift_ns.core.neighbors import nearest_neighbors as nearest_neighbors
    from normlift_ns.core.query import relevancy as relevancy
    from normlift_ns.core.refine import refine as refine
    from normlift_ns.core.refine import unsupported as unsupported
    from normlift_ns.core.scene import Scene as Scene
    from normlift_ns.core.scene import View as View
    from normlift_ns.errors import InputError as InputError
    from normlift_ns.evaluation.coverage.study import Coverage as Coverage
    from normlift_ns.evaluation.coverage.study import coverage as coverage
    from normlift_ns.front_door import lift_run as lift_run
    from normlift_ns.front_door import open_run as open_run
    from normlift_ns.front_door import open_scene as open_scene
    from normlift_ns.insight.floaters import Floaters as Floaters
    from normlift_ns.insight.histogram import Histogram as Histogram
    from normlift_ns.insight.why import Why as Why
    from normlift_ns.lifted_run import LiftedRun as LiftedRun
    from normlift_ns.options import BACKGROUND_WORDS as BACKGROUND_WORDS
    from normlift_ns.options import CANONICAL_NEGATIVES as CANONICAL_NEGATIVES
    from normlift_ns.options import LiftOptions as LiftOptions
    from normlift_ns.options import RefineConfig as RefineConfig
    from normlift_ns.options import SourceOptions as SourceOptions
    from normlift_ns.options import SplatOptions as SplatOptions
    from normlift_ns.raster.contributors import Contributors as Contributors
    from normlift_ns.raster.contributors import contributors as contributors
    from normlift_ns.raster.rasterize import rasterize_evidence as rasterize_evidence
    from normlift_ns.raster.rasterize import render as render
    from normlift_ns.raster.settings import RasterSettings as RasterSettings
    from normlift_ns.scenes.opening import open_splat as open_splat

__version__ = "0.2.0"

_HOMES = {
    "asking": ("Answer", "Finding"),
    "core.ablations": ("refine_variant",),
    "core.consensus": ("Consensus", "consensus"),
    "core.evidence": ("Evidence",),
    "core.field": ("SemanticField",),
    "core.gaussians": ("Camera", "GaussianScene"),
    "core.lift": ("Lifted", "Scalars", "lift"),
    "core.neighbors": ("Neighbors", "nearest_neighbors"),
    "core.query": ("relevancy",),
    "core.refine": ("refine", "unsupported"),
    "core.scene": ("Scene", "View"),
    "errors": ("InputError",),
    "evaluation.coverage.study": ("Coverage", "coverage"),
    "front_door": ("lift_run", "open_run", "open_scene"),
    "insight.floaters": ("Floaters",),
    "insight.histogram": ("Histogram",),
    "insight.why": ("Why",),
    "lifted_run": ("LiftedRun",),
    "options": (
        "BACKGROUND_WORDS",
        "CANONICAL_NEGATIVES",
        "LiftOptions",
        "RefineConfig",
        "SourceOptions",
        "SplatOptions",
    ),
    "raster.contributors": ("Contributors", "contributors"),
    "raster.rasterize": ("rasterize_evidence", "render"),
    "raster.settings": ("RasterSettings",),
    "scenes.opening": ("open_splat",),
}
"""Public names by the module that defines them."""
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = list(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'normlift_ns' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"normlift_ns.{_HOME[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
