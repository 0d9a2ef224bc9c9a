"""The recipes of CONTRIBUTING.md, applied to a copy of the package."""

import csv
import json
import os
import re
import shutil
import sys
from pathlib import Path

import pytest

from normlift_ns import open_run
from tests.encoders.test_plugins import install
from tests.processes import run

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text("utf8")
PARTS = dict(part.partition(" of your own\n")[::2] for part in re.split(r"^## ", TEXT, flags=re.MULTILINE))


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package with all of them."""
    copy = tmp_path_factory.mktemp("copy")
    shutil.copytree(ROOT / "normlift_ns", copy / "normlift_ns", ignore=shutil.ignore_patterns("__pycache__"))
    (code,) = re.findall("```python\n(.*?)```", PARTS["An output"], re.DOTALL)
    (entry_points,) = re.findall(r"```toml\n\[project\.entry-points\.(.*?)```", PARTS["An output"], re.DOTALL)
    install(copy, "normlift_table", re.sub('"(.*?)"', r"\1", f"[{entry_points}"), code)
    for name in ("A rule", "A scene source", "A reliability", "A rasterizer"):
        (recipe,) = re.findall("```diff\n(.*?)```", PARTS[name], re.DOTALL)
        outside = os.environ | {"GIT_CEILING_DIRECTORIES": str(copy.parent)}
        run("git", "apply", "--verbose", "-", input=recipe, cwd=copy, env=outside)
    return copy


def python(extended: Path, *words: object, code: int = 0) -> str:
    paths = os.environ | {"PYTHONPATH": str(extended), "CUDA_VISIBLE_DEVICES": ""}
    return run(sys.executable, *words, code=code, cwd=extended, env=paths)


RULE = """
import sys, numpy as np, normlift_ns as nl
from pathlib import Path
from normlift_ns.query.arrays import open_quick
how = {"relevancy": "mean", "negatives": ["blue", "yellow"]}
run = nl.open_run(sys.argv[1])
ours = run.ask("red", **how).relevancy.numpy()
text, *negatives = (run.ask(text, relevancy="cosine").relevancy.numpy() for text in ("red", "blue", "yellow"))
by_hand = 1 / (1 + np.exp(-10 * (text - sum(negatives) / 2)))
valid = run.field.valid().numpy()
np.testing.assert_allclose(ours[valid], by_hand[valid], atol=2e-6)
np.testing.assert_allclose(open_quick(Path(sys.argv[1])).ask(["red"], **how).relevancy, ours, atol=2e-6)
assert ours.max() > 0.9 and ours.min() < 0.4, (ours.max(), ours.min())
"""


SOURCE = """
import sys, numpy as np, torch, normlift_ns as nl
from pathlib import Path
run, folder = nl.open_run(sys.argv[1]), Path(sys.argv[2])
np.savez(folder / "scene.npz", **{name: value.numpy() for name, value in run.scene.parameters.items()})
np.save(folder / "none.npy", np.zeros(3))
(folder / "none.npy").rename(folder / "none.npz")
cameras = run.scene.location.folder / "transforms.json"
options = nl.SplatOptions(transforms=cameras, world_transform=run.folder / "dataparser_transforms.json")
scene = nl.open_splat(folder / "scene.npz", options)
assert torch.equal(scene.gaussians.means, run.scene.gaussians.means) and len(scene.train) == len(run.scene.train)
try:
    nl.open_splat(folder / "none.npz", options)
except nl.InputError as error:
    assert "is not a splat" in str(error), error
else:
    sys.exit("accepted")
"""


FLAT = """
import torch, normlift_ns as nl
from normlift_ns.core.reliability import reliability
assert reliability(0.6, torch.tensor([2.0]), beta=1.0).allclose(torch.tensor(0.24))
n, turn = 60, 3 * torch.rand(60)
quats = torch.stack([turn.cos(), 0 * turn, 0 * turn, turn.sin()], 1)
scales = (0.02 + 0.1 * torch.rand(n, 3)) * torch.tensor([1.0, 1, 0])
scene = nl.GaussianScene(2 * torch.rand(n, 3) + torch.tensor([-1.0, -1, 2]), quats, scales, 0.3 * torch.rand(n))
camera = nl.Camera(torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), torch.eye(4), 64, 48)
how = {"settings": nl.RasterSettings(eps2d=0.0, frustum_margin=1e3, min_discriminant=0.0), "dtype": torch.float64}
labels = [torch.arange(3072).view(48, 64).int() % 5 - 2]
for run in (
    lambda backend: nl.render(scene, camera, scene.means, backend=backend, **how)[0],
    lambda backend: nl.rasterize_evidence(scene, [camera], labels, backend=backend, **how).rows.weight,
):
    flat, usual = run("surfels"), run("torch")
    assert flat.shape == usual.shape and 0 < (flat - usual).abs().max() < 1e-6 * usual.max()
"""


@pytest.mark.slow
def test_all_recipes_work(extended: Path, lifted: Path, tmp_path: Path) -> None:
    python(extended, "-c", SOURCE + RULE + FLAT, lifted, tmp_path)
    asked = ("--load-config", lifted, "--text", "red", "--relevancy", "mean", "--negatives", "blue")
    python(extended, "-m", "normlift_ns.cli.query", *asked, "--output-json", tmp_path / "a.json")
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["relevancy"] == "mean" and 0 < document["queries"][0]["fraction"] < 1
    table = tmp_path / "splat_table.csv"
    words = ("-m", "normlift_ns.cli.export", "--load-config", lifted, "--output-dir", tmp_path, "--exporters", "table")
    python(extended, *words, "--text", "red", "--threshold", "0.9")
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == int(open_run(lifted).ask("red", threshold=0.9).mask.sum()) > 20
    assert all(0 <= float(row["reliability"]) <= 1 for row in rows)
    for name in ("splat.ply", "splat_rows.npy", "splat_names.json", "splat_objects.json"):
        (tmp_path / name).unlink()
    assert f"{table.name} exists" in " ".join(python(extended, *words, "--text", "red", code=1).split())
