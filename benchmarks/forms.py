"""What a semantic field costs on disk in its three forms, and what each does to queries, on the tabletop capture.

The exact instance masks are the regions; features are real CLIP text vectors of the objects' names, disturbed anew in
every
view by noise of a given length. Errors are measured on all 1,203 names of the vector file, against float64 directions.

    python -m benchmarks.forms
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.table import Table

from benchmarks.captures import SHARED, trained_scene, training_cameras, training_indices
from benchmarks.report import RESULTS, Report
from normlift_ns import Evidence, SemanticField, lift, rasterize_evidence

NOISE = (0.0, 0.05, 0.5, 1.5)
TOLERANCES = (1e-3, 1e-2, 5e-2)


def mask_evidence() -> Evidence:
    """Evidence of the 44 training views with the twelve exact instance masks as regions."""
    folder = SHARED / "captures" / "tabletop" / "instance"
    labels = [
        torch.from_numpy(np.array(Image.open(folder / f"{i:04d}.png")).astype(np.int32)) - 1
        for i in training_indices("tabletop")
    ]
    return rasterize_evidence(
        trained_scene("tabletop"), training_cameras("tabletop"), labels, num_regions=[12] * len(labels)
    )


def main(output: Path) -> None:
    evidence = mask_evidence()
    vectors = np.load(SHARED / "clip_vectors" / "lvis_v1_text.npy").astype(np.float64)
    names = torch.nn.functional.normalize(torch.from_numpy(vectors), dim=1)
    index = {name: i for i, name in enumerate(json.loads((SHARED / "clip_vectors" / "lvis_v1_names.json").read_text()))}
    mapping = json.loads((SHARED / "clip_vectors" / "tabletop_map.json").read_text())
    classes = names[[index[mapping[str(i)]] for i in range(1, 13)]]

    report = Report("forms")
    table = Table("noise", "tolerance", "form", "rank", "bytes per Gaussian", "bound", "measured", title="tabletop")
    means = trained_scene("tabletop").means
    for noise in NOISE:
        g = torch.Generator().manual_seed(0)
        features = classes.repeat(evidence.num_views, 1)
        features = features + noise * torch.randn(features.shape, generator=g, dtype=torch.float64) / 512**0.5
        features = torch.nn.functional.normalize(features, dim=1)
        lifted = lift(evidence, features.float())
        some = torch.randperm(len(means), generator=g)[:20000]
        exact = lift(evidence, features).directions(some) @ names.T
        measured: dict[tuple[str, int | None], float] = {}
        for tolerance in TOLERANCES:
            forms = SemanticField.build(lifted, means, tolerance=tolerance).manifest["forms"]
            chosen = min((f for f in forms if forms[f]["bound"] <= tolerance), key=lambda f: forms[f]["bytes"])
            for form, facts in forms.items():
                key = (form, facts.get("rank"))
                if key not in measured:
                    field = SemanticField.build(lifted, means, storage=form, tolerance=tolerance)
                    measured[key] = float((field.query(names.float(), refined=False)[some] - exact).abs().max())
                size = facts["bytes"] / len(means)
                mark = " (chosen)" if form == chosen else ""
                bound, error = f"{facts['bound']:.1e}", f"{measured[key]:.1e}"
                row = (str(noise), f"{tolerance:g}", form + mark, str(key[1] or ""), f"{size:.1f}", bound, error)
                table.add_row(*row)
                report.add(f"noise{noise}_tol{tolerance:g}_{form}_bytes", size, "bytes per Gaussian", measured[key])
                if key[1] is not None:
                    report.add(f"noise{noise}_tol{tolerance:g}_rank", key[1], "of 512", measured[key])
    Console(width=120).print(table)
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    main(parser.parse_args().output)
