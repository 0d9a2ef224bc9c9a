"""Memory with real photographs. The captures lie beside the repository and are not part of it."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.captures import SHARED, needs_shared

CAPTURES = SHARED / "captures"
pytestmark = [pytest.mark.slow, needs_shared]


SEE_ALL = """
import sys
from pathlib import Path
from normlift_ns.encoders.cache import cached
from normlift_ns.encoders.open_clip_network import OpenClipEncoder
from normlift_ns.encoders.base import PatchFeatures, RegionFeatures
from normlift_ns.segmentation.regions import read_image
from normlift_ns.segmentation.sam import MaskRules, SamMasks
from normlift_ns.progress import peak_gib
from tests.encoders.tiny import write_clip, write_sam

folder, images = Path(sys.argv[1]), sorted(Path(sys.argv[2]).iterdir())[:12]
write_clip(folder, "normlift-wide", 512)
write_sam(folder / "sam.pth", seed=1, gain=6)
clip = OpenClipEncoder("normlift-wide", str(folder / "tiny.pt"))
sam = SamMasks(str(folder / "sam.pth"), rules=MaskRules(points_per_side=2, predicted_iou=0.5, stability=0.3))
for source in (cached(RegionFeatures(sam, clip), folder / "cache"), cached(PatchFeatures(clip), folder / "cache")):
    views, peaks = [], []
    for path in images:
        views.append(source.view(read_image(path), f"images/{path.name}"))
        peaks.append(round(peak_gib() * 2**20))
    print(len(views), sum(len(view.features) for view in views), peaks[3], peaks[-1])
"""


def test_features_of_50_views_fit_into_2_gb(tmp_path):
    """With SAM's masks and with patches, the libraries included; the networks are small, and 12 views tell of 50."""
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", SEE_ALL, str(tmp_path), str(CAPTURES / "fox" / "images")]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for views, features, first, last in (map(int, line.split()) for line in done.stdout.splitlines()):
        assert views == 12 and (features == 12 * 43 * 24 or 12 <= features < 12 * 43)
        assert (last + 38 * (last - first) / 8) * 1024 < 2e9
    assert len(done.stdout.splitlines()) == 2
