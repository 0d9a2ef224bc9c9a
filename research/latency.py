"""Time of the viewer's panel for the answer to an encoded prompt on the fox capture, and its error.

    python -m research.latency            45 views; on the GPU if there is one, unless --device cpu is given
    python -m research.latency --quick    4 views, times of 3 runs

The field has 144 grid regions per view and D = 512, in each storage form. CLIP-like features that differ in every view
use the forms evidence and float16. Features of 32 classes without noise, which have a basis of rank 32, use low_rank.
The query is one prompt with four negatives. Times are the shortest of 20 runs, to exclude other programs. The keys
panel.* are those of `research.panel`, on a lift with colors; --quick omits them. `research.view` measures the page.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras

from normlift_ns import Camera, SemanticField, lift, rasterize_evidence
from normlift_ns.core.relevancy import relevancy
from normlift_ns.nerfstudio_plugin.model import NormLiftModel, NormLiftModelConfig
from normlift_ns.nerfstudio_plugin.panel import prompt_table, status_mdx, visible_mask
from normlift_ns.options import CANONICAL_NEGATIVES, Storage
from normlift_ns.query import engine
from normlift_ns.query.question import Query
from normlift_ns.rendering.figures import make_display
from normlift_ns.session import actions
from normlift_ns.session.prompts import prompts_of_query
from normlift_ns.session.selection import SelectionContext
from normlift_ns.session.state import History, State
from research.cpu import clip_like_table
from research.gpu_cases import grid_labels
from research.panel import add_fox_panel
from research.report import RESULTS, Report
from tests.captures import SHARED, trained_scene, trained_state, training_cameras

REPEATS, CLASSES, SAMPLE = 20, 32, 20_000


def least(device: str, repeats: int, action: Callable[[], object]) -> float:
    """Return the milliseconds of the fastest of some runs after a warm-up run, with synchronization of the GPU."""
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None
    seconds = []
    for _ in range(repeats + 1):
        wait()
        start = time.perf_counter()
        action()
        wait()
        seconds.append(time.perf_counter() - start)
    return 1e3 * min(seconds[1:])


def questions() -> Query:
    """Return a query with a prompt whose vector some features have, and four negatives."""
    names = np.load(SHARED / "clip_vectors" / "lvis_v1_text.npy").astype(np.float32)
    return Query(("thing",), names[:1], CANONICAL_NEGATIVES, names[10:14], "lerf")


def true_relevancy(exact_directions: torch.Tensor, question: Query) -> torch.Tensor:
    """Return [M, 1] relevancies in float64, from directions in float64."""
    positive, negative = (
        exact_directions @ torch.nn.functional.normalize(torch.from_numpy(vectors).to(exact_directions), dim=1).T
        for vectors in (question.embeddings, question.negative_embeddings)
        if vectors is not None
    )
    return relevancy(positive, negative, rule="lerf")


def fox_model(device: str) -> NormLiftModel:
    """Return the model with the trained Gaussians as in ns-viewer, including the panel."""
    state = trained_state("fox")
    degree = math.isqrt(1 + state["gauss_params.features_rest"].shape[1]) - 1
    config = NormLiftModelConfig(num_random=20, sh_degree=degree)
    model = NormLiftModel(config, scene_box=None, num_train_data=1).to(device)  # type: ignore[arg-type]
    model.load_state_dict(state, strict=False)
    return model.eval()


def viewer_camera(camera: Camera) -> Cameras:
    """Return the camera in the form that the viewer passes."""
    pose = camera.world_to_camera.inverse()[:3] * torch.tensor([1.0, -1, -1, 1])
    K = camera.K
    return Cameras(pose[None], K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height)


def measure(
    report: Report,
    name: str,
    field: SemanticField,
    exact: torch.Tensor,
    some: torch.Tensor,
    model: NormLiftModel,
    repeats: int,
) -> None:
    """Add fox_NAME_*: the times of the parts of an answer, and of the whole answer as in the panel.

    Args:
        exact: Relevancy in float64 of some Gaussians.
    """
    device, question = model.device.type, questions()
    model.attach(field)
    means = model.means.detach()
    answer = engine.run_query(field, means, question)
    error = (answer.relevancy[some].double() - exact).abs().max()

    def posed() -> State:
        return actions.ask(
            State(SelectionContext(field, means)), prompts_of_query(question), question
        )  # nothing is remembered

    def told(state: State) -> None:
        status_mdx(state, "", "", drawn)
        prompt_table(state)

    def whole() -> None:
        state = posed()
        cast(Any, model.normlift)._show(History.of(state))
        told(state)

    drawn, state = visible_mask(model.splat_parameters()[0]["opacities"]), posed()
    told(state)
    other = replace(question, threshold=0.55, min_reliability=0.1)
    report.add(
        f"fox_{name}_relevancy_ms",
        least(device, repeats, lambda: engine.run_query(field, means, question)),
        "ms",
        error,
    )
    report.add(f"fox_{name}_threshold_ms", least(device, repeats, lambda: engine.apply_threshold(answer, other)), "ms")
    report.add(f"fox_{name}_display_ms", least(device, repeats, lambda: make_display(field, answer)), "ms")
    report.add(f"fox_{name}_status_ms", least(device, repeats, lambda: told(state)), "ms")
    report.add(f"fox_{name}_answer_ms", least(device, repeats, whole), "ms", error)


def main(quick: bool, device: str, output: Path) -> None:
    report = Report("latency" if device == "cpu" else "latency_gpu")
    scene, cameras = trained_scene("fox").to(device), training_cameras("fox")
    cameras, repeats = (cameras[:4], 3) if quick else (cameras, REPEATS)
    evidence = rasterize_evidence(scene, cameras, [grid_labels(camera) for camera in cameras])
    mixed, model = clip_like_table(evidence.num_regions).to(device), fox_model(device)
    g = torch.Generator().manual_seed(0)
    classes = mixed[torch.randint(0, CLASSES, (len(mixed),), generator=g).to(device)]
    some = torch.randperm(len(scene), generator=g)[:SAMPLE].to(device)
    source = torch.arange(len(scene)).to(device)
    moved = torch.randperm(len(scene), generator=g)[: len(scene) // 5]  # about the share that the vote replaces
    source[moved] = torch.randint(0, len(scene), (len(moved),), generator=g).to(device)
    ways: tuple[tuple[Storage, torch.Tensor], ...] = (("evidence", mixed), ("float16", mixed), ("low_rank", classes))
    for storage, features in ways:
        field = SemanticField.build(lift(evidence, features), scene.means, source, storage=storage)
        directions = lift(evidence, features.double()).directions(source[some])
        exact = true_relevancy(directions, questions()).where(field.valid()[some, None], 0.0)
        measure(report, storage, field, exact, some, model, repeats)
    camera = viewer_camera(cameras[0]).to(device)
    report.add("fox_overlay_ms", least(device, repeats, lambda: model.get_outputs_for_camera(camera)), "ms per frame")
    model.show(None)
    report.add("fox_stock_ms", least(device, repeats, lambda: model.get_outputs_for_camera(camera)), "ms per frame")
    if not quick:
        add_fox_panel(report)
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="4 views, times of 3 runs")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    main(arguments.quick, arguments.device, arguments.output)
