"""Inventory of the tabletop with twelve known objects: how many are listed, and how many other entries there are.

    python -m research.inventory                  exact masks and colors, edges and imagenet; results/inventory.json
    python -m research.inventory --inputs masks   without weights

No name is given. An object is recovered if an entry of the list has an intersection over union of 0.7 or more with it.
This is computed for sampled pixels of the four held-out views, and for Gaussians with a class by the exact masks. Table
and floor are two of the twelve objects. A pixel belongs to the entry that makes up more than half of it. Precision is
the number of recovered objects per entry of the list, so fragments, duplicates and shadows are errors.

The constants of the method were chosen on this capture with both inputs. With any smallest affinity of joining from 0.5
to 0.65, 11 objects are recovered from masks, and 11 or 12 from edges (by pixels). 0.7 is too strict for edges, and 0.4
is too low for both. With edges, the disagreement of the views was chosen last (0.19 before the consensus, 0.04 after).
The value after the consensus recovers 6 objects with 20 entries, and the value before it 9 with 10. Values from their
mean to 0.16 recover 12 with 14 or 15. With masks, 11 are recovered with 12 entries in all cases.

Keys: <inputs>.pixels and .gaussians, the recovered objects; .listed, the entries; .precision by pixels; .seconds, the
time of the search.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

import normlift_ns as nl
from normlift_ns.analysis.inventory import find_inventory
from normlift_ns.core.sparse import SparseRows
from research.report import Report, stopwatch
from research.synthetic_scenes import tabletop
from tests.captures import SHARED

CAPTURES = SHARED / "captures"
CONFIG = CAPTURES / "outputs" / "tabletop" / "splatfacto" / "run" / "config.yml"
INPUTS = {
    "masks": nl.SourceOptions(encoder="color", regions="files", regions_dir=CAPTURES / "tabletop" / "instance"),
    "edges": nl.SourceOptions(encoder="imagenet", regions="edges"),
}
MIN_IOU = 0.7


def main() -> None:
    """Write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", nargs="+", default=list(INPUTS), choices=list(INPUTS))
    report, world = Report("inventory"), tabletop()
    weights, classes = world.pixels
    for name in parser.parse_args().inputs:
        with TemporaryDirectory() as folder:
            lift = nl.LiftOptions(storage="evidence", refine=False)
            run = nl.lift_run(CONFIG, source=INPUTS[name], lift=lift, output_dir=Path(folder), device="cpu")
            (evidence, features), spread = run.votes.table, run.votes.disagreement
            with stopwatch() as watch:
                found = find_inventory(evidence, features, run.scene.gaussians.means, spread)
        count = int(found.max())
        pixels = recovered(pixel_entries(weights, len(classes), found, count), classes, count, world.classes)
        gaussians = recovered(found, world.truth, count, world.classes)
        report.add(f"{name}.pixels", pixels, f"of {world.classes} objects")
        report.add(f"{name}.gaussians", gaussians, f"of {world.classes} objects")
        report.add(f"{name}.listed", count, "entries")
        report.add(f"{name}.precision", pixels / max(count, 1), "recovered objects per entry")
        report.add(f"{name}.seconds", watch.seconds, "s")
    report.write()


def pixel_entries(weights: SparseRows, num_pixels: int, found: Tensor, count: int) -> Tensor:
    """Return the entry of every pixel from the weights of Gaussians in pixels [N, P], or 0 for none."""
    total = torch.zeros(count + 1, num_pixels, dtype=torch.float64)
    total.index_put_((found.long()[weights.row_index()], weights.column.long()), weights.weight.double(), True)
    most = total.max(dim=0)
    return torch.where(most.values > 0.5 * total.sum(dim=0), most.indices, 0)


def recovered(found: Tensor, truth: Tensor, count: int, classes: int) -> int:
    """Return the number of classes with which an entry has an intersection over union of `MIN_IOU` or more.

    Args:
        found: Entry of every pixel or Gaussian, 1 to `count`, or 0 for none.
        truth: Class of every pixel or Gaussian, or -1 for none.
    """
    table = torch.bincount(found.long() * (classes + 1) + truth.long() + 1, minlength=(count + 1) * (classes + 1))
    table = table.view(count + 1, classes + 1).double()
    both, entries, objects = table[1:, 1:], table[1:].sum(dim=1), table[:, 1:].sum(dim=0)
    return int((both / (entries[:, None] + objects - both).clamp(min=1) >= MIN_IOU).any(dim=0).sum())


if __name__ == "__main__":
    main()
