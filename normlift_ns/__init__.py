"""Training-free open-vocabulary semantics for trained Gaussian splats. See README.md and docs/method.md.

The public names are imported on first use, so importing the package itself is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from normlift_ns.analysis.explain import Why as Why
    from normlift_ns.analysis.objects import Floaters as Floaters
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
    from normlift_ns.core.refine import refine as refine
    from normlift_ns.core.refine import unsupported as unsupported
    from normlift_ns.core.relevancy import relevancy as relevancy
    from normlift_ns.core.scene import Scene as Scene
    from normlift_ns.core.scene import View as View
    from normlift_ns.data.open_scene import open_scene as open_scene
    from normlift_ns.data.open_splat import open_splat as open_splat
    from normlift_ns.errors import InputError as InputError
    from normlift_ns.evaluation.coverage import Coverage as Coverage
    from normlift_ns.evaluation.coverage import coverage as coverage
    from normlift_ns.evaluation.studies import refine_variant as refine_variant
    from normlift_ns.lifted_run import LiftedRun as LiftedRun
    from normlift_ns.lifted_run import open_run as open_run
    from normlift_ns.options import BACKGROUND_WORDS as BACKGROUND_WORDS
    from normlift_ns.options import CANONICAL_NEGATIVES as CANONICAL_NEGATIVES
    from normlift_ns.options import LiftOptions as LiftOptions
    from normlift_ns.options import RefineConfig as RefineConfig
    from normlift_ns.options import SourceOptions as SourceOptions
    from normlift_ns.options import SplatOptions as SplatOptions
    from normlift_ns.pipeline import lift_run as lift_run
    from normlift_ns.query.engine import Answer as Answer
    from normlift_ns.query.engine import Finding as Finding
    from normlift_ns.query.threshold import Histogram as Histogram
    from normlift_ns.rasterization.rasterize import Contributors as Contributors
    from normlift_ns.rasterization.rasterize import contributors as contributors
    from normlift_ns.rasterization.rasterize import rasterize_evidence as rasterize_evidence
    from normlift_ns.rasterization.rasterize import render as render
    from normlift_ns.rasterization.settings import RasterSettings as RasterSettings
    from normlift_ns.server.client import RemoteRun as RemoteRun
    from normlift_ns.server.client import connect as connect


__version__ = "0.3.0"

_HOMES = {
    "analysis.explain": "Why",
    "analysis.objects": "Floaters",
    "core.consensus": "Consensus consensus",
    "core.evidence": "Evidence",
    "core.field": "SemanticField",
    "core.gaussians": "Camera GaussianScene",
    "core.lift": "Lifted Scalars lift",
    "core.neighbors": "Neighbors nearest_neighbors",
    "core.refine": "refine unsupported",
    "core.relevancy": "relevancy",
    "core.scene": "Scene View",
    "data.open_scene": "open_scene",
    "data.open_splat": "open_splat",
    "errors": "InputError",
    "evaluation.coverage": "Coverage coverage",
    "evaluation.studies": "refine_variant",
    "lifted_run": "LiftedRun open_run",
    "options": "BACKGROUND_WORDS CANONICAL_NEGATIVES LiftOptions RefineConfig SourceOptions SplatOptions",
    "pipeline": "lift_run",
    "query.engine": "Answer Finding",
    "query.threshold": "Histogram",
    "rasterization.rasterize": "Contributors contributors rasterize_evidence render",
    "rasterization.settings": "RasterSettings",
    "server.client": "RemoteRun connect",
}
"""Public names by the module that defines them."""
_HOME = {name: f"normlift_ns.{module}" for module, names in _HOMES.items() for name in names.split()}

__all__ = list(_HOME)  # pyrefly: ignore[unresolvable-dunder-all]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'normlift_ns' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOME[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
