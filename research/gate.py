"""Gates of the vote and conditions for keeping a direction, on the frozen grid: gains, edges, corrected and lost
answers.

    python -m research.gate --workers 12                all scenes; for a GPU
    python -m research.gate --later --workers 12        the candidates of the second study
    python -m research.gate --quick                     a small room and three cells, for the tests

The second study, with its rule, is "The vote after a consensus" in research/studies.md. The rest of this text describes
the first.

Every form votes after the consensus with the posterior vote. Its gate is fixed (tau, gamma) or relative (see
`core.refine.relative_gate`). Conditions can make a Gaussian keep its direction:

* delta: the winner must lead by this number, in units of R times views (equation 10);
* quorum: neighbors with this share of the weight must agree with the winner; P g(1) is full agreement;
* margin: the winner must lead by this share of P g(1), before the outer factor R_j;
* low: R_i must be below this multiple of the mean R of the neighbors, weighted by distance;
* seen: this share of the Gaussian's weight in all pixels must lie in regions, unless no view shows it at all.

This rule was written before any run on the grid. Tabletop and plain room choose; the second and third room confirm. A
cell is the mean over 4 seeds. For each form, the rule counts the targets that it meets on the cells of masks, including
statistic real:

1. damaged, all views: mean gain over the lift alone at least that of today's gate (.9, .05) minus 0.3 points;
2. edges (over a tenth of the neighbors are of other classes): accuracy, mean over cells, at least that of the
   consensus alone minus 1.0 points;
3. worst cell compared with the lift alone: -0.7 with all views, -2 with 6, -2.5 with 3 (three targets);
4. undamaged, all views: no cell loses more than 0.05 points;
5. corrected answers to answers lost by the vote, summed over cells: 2 : 1 for CLIP-like texts and 3 : 1 for orthogonal
   ones (two targets), with at least half as many corrected in damaged cells as today (one target).

The default is the form that meets the most targets. Among equal ones, the larger mean gain of target 1 wins. A form
that misses target 1 by more than 1 point is not eligible. Today's gate stays if, in the other rooms, the mean gain of
target 1 of the chosen form is more than 0.3 points below that of today's gate.

History. A first run had four seeds of most CLIP-like and isotropic cells, with more forms. Not copying directions with
a cosine of .98 or more (`same`) lost 0.9 points, and larger values of each condition lost more than they saved. In
cells of 3 views with dropped masks, the vote fills Gaussians of objects without a mask; `seen` was added after that.

Reliabilities are measured in the same run, on the answers after the consensus: the area under the ROC curve of being
correct, the accuracy in tenths by R, and the mean R of each tenth. There are four forms: R of the paper (`paper`), R of
the paper with N of `core.reliability` (`views`), its R with N_eff (`pairs`), and its R (`angular`). The better form has
the larger mean AUC over the cells of masks of tabletop and plain room. It must not be worse than the paper's by more
than 0.01 in the mean of a damage or a number of views; otherwise, the paper's stays the default.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from normlift_ns import Evidence, Lifted, lift
from normlift_ns.core.consensus import (
    apply_consensus,
    hash_to_unit,
    region_overlaps,
    sample_gaussians,
    total_view_weights,
)
from normlift_ns.core.left_out import leave_views_out
from normlift_ns.core.metrics import classify
from normlift_ns.core.refine import MAX_TAU, relative_gate, shared_region_cosines, shared_views
from normlift_ns.core.reliability import independent_views, pair_reliability, reliability
from research.batched_votes import CHUNK, Voters, mious, parts
from research.candidates import Candidate
from research.cells import SAMPLE, Place, Settings, Site
from research.report import RESULTS
from research.rows import append, read_rows
from research.rule import CHOICE, CONFIRMATION, SEEDS, Cell, cells_of, real_cells_of
from research.variants import lifted_scores

EDGE, CHANGED = 0.1, 0.98
"""Share of neighbors of other classes at an edge, and cosine to the previous direction below which it counts as
changed."""


@dataclass(frozen=True)
class Form:
    """A gate and conditions under which a Gaussian keeps its direction."""

    tau: float | None = None
    """tau of a fixed gate, or None for a relative gate."""
    gamma: float = 0.05
    delta: float = 0.0
    quorum: float = 0.0
    margin: float = 0.0
    low: float = 0.0
    """0 disables the condition."""
    seen: float = 0.0
    forced: bool = False
    """True if the consensus runs at full strength."""
    quantile: float = 0.05
    """Quantile of the relative gate."""
    local: bool = False
    """True if every Gaussian has its own relative gate."""
    shared: float = 0.0
    """Only neighbors vote that share a region in this share of the views that show both; `ANY`: in any view."""
    gated: bool = True
    few: float = 0.0
    """Only Gaussians with evidence below this number of views can change; `NONE`: only those without a direction."""

    @property
    def name(self) -> str:
        gate = "relative" if self.tau is None else f"{self.tau:g} {self.gamma:g}"
        gate = "local" if self.local else gate if self.gated else "no gate"
        gate += f" {self.quantile:g}" if self.quantile != 0.05 else ""
        more = [f"{key} {getattr(self, key):g}" for key in KEYS if getattr(self, key)]
        return " ".join(["forced"] * self.forced + [gate, *more])


KEYS = ("delta", "quorum", "margin", "low", "seen", "shared", "few")
ANY, NONE = 1e-3, 1e-6
LEAST = 4
"""Smallest number of neighbors that share the region of a Gaussian with a relative gate of its own."""
TODAY = Form(0.9, 0.05)
DEFAULT = Form(seen=0.2, forced=True)
"""Form that the rule chose for masks."""
GATES = (TODAY, Form(0.98, 0.01), Form())
FORMS = (
    *GATES,
    *(Form(delta=x) for x in (0.1, 0.3)),
    *(Form(quorum=x) for x in (0.7, 0.9)),
    Form(margin=0.1),
    Form(low=1.0),
    *(replace(gate, seen=x) for gate in (TODAY, Form()) for x in (0.02, 0.1, 0.2, 0.3)),
    Form(0.98, 0.01, seen=0.2),
    *(replace(gate, forced=True) for gate in (TODAY, Form(), Form(seen=0.2))),
)
PIECES = replace(TODAY, seen=0.2)
"""Default for pieces of images, for which the consensus is off."""
LATER = (
    TODAY,
    DEFAULT,
    PIECES,
    Form(seen=0.2),
    *(replace(DEFAULT, quantile=x) for x in (0.1, 0.2, 0.35, 0.5)),
    *(replace(DEFAULT, local=True, quantile=x) for x in (0.05, 0.1, 0.2, 0.5)),
    *(replace(DEFAULT, local=True, quantile=x, shared=0.5) for x in (0.05, 0.2)),
    *(replace(DEFAULT, shared=x, gated=gated) for gated in (True, False) for x in (ANY, 0.5, 0.8)),
    *(replace(DEFAULT, few=x) for x in (NONE, 1.0, 2.0, 4.0)),
)
"""Candidates of "The vote after a consensus" in research/studies.md."""


def gate_of(form: Form, cosines: Tensor) -> tuple[float, float]:
    """Return tau and gamma. If the relative gate cannot be measured, they are those of `TODAY`."""
    if not form.gated:
        return -1.0, 0.05
    if form.tau is not None:
        return form.tau, form.gamma
    return relative_gate(cosines, form.quantile) or (TODAY.tau or 0.0, TODAY.gamma)


def local_gate(part: Any, form: Form, together: Tensor, default: float) -> tuple[Tensor, Tensor]:
    """Return [m, 1, 1] tau and gamma of every voter, from the neighbors that share its region."""
    cosine = part.gram[:, 0, 1:].float().masked_fill(~together, torch.inf).sort(1).values
    count = together.sum(1)
    place = (form.quantile * (count - 1).clamp(min=0)).long()
    tau = torch.where(count >= LEAST, cosine.gather(1, place[:, None]).squeeze(1), default).clamp(max=MAX_TAU)
    return tau[:, None, None], (1 - tau[:, None, None]) / 2


def decided(
    part: Any, gate: tuple[float, float], forms: Sequence[Form], labeled: Tensor, views: tuple[Tensor, Tensor]
) -> list[tuple[Tensor, Tensor]]:
    """Return, for forms of the same gate, [m] the position in N+ of the direction used, and its cosine with the
    previous one.

    Args:
        views: [m, K] numbers of views in which a neighbor shares the region, and of views that show both.
    """
    whole = decided_among(part, gate, [form for form in forms if not form.shared and not form.local], labeled)
    found = []
    for form in forms:
        if not form.shared and not form.local:
            found.append(next(whole))
            continue
        together, both = views
        share = max(form.shared, 0.5) if form.local else form.shared
        near = together >= (0.5 if share == ANY else share * both)
        near &= part.group[:, 1:] >= 0
        own = local_gate(part, form, near & (both > 0), gate[0]) if form.local else gate
        found.append(next(decided_among(voted(part, near) if form.shared else part, own, [form], labeled)))
    return found


def voted(part: Any, near: Tensor) -> Any:
    """Return the part with only the neighbors `near`; voters without a direction keep all neighbors."""
    kept = torch.nn.functional.pad(near | (part.norm[:, :1] == 0), (1, 0), value=True)
    norm, n_eff = (torch.where(kept, x, 0.0) for x in (part.norm, part.n_eff))
    return replace(part, norm=norm, n_eff=n_eff)


def decided_among(part: Any, gate: tuple[Any, Any], forms: Sequence[Form], labeled: Tensor) -> Iterator[Any]:
    """Yield the results of `decided` among all reliable neighbors."""
    if len(forms) == 0:
        return
    tau, gamma = gate
    r, weight, _ = part.terms(Candidate("posterior", sigma_d=2.0))
    sigmoid = torch.sigmoid((part.gram.float() - tau) / gamma)
    weight = weight.float()
    agreed = torch.bmm(sigmoid, weight[:, :, None]).squeeze(2)
    score = r * agreed
    best, choice = score[:, 1:].max(1)
    row, winner = torch.arange(len(r), device=r.device), choice + 1
    full = 4.0 * torch.sigmoid((1 - torch.as_tensor(tau)) / gamma).flatten().to(r)
    near = (agreed[row, winner] - weight[:, 0] * sigmoid[row, winner, 0]) / full
    lead = (agreed[row, winner] - agreed[:, 0]) / full
    square = (part.distance / 2.0) ** 2
    decay = torch.where(part.group[:, 1:] >= 0, torch.exp(-0.5 * square[:, 1:]), 0.0)
    mean = (r[:, 1:] * decay).sum(1) / decay.sum(1).clamp(min=1e-12)
    for form in forms:
        wins = (best > score[:, 0] + form.delta) & (r[:, 1:] > 0).any(1) & (near >= form.quorum)
        if form.margin > 0:
            wins &= lead >= form.margin
        if form.low > 0:
            wins &= r[:, 0] < form.low * mean
        if form.seen > 0:
            wins &= labeled >= form.seen
        if form.few > 0:
            wins &= weight[:, 0] < form.few
        place = torch.where(wins, winner, 0)
        yield place, part.gram.float()[row, place, 0]


def measured_cosines(lifted: Lifted, voters: Voters) -> Tensor:
    """Return the cosines for the relative gate, from a neighbor of each of at most 20,000 voters."""
    own = voters.group[:, 0]
    slot = (hash_to_unit(own) * (voters.group.shape[1] - 1)).long() + 1
    other = voters.group.gather(1, slot[:, None]).squeeze(1)
    keep = (other >= 0).nonzero().squeeze(1)[:20_000]
    return shared_region_cosines(lifted, own[keep], other[keep])


def neighbor_views(evidence: Evidence, group: Tensor) -> tuple[Tensor, Tensor]:
    """Return [m, K] numbers of views in which a neighbor shares the region of the voter, and of views that show
    both."""
    there = group[:, 1:] >= 0
    own = group[:, :1].expand_as(there)[there]
    together, both = (torch.zeros(there.shape, dtype=torch.float32, device=group.device) for _ in range(2))
    found = shared_views(evidence, own, group[:, 1:][there])
    together[there], both[there] = (x.float() for x in found)
    return together, both


def agreed_lifts(
    evidence: Evidence, features: Tensor, seen: Lifted, *, judge: bool
) -> tuple[dict[bool, Lifted], float, dict[str, list[float]]]:
    """Return the lifts after the consensus, B, and figures of left-out views.

    The lifts are those with the ramp of the consensus (False) and at full strength (True), with R from before it.
    """
    chosen, chance = sample_gaussians(evidence.rows, evidence.num_regions, SAMPLE)
    rows, total = evidence.rows.select_rows(chosen), total_view_weights(evidence.select_gaussians(chosen))
    overlaps = region_overlaps(rows, evidence.region_view, chance, total)
    tables = {False: apply_consensus(features, overlaps), True: apply_consensus(features, overlaps, least=0.0)}
    lifts = {key: replace(lift(evidence, x), scalars=seen.scalars) for key, x in tables.items()}
    left_out = {}
    if judge:
        sampled = evidence.select_gaussians(chosen)
        for name, least in (("none", None), ("consensus", 0.4), ("forced", 0.0)):
            found = leave_views_out(sampled, chance, features, least=least)
            left_out[name] = [found.recognized, found.confirmed, round(found.agreement, 5)]
    return lifts, overlaps.agreement, left_out


def reliabilities(site: Site, observed: Any, seen: Lifted) -> dict[str, Tensor]:
    """Return [M], every form of R of the voters."""
    own, cameras = site.voters.group[:, 0], [site.world.cameras[i] for i in observed.views]
    centers = torch.stack([camera.world_to_camera.double().cpu().inverse()[:3, 3] for camera in cameras])
    means = site.world.scene.means if site.kept is None else site.world.scene.means[site.kept]
    scalars = seen.scalars
    weights = observed.evidence.view_weights().select_rows(own)
    views = independent_views(weights, means[own].double(), centers.to(own.device))
    norm, n_eff = scalars.norm[own].double(), scalars.n_eff[own].double()
    return {
        "paper": scalars.reliability[own].double(),
        "views": reliability(norm, views, 1.0),
        "pairs": pair_reliability(norm, n_eff, 1.0),
        "angular": pair_reliability(norm, views, 1.0),
        "views alone": views,
    }


def ranked(key: Tensor, right: Tensor) -> dict[str, Any]:
    """Return the AUC of being correct, and accuracy and mean of ten bins by ascending key, for keys above 0."""
    there = key > 0
    key, right = key[there], right[there].double()
    if len(key) < 10 or not 0 < float(right.mean()) < 1:
        return {"auc": None}
    _, inverse, count = key.unique(return_inverse=True, return_counts=True)
    rank = (count.cumsum(0) - (count - 1) / 2)[inverse]
    positive = right.sum()
    auc = float(((rank * right).sum() - positive * (positive + 1) / 2) / (positive * (len(right) - positive)))
    bins = key.argsort(stable=True).tensor_split(10)
    return {"auc": round(auc, 4), "bins": [round(float(right[x].mean()), 4) for x in bins],
            "means": [round(float(key[x].mean()), 4) for x in bins]}  # fmt: skip


def edge_of(site: Site, voters: Voters) -> Tensor:
    """Return [M], True if a voter is at an edge."""
    truth = site.world.truth if site.kept is None else site.world.truth[site.kept]
    near = torch.where(voters.group[:, 1:] >= 0, truth[voters.group[:, 1:].clamp(min=0)], -1)
    other = (near >= 0) & (near != voters.truth[:, None])
    return other.sum(1) > EDGE * (near >= 0).sum(1)


def observed_forms(
    site: Site, cell: Cell, seed: int, all_forms: Sequence[Form] = FORMS, *, judge: bool = False
) -> dict[str, Any]:
    """Return all figures of one observation; with left-out views if `judge` is True."""
    observed = site.observed(cell, seed)
    words = site.looks if cell.statistic == "histogram" else site.words[cell.statistic]
    classes, voters = words.classes.to(observed.features.device), site.voters
    seen = lift(observed.evidence, observed.features)
    judge = judge and cell.kind == "masks"
    lifts, agreement, left_out = agreed_lifts(observed.evidence, observed.features, seen, judge=judge)
    edge, truth = edge_of(site, voters), voters.truth
    answers, changed, copied = [], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    own = voters.group[:, 0]
    for lifted in (seen, lifts[False], lifts[True]):
        scores = lifted_scores(lifted, classes)
        answers.append(classify(scores.cosine, scores.valid)[own])
    blank = observed.evidence.unlabeled.select_rows(own).row_sums()
    weight = observed.evidence.rows.select_rows(own).row_sums()
    labeled = torch.where(weight + blank > 0, weight / (weight + blank), 1.0)
    names, before = ["lift", "consensus", "forced consensus"], [0, 0, 0]
    gates, views = {}, None
    if any(form.shared or form.local for form in all_forms):
        views = [neighbor_views(observed.evidence, x) for x in voters.group.split(CHUNK[own.device.type])]
    for forced, lifted in lifts.items():
        scores = lifted_scores(lifted, classes)
        plain = classify(scores.cosine, scores.valid)
        measured = measured_cosines(lifted, voters)
        gates[forced] = relative_gate(measured)
        forms = [form for form in all_forms if form.forced == forced]
        by_gate: dict[tuple[float, float], list[Form]] = {}
        for form in forms:
            by_gate.setdefault(gate_of(form, measured), []).append(form)
        found: dict[Form, list[tuple[Tensor, Tensor]]] = {form: [] for form in forms}
        for start, part in enumerate(parts(lifted, voters, cosines=True)):
            first = start * CHUNK[own.device.type]
            share = labeled[first : first + len(part.group)]
            near = views[start] if views is not None else (share, share)
            for gate, some in by_gate.items():
                for form, (place, cosine) in zip(some, decided(part, gate, some, share, near), strict=True):
                    found[form].append((part.group.gather(1, place[:, None]).squeeze(1), cosine))
        for form in forms:
            source, cosine = (torch.cat(x) for x in zip(*found[form]))
            names.append(form.name)
            before.append(2 if forced else 1)
            answers.append(plain[source])
            copied.append(float((source != own).float().mean()))
            changed.append(float(((source != own) & (cosine < CHANGED)).float().mean()))
    stacked = torch.stack(answers)
    right = stacked == truth
    base = right[torch.tensor(before, device=right.device)]
    values = {
        "miou": mious(stacked, voters),
        "right": (100 * right.float().mean(1)).tolist(),
        "edge": (100 * right[:, edge].float().mean(1)).tolist(),
        "mended": (100 * (right & ~base).float().mean(1)).tolist(),
        "broken": (100 * (base & ~right).float().mean(1)).tolist(),
        "copied": copied,
        "changed": changed,
    }
    values: dict[str, Any] = {key: [round(x, 4) for x in value] for key, value in values.items()}
    values["R"] = {key: ranked(x, right[1]) for key, x in reliabilities(site, observed, seen).items()}
    return {"names": names, "B": agreement, "left_out": left_out, "gates": [gates[False], gates[True]],
            "edges": int(edge.sum()), "voters": len(truth), **values}  # fmt: skip


@lru_cache(maxsize=1)
def site_of(place: Place, settings: Settings) -> Site:
    """Return the site of a place; the last one is cached."""
    return Site(place, settings)


@torch.no_grad()
def run_cells(
    cells: Sequence[Cell],
    settings: Settings,
    seeds: Sequence[int],
    path: Path,
    deadline: float,
    judge: bool,
    later: bool,
) -> None:
    """Run cells of one place; pieces of images use only the first seed."""
    for cell in cells:
        for seed in seeds if cell.kind == "masks" else seeds[:1]:
            if time.time() > deadline:
                return
            site = site_of(Place.of(cell), settings)
            found = observed_forms(site, cell, seed, LATER if later else FORMS, judge=judge)
            append(path, {"cell": list(cell), "seed": seed, **found})


def jobs_of(cells: Sequence[Cell], size: int) -> Iterator[list[Cell]]:
    places: dict[Place, list[Cell]] = {}
    for cell in cells:
        places.setdefault(Place.of(cell), []).append(cell)
    for some in places.values():
        for first in range(0, len(some), size):
            yield some[first : first + size]


def main(arguments: argparse.Namespace) -> None:
    deadline = time.time() + 60 * arguments.minutes
    settings = Settings(voters=arguments.voters, device="cuda" if torch.cuda.is_available() else "cpu")
    scenes, seeds = arguments.scenes, SEEDS[: arguments.seeds]
    if arguments.quick:
        settings = Settings(voters=80, gaussians=2500, pieces=30, room_views=8, room_width=160)
        scenes, seeds = ["demo"], SEEDS[:1]
    cells = [cell for scene in scenes for cell in (*cells_of(scene), *real_cells_of(scene))]
    if arguments.statistics:
        cells = [cell for cell in cells if cell.statistic in arguments.statistics and cell.kind == "masks"]
    if arguments.quick:
        cells = [cell for cell in cells if cell.statistic == "clip" and cell.kind == "masks" and cell.damage == "mild"]
    done = {(*row["cell"], row["seed"]) for row in read_rows(arguments.rows, {})}
    cells = [cell for cell in cells if any((*cell, seed) not in done for seed in seeds)]
    kind = (arguments.rows, deadline, arguments.judge, arguments.later)
    jobs = [(some, settings, seeds, *kind) for some in jobs_of(cells, arguments.chunk)]
    if arguments.workers == 1:
        for job in jobs:
            run_cells(*job)
        return
    context = multiprocessing.get_context("spawn")
    with context.Pool(arguments.workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        pool.starmap(run_cells, jobs, chunksize=1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=[*CHOICE, *CONFIRMATION])
    parser.add_argument("--voters", type=int, default=6000, help="Gaussians of a scene that vote and count")
    parser.add_argument("--seeds", type=int, default=len(SEEDS))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--chunk", type=int, default=18, help="cells that a process takes at a time")
    parser.add_argument("--minutes", type=float, default=1e6, help="minutes after which no observation starts")
    parser.add_argument("--judge", action="store_true", help="measure the recognition of left-out views too")
    parser.add_argument("--statistics", nargs="+", help="run only cells of these statistics")
    parser.add_argument("--later", action="store_true", help="run the candidates of the second study")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--rows", type=Path, default=RESULTS / "gate_rows.jsonl", help="finished observations")
    main(parser.parse_args())
