"""Hard cases of the lift, the storage and the vote, compared with the formulas in extended precision."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from normlift_ns import Evidence, Lifted, RefineConfig, lift, nearest_neighbors, refine
from normlift_ns.analysis.objects import best_prompt
from normlift_ns.core.lowrank import basis_of_rank, half_precision_error, spectral_table, store_directions
from normlift_ns.core.sparse import SparseRows
from research.hard_case import Case, Setting
from tests.random_scenes import generator, unit_rows

_GAPS = (1e-1, 1e-2, 1e-3, 1e-4)


def evidence_of(weights: Tensor, region_view: Sequence[int], blank: Tensor | None = None) -> Evidence:
    """Return the evidence of a dense matrix [N, S] and of unlabeled weights [N, views]."""
    views = max(region_view) + 1
    blank = torch.zeros(len(weights), views, dtype=weights.dtype) if blank is None else blank

    def rows(values: Tensor) -> SparseRows:
        row, column = values.nonzero(as_tuple=True)
        return SparseRows.from_coo(row, column, values[row, column], len(values))

    return Evidence(rows(weights), torch.tensor(region_view).int(), rows(blank), views)


def exact_lift(
    weights: Tensor, region_view: Sequence[int], table: Tensor, blank: Tensor | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return directions [N, D] and (norm, C_intra, C_inter, R, N_eff, W) [N, 6] with beta = 1, in extended
    precision."""
    e, view = weights.double().numpy().astype(np.longdouble), np.array(region_view)
    f = table.double().numpy().astype(np.longdouble)
    f = f / np.sqrt((f * f).sum(axis=1, keepdims=True))
    sums = np.stack([e[:, view == v] @ f[view == v] for v in range(view.max() + 1)])  # [V, N, D]
    by_view = np.stack([e[:, view == v].sum(axis=1) for v in range(view.max() + 1)])
    if blank is not None:
        by_view = by_view + blank.double().numpy().T
    lengths, total = np.sqrt((sums**2).sum(axis=2)).sum(axis=0), sums.sum(axis=0)
    length, weight = np.sqrt((total**2).sum(axis=1)), by_view.sum(axis=0)
    found = length > 1e-12 * weight
    with np.errstate(all="ignore"):
        norm, n_eff = length / weight, weight**2 / (by_view**2).sum(axis=0)
        values = (norm, lengths / weight, length / lengths, norm * n_eff / (n_eff + 1), n_eff)
        scalars = np.stack([np.where(found, x, 0) for x in values] + [weight], axis=1)
        return np.where(found[:, None], total / length[:, None], 0), scalars


def numbers(lifted: Lifted) -> tuple[np.ndarray, np.ndarray]:
    """Return the scalars of a lift in the order of `exact_lift`."""
    s = lifted.scalars
    columns = torch.stack([s.norm, s.c_intra, s.c_inter, s.reliability, s.n_eff, s.weight], dim=1)
    return lifted.directions().double().cpu().numpy(), columns.double().cpu().numpy()


def lift_errors(
    setting: Setting, weights: Tensor, region_view: Sequence[int], table: Tensor, blank: Tensor | None = None
) -> dict[str, float]:
    """Return the errors of a lift of float32 weights and features, in float32 and in float64."""
    directions, scalars = exact_lift(weights, region_view, table, blank)
    scale = np.ones_like(scalars)
    scale[:, 4:] = np.where(scalars[:, 4:] > 0, scalars[:, 4:], 1)
    errors = {}
    for suffix, dtype in (("", torch.float32), ("_double", torch.float64)):
        evidence = evidence_of(weights.to(dtype), region_view, None if blank is None else blank.to(dtype))
        unlabeled = "ignore" if blank is None else "dilute"
        found = numbers(lift(evidence.to(setting.device), table.to(setting.device, dtype), unlabeled=unlabeled))
        off = np.sqrt(((found[0] - directions) ** 2).sum(axis=1)), np.abs(found[1] - scalars) / scale
        errors |= {
            name + suffix: float(np.nan_to_num(x, nan=np.inf).max()) for name, x in zip(("direction", "scalars"), off)
        }
    return errors


def _worst(errors: Sequence[dict[str, float]]) -> dict[str, float]:
    return {name: max(x[name] for x in errors) for name in errors[0]}


def cancelling(setting: Setting) -> dict[str, float]:
    u = unit_rows(1, 64, 0, torch.float32)
    weights = torch.tensor([[1.0, 1.0, 0.0], [1e6, 1e6, 0.0], [3e-12, 3e-12, 0.0], [1.0, 1.0, 1e-3]])
    table = torch.cat([u, -u, unit_rows(1, 64, 1, torch.float32)])
    return _worst([lift_errors(setting, weights, views, table) for views in ([0, 0, 0], [0, 1, 2])])


def nearly_cancelling(setting: Setting) -> dict[str, float]:
    """Return the errors multiplied by the gap, which limits the precision of a float32 table."""
    found = []
    for gap in _GAPS:
        u, noise = unit_rows(1, 512, 0), gap * unit_rows(1, 512, 1)
        table = torch.cat([u, torch.nn.functional.normalize(-u + noise, dim=1)]).float()
        for views in ([0, 0], [0, 1]):
            errors = lift_errors(setting, torch.ones(1, 2), views, table)
            found.append({k: x * gap if k.startswith("direction") else x for k, x in errors.items()})
    return _worst(found)


def one_dominant_view(setting: Setting) -> dict[str, float]:
    return lift_errors(setting, torch.tensor([[1e6, 1.0, 1.0]]), [0, 1, 2], unit_rows(3, 512, 0, torch.float32))


def weights_of_all_sizes(setting: Setting) -> dict[str, float]:
    weights = [[1e-12, 2e-12, 0], [1e6, 1e-12, 3.0], [1e-12, 2e-12, 1e-12], [1e6, 1e6, 1e6], [1e-12, 0, 1e6], [0, 0, 0]]
    table = unit_rows(3, 512, 0, torch.float32)
    return _worst([lift_errors(setting, torch.tensor(weights), views, table) for views in ([0, 1, 2], [0, 0, 1])])


def weights_beyond(setting: Setting) -> dict[str, float]:
    """Check that weights below 1e-15 count as no evidence, and that NaN and weights above 1e15 raise an error."""
    table, wrong = unit_rows(2, 16, 0, torch.float32).to(setting.device), 0
    for dtype in (torch.float32, torch.float64):
        low = torch.tensor([[1e-16, 0], [1e-30, 1e-30], [1e-44, 0], [1e-38, -0.0]], dtype=dtype)
        lifted = lift(evidence_of(low, [0, 1]).to(setting.device), table.to(dtype))
        wrong += int((lifted.directions() != 0).sum()) + int((lifted.scalars.reliability != 0).sum())
        for value in (1e16, math.inf, math.nan, -1.0):
            try:
                lift(evidence_of(torch.tensor([[1.0, value]], dtype=dtype), [0, 1]).to(setting.device), table.to(dtype))
                wrong += 1
            except ValueError:
                pass
    return {"wrong": wrong}


def one_view(setting: Setting) -> dict[str, float]:
    return lift_errors(setting, torch.tensor([[1.0, 3.0], [2.0, 0.0]]), [0, 0], unit_rows(2, 512, 0, torch.float32))


def many_entries(setting: Setting) -> dict[str, float]:
    n = 10_000 if setting.small else 1_000_000
    weights = 1e-6 * (1 + 0.1 * torch.rand(1, n, generator=generator(0)))
    same, mixed = unit_rows(1, 16, 0, torch.float32).expand(n, -1), unit_rows(n, 16, 0, torch.float32)
    views = (torch.arange(n) * 40 // n).tolist()
    return _worst([lift_errors(setting, weights, views, table.contiguous()) for table in (same, mixed)])


def identical_features(setting: Setting) -> dict[str, float]:
    weights = torch.rand(50, 60, generator=generator(1))
    return lift_errors(
        setting, weights, (torch.arange(60) // 6).tolist(), unit_rows(1, 512, 0, torch.float32).repeat(60, 1)
    )


def dimensions(setting: Setting) -> dict[str, float]:
    weights, views = torch.rand(20, 30, generator=generator(2)), (torch.arange(30) // 6).tolist()
    one = torch.tensor([[1.0], [-1.0]]).repeat(15, 1)
    large = unit_rows(30, 1024, 0, torch.float32)
    return _worst([lift_errors(setting, weights, views, table) for table in (one, unit_rows(30, 3, 0).float(), large)])


def tiny_components(setting: Setting) -> dict[str, float]:
    """Use features along an axis with additional subnormal numbers and negative zeros."""
    table = torch.zeros(4, 512)
    table[:, 0] = torch.tensor([1.0, 1.0, -1.0, 1.0])
    table[0, 1:], table[1, 1:], table[3, 1:] = 1e-42, -0.0, 1e-38
    return lift_errors(setting, torch.rand(20, 4, generator=generator(3)), [0, 0, 1, 1], table)


def diluted(setting: Setting) -> dict[str, float]:
    weights, blank = (
        torch.tensor([[2.0, 0.0], [1e-12, 0.0], [0.0, 1e6]]),
        torch.tensor([[0.0, 2.0], [1e6, 0.0], [1e-12, 0.0]]),
    )
    return lift_errors(setting, weights, [0, 1], unit_rows(2, 512, 0, torch.float32), blank)


def _cosine_errors(setting: Setting, table: Tensor, rank: int | None) -> tuple[Tensor, Tensor]:
    """Return the errors [N] of the cosines of stored directions to 50 texts, and their bounds."""
    n, d = 40, table.shape[1]
    weights = torch.rand(n, len(table), generator=generator(4)) ** 8
    region_view = (torch.arange(len(table)) // 3).tolist()
    exact = torch.from_numpy(exact_lift(weights, region_view, table)[0].astype(np.float64))
    texts = torch.cat([unit_rows(40, d, 5), exact[:5], -exact[:5]])
    lifted = lift(evidence_of(weights, region_view).to(setting.device), table.to(setting.device))
    basis = None if rank is None else basis_of_rank(lifted, spectral_table(lifted.features), rank)
    stored = store_directions(lifted, None if basis is None else basis.rows, torch.arange(n, device=setting.device))
    found = stored.products(texts.float().to(setting.device), lifted.scalars).cpu()
    bound = torch.full((n,), half_precision_error(d if rank is None else rank)) + 1e-6
    if basis is not None:
        bound += basis.bound.cpu()
    return (found - exact @ texts.T).abs().nan_to_num(math.inf).amax(dim=1), bound - 10 * (found.abs() > 1).any(dim=1)


def half_precision(setting: Setting) -> dict[str, float]:
    flat = torch.full((9, 1024), 2.0**-5)
    axis = torch.zeros(9, 512)
    axis[:, 0], axis[:, 1:] = 1, 3e-8
    pairs = [_cosine_errors(setting, x, None) for x in (flat, axis, unit_rows(9, 1024, 0).float(), torch.ones(9, 1))]
    return {"direction": max(float(e.max()) for e, _ in pairs), "wrong": sum(int((e > b).sum()) for e, b in pairs)}


def rank_one(setting: Setting) -> dict[str, float]:
    error, bound = _cosine_errors(setting, unit_rows(9, 64, 0).float(), 1)
    line, line_bound = _cosine_errors(setting, unit_rows(1, 64, 0).float().repeat(9, 1), 1)
    return {"direction": float(line.max()), "wrong": int((error > bound).sum()) + int((line > line_bound).sum())}


def _sources(setting: Setting, means: Tensor, directions: Tensor, reliability: Sequence[float], k: int) -> list[int]:
    there = (x.to(setting.device) for x in (means.float(), directions.float(), torch.tensor(reliability)))
    points, u, r = there
    return refine(points, u, r, RefineConfig(vote="paper", k=k)).cpu().tolist()


def _wrong(found: Sequence[int], expected: Sequence[int]) -> int:
    return sum(a != b for a, b in zip(found, expected, strict=True))


def vote_ties(setting: Setting) -> dict[str, float]:
    """Use two opposite candidates at the same distance with the same R. The first in the file must win in any order."""
    points, axes = torch.tensor([[0.0, 0, 0], [1, 0, 0], [-1, 0, 0]]), torch.eye(8)[:3]
    wrong = 0
    for order in itertools.permutations(range(3)):
        index = list(order)
        expected = [i if g != 0 else min(j for j in range(3) if index[j] != 0) for i, g in enumerate(index)]
        found = _sources(setting, points[index], axes[index], [[0.0, 0.5, 0.5][g] for g in index], 2)
        wrong += _wrong([x for x, g in zip(found, index) if g == 0], [x for x, g in zip(expected, index) if g == 0])
    equal = torch.full((2, 4), 0.25, device=setting.device)
    return {"wrong": wrong + _wrong(best_prompt(equal, equal > 0).tolist(), [0, 0])}


def vote_underflow(setting: Setting) -> dict[str, float]:
    """Place a Gaussian 1,000 widths from all others, so that its decay is e^-500,000. The nearest reliable one must
    still win."""
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [1000, 0, 0], [1e6, 0, 0]])
    return {"wrong": _wrong(_sources(setting, points, torch.eye(8)[:5], [0.9, 0.9, 0.9, 0.0, 0.0], 4)[3:], [2, 2])}


def too_many_neighbors(setting: Setting) -> dict[str, float]:
    points, u = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]), torch.eye(8)[:3]
    few = nearest_neighbors(points.to(setting.device), 36).index.cpu()
    missing = int((few[:, 2:] != -1).sum()) + _wrong(few[:, :2].flatten().tolist(), [1, 2, 0, 2, 1, 0])
    alone = _sources(setting, points[:1], u[:1], [0.0], 36)
    return {"wrong": missing + _wrong(_sources(setting, points, u, [0.0, 0.9, 0.0], 36) + alone, [1, 1, 1, 0])}


def one_place(setting: Setting) -> dict[str, float]:
    found = _sources(setting, torch.zeros(50, 3), torch.eye(64)[:50], [0.0] * 49 + [0.9], 49)
    return {"wrong": _wrong(found, [49] * 50)}


def nobody_reliable(setting: Setting) -> dict[str, float]:
    points = torch.randn(30, 3, generator=generator(0))
    return {"wrong": _wrong(_sources(setting, points, torch.eye(64)[:30], [0.0] * 30, 12), range(30))}


_TABLE = "a float32 table has no more digits"
SUMS = (
    Case(
        "cancelling",
        "Opposite features of equal weight",
        "what cancels has no direction and R = 0; what stays over counts",
        "it takes the direction of its neighbours",
        cancelling,
    ),
    Case(
        "nearly_cancelling",
        "Opposite but for a gap of 0.1 to 1e-4",
        f"the error of the direction, times the gap, is 1e-6 at most: {_TABLE}; the norm keeps its own",
        "R is near 0, so that neighbours decide",
        nearly_cancelling,
        {"direction": 1e-6},
    ),
    Case(
        "one_dominant_view",
        "One view with a million times the weight of the others",
        "N_eff = 1, R = ‖f‖ / 2",
        "it counts as seen once",
        one_dominant_view,
    ),
    Case(
        "weights_of_all_sizes",
        "Weights from 1e-12 to 1e6, in one row and in rows side by side",
        "the bounds of the rule",
        "nothing",
        weights_of_all_sizes,
    ),
    Case(
        "weights_beyond",
        "Weights below 1e-15, subnormal, negative, infinite, NaN",
        "a sum below 1e-15 is no evidence; above 1e15, negative or NaN is refused by name",
        "a message; a rasterizer never gives such weights",
        weights_beyond,
    ),
    Case("one_view", "A single view", "N_eff = 1, C_inter = 1, R = ‖f‖ / 2", "nothing has R above 0.5", one_view),
    Case(
        "many_entries",
        "A million small weights on one Gaussian",
        "the bounds of the rule: long sums are taken in float64",
        "nothing",
        many_entries,
    ),
    Case(
        "identical_features",
        "All features the same",
        "norm 1, never above",
        "R says how often it was seen",
        identical_features,
    ),
    Case("dimensions", "Features of 1, 3 and 1,024 numbers", "the bounds of the rule", "nothing", dimensions),
    Case(
        "tiny_components",
        "Features with subnormal numbers and negative zeros",
        "they count as zero",
        "nothing",
        tiny_components,
    ),
    Case(
        "diluted",
        "`--unlabeled dilute` with 1e18 times more unlabelled than labelled weight",
        "below a share of 1e-6 (float32) or 1e-12 it is no evidence",
        "it takes the direction of its neighbours",
        diluted,
    ),
    Case(
        "half_precision",
        "Storage in float16: all components equal, all but one below the least float16, 1,024 of them, one",
        "within the bound that the manifest states, 4.9e-4 and a little; no cosine above 1",
        "nothing",
        half_precision,
        {"direction": 6e-4},
    ),
    Case(
        "rank_one",
        "Low rank with rank 1",
        "every Gaussian within its own bound; exact where all features are on a line",
        "such a rank is chosen only where the tolerance allows",
        rank_one,
        {"direction": 6e-4},
    ),
    Case(
        "vote_ties",
        "Votes and relevancies that tie exactly",
        "the nearer wins; of equally near ones, and of prompts, the first: on CPU and GPU, in any order of the file",
        "which of two equals wins depends on their order in the file, and on nothing else",
        vote_ties,
    ),
    Case(
        "vote_underflow",
        "Votes whose decay underflows: 1,000 and a million widths away",
        "the nearest reliable one wins",
        "a far floater takes the direction of whatever is nearest",
        vote_underflow,
    ),
    Case(
        "too_many_neighbors",
        "More neighbours asked for than there are",
        "those that there are vote",
        "nothing",
        too_many_neighbors,
    ),
    Case(
        "one_place", "50 Gaussians at one place, one of them reliable", "all take its direction", "nothing", one_place
    ),
    Case(
        "nobody_reliable",
        "R = 0 everywhere",
        "nobody wins, nothing changes",
        "nothing answers a query",
        nobody_reliable,
    ),
)
