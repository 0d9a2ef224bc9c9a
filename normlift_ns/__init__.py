"""Training-free open-vocabulary semantics for trained Gaussian splats. See README.md and docs/method.md."""

from normlift_ns.core.ablations import refine_variant
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import SemanticField
from normlift_ns.core.gaussians import Camera, GaussianScene
from normlift_ns.core.lift import Lifted, lift
from normlift_ns.core.neighbors import Neighbors, nearest_neighbors
from normlift_ns.core.query import BACKGROUND_WORDS, CANONICAL_NEGATIVES, relevancy
from normlift_ns.core.refine import RefineConfig, refine, unsupported
from normlift_ns.raster.rasterize import rasterize_evidence, render
from normlift_ns.raster.settings import RasterSettings

__version__ = "0.1.0"

__all__ = [
    "BACKGROUND_WORDS",
    "CANONICAL_NEGATIVES",
    "Camera",
    "Evidence",
    "GaussianScene",
    "Lifted",
    "Neighbors",
    "RasterSettings",
    "RefineConfig",
    "SemanticField",
    "lift",
    "nearest_neighbors",
    "rasterize_evidence",
    "refine",
    "refine_variant",
    "relevancy",
    "render",
    "unsupported",
]
