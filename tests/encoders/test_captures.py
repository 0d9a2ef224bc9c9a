"""What the colour encoder makes of real photographs. The captures lie beside the repository and are not part of it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from benchmarks.captures import SHARED
from normlift_ns.encoders import SourceOptions, make_source, read_image
from tests.captures import needs_shared

CAPTURES = SHARED / "captures"
pytestmark = [pytest.mark.slow, needs_shared]


def inside(polygons: list[list[tuple[int, int]]]) -> torch.Tensor:
    """Pixels of fox/images/0001.jpg in any of the polygons."""
    mask = Image.new("1", (540, 960))
    for polygon in polygons:
        ImageDraw.Draw(mask).polygon(polygon, fill=1)
    return torch.from_numpy(np.array(mask))


def test_colours_of_the_fox():
    head = inside([[(270, 180), (290, 100), (335, 85), (360, 200), (420, 195), (470, 180), (440, 240), (450, 320),
                    (490, 390), (440, 430), (340, 400), (320, 540), (160, 570), (140, 450), (190, 350)]])  # fmt: skip
    wallpaper = inside([[(0, 700), (540, 700), (540, 960), (0, 960)], [(420, 500), (540, 500), (540, 700), (420, 700)],
                        [(0, 180), (110, 180), (110, 330), (0, 330)]])  # fmt: skip
    curtain = inside([[(450, 40), (535, 40), (535, 180), (450, 180)]])
    rose = inside([[(190, 70), (235, 70), (235, 150), (190, 150)]])
    source = make_source(SourceOptions(encoder="colour"))
    view = source.view(read_image(CAPTURES / "fox" / "images" / "0001.jpg"), "images/0001.jpg")
    cosine = view.features @ source.text(["orange", "crimson"]).T
    orange, crimson = cosine[view.labels.long()].permute(2, 0, 1)
    assert orange[head].mean() > 2.5 * orange[wallpaper].mean()
    assert orange[head].mean() > 0.3
    for red in (curtain, rose):
        assert crimson[red].mean() > 10 * crimson[wallpaper].mean()
        assert crimson[red].mean() > 2 * crimson[head].mean()


def test_objects_of_the_tabletop():
    folder = CAPTURES / "tabletop"
    names = json.loads((folder / "labels.json").read_text())["labels"]
    source = make_source(SourceOptions(encoder="colour", regions_dir=folder / "instance"))
    mean = {name: [] for name in names.values()}
    for path in sorted((folder / "images").iterdir())[::6]:
        view = source.view(read_image(path), f"images/{path.name}")
        values = np.unique(np.array(Image.open(folder / "instance" / f"{path.stem}.png")))
        values = values[values > 0]
        assert len(values) == len(view.features)
        cosine = view.features @ source.text(["red", "black", "white"]).T
        for value, row in zip(values, cosine):
            mean[names[str(value)]].append(row)
    red, black, white = range(3)
    score = {name: torch.stack(rows).mean(dim=0) for name, rows in mean.items()}
    assert score["red coffee mug"][red] > 5 * score["table"][red]
    assert score["wine bottle"][black] > 10 * score["table"][black]
    assert score["white bowl"][white] == max(row[white] for row in score.values())


SEE_ALL = """
import sys
from pathlib import Path
from normlift_ns.encoders import RegionFeatures, cached, read_image
from normlift_ns.encoders.clip.encoder import OpenClipEncoder
from normlift_ns.encoders.patches import PatchFeatures
from normlift_ns.encoders.sam.masks import MaskRules, SamMasks
from normlift_ns.stages import peak_gib
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
