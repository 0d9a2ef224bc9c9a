"""Masks of texts, like those of SAM 3, lifted from all views and compared with single views.

    python -m research.segments                       the tabletop; writes results/segments.json
    python -m research.segments --scenes second third confirmation in synthetic rooms; prints, and writes nothing
    python -m research.segments --own                 also prints a comparison in the views of the masks

These settings were fixed before the first run. The seeds are 0 to 7. For each object and view that shows it, the exact
mask is missing with one probability, and is that of another object of the view with another probability (20 % and 10 %,
or those of other damages). The seed determines which. A changed rule is chosen on seeds 0 to 3 and confirmed on 4 to 7
and in the synthetic rooms.

For each seed, the report contains the IoU of the selection of each rule, and the median and best IoU of single views.
It also contains the numbers of objects that exceed the median by 5 points, that are no worse than the best, and of
both. The IoU is that of pixels of all views together, in which a Gaussian counts by its weight: the rendered selection
against the exact masks. A single view is the lift of its mask alone, evaluated in all views. Views with a missing or a
wrong mask count; views without the object do not.

In its own image, a given mask is exact in seven of ten views by construction, and no answer exceeds that. With --own,
this comparison is also printed for seeds 0 to 7 of the first damage. It has means over the views of an object: the IoU
of the mask of the view, and of the answer rendered in it (pixels of which it makes up more than half of the color).

Keys: <scene>.m<missing>w<wrong>d<pixels of dilation>.seed<n>.<count, or object>.<rule, or median, best>.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from normlift_ns import Camera, GaussianScene
from normlift_ns.query.sam3_query import MIN_MASK_FRACTION, MaskEvidence, mask_evidence
from normlift_ns.rasterization.rasterize import render
from research.report import Report
from research.second_room import second
from research.synthetic_scenes import World, demo
from research.third_room import third
from tests.captures import SHARED, trained_scene, training_cameras, training_indices

SEEDS = tuple(range(8))
WIDER = 3
"""Number of pixels by which masks are dilated."""


@dataclass(frozen=True)
class Damage:
    missing: float = 0.2
    wrong: float = 0.1
    dilated: bool = False

    @property
    def name(self) -> str:
        return f"m{100 * self.missing:.0f}w{100 * self.wrong:.0f}d{WIDER * self.dilated}"


DAMAGES = (
    Damage(), Damage(missing=0.0), Damage(missing=0.4), Damage(wrong=0.0), Damage(wrong=0.2), Damage(dilated=True),
)  # fmt: skip


@dataclass(frozen=True)
class Place:
    """A scene with the evidence of its exact masks and of dilated ones."""

    name: str
    objects: tuple[str, ...]
    scene: GaussianScene
    cameras: list[Camera]
    maps: list[Tensor]
    """[H, W] object of every pixel per view, or -1 for none."""

    @cached_property
    def both(self) -> MaskEvidence:
        """Evidence of exact masks and then dilated ones, rasterized once."""
        masks = []
        for labels in self.maps:
            exact = torch.stack([labels == i for i in range(len(self.objects))])
            wide = torch.nn.functional.max_pool2d(exact.float(), 2 * WIDER + 1, stride=1, padding=WIDER) > 0
            masks.append(torch.cat([exact, wide]))
        return mask_evidence(self.scene, self.cameras, masks)

    @cached_property
    def held(self) -> Tensor:
        """[2Q, V, N] weight of every Gaussian in the masks of every view, for exact masks and then dilated ones."""
        evidence, inside = self.both.evidence, self.both.inside
        rows, count = evidence.rows, len(self.scene)
        column = rows.column.long()
        place = evidence.region_view[column].long() * count + rows.row_index()
        held = torch.zeros(len(inside), len(self.maps) * count)
        for text, within in enumerate(inside[:, column]):
            held[text].index_add_(0, place[within], rows.weight[within])
        return held.unflatten(1, (-1, count))

    @cached_property
    def total(self) -> Tensor:
        """[V, N] weight of every Gaussian in every view."""
        evidence = self.both.evidence
        column, count = evidence.rows.column.long(), len(self.scene)
        place = evidence.region_view[column].long() * count + evidence.rows.row_index()
        total = torch.zeros(len(self.maps) * count).index_add_(0, place, evidence.rows.weight)
        return total.unflatten(0, (-1, count))

    @cached_property
    def appears(self) -> Tensor:
        """[Q, V] True if a view shows an object."""
        return torch.stack([(m == i).any() for i in range(len(self.objects)) for m in self.maps]).view(
            -1, len(self.maps)
        )

    def damaged(self, damage: Damage, seed: int) -> Tensor:
        """Return [Q, V], the object whose mask each view has for each object, or -1 for a missing mask."""
        g = torch.Generator().manual_seed(seed)
        whose = torch.full(self.appears.shape, -1)
        for view in range(len(self.maps)):
            there = self.appears[:, view].nonzero()[:, 0].tolist()
            for i in there:
                draw = float(torch.rand((), generator=g))
                others = [k for k in there if k != i] or [i]
                other = others[int(torch.randint(0, len(others), (), generator=g))]
                if draw >= damage.missing:
                    whose[i, view] = other if draw < damage.missing + damage.wrong else i
        return whose

    def asked(self, whose: Tensor, dilated: bool) -> MaskEvidence:
        """Return the masks that the program receives."""
        count = len(self.objects)
        chosen = whose[:, self.both.evidence.region_view.long()]
        masks = self.both.inside[count:] if dilated else self.both.inside[:count]
        return MaskEvidence(self.both.evidence, masks.gather(0, chosen.clamp(min=0)) & (chosen >= 0))


def share(held: Tensor, total: Tensor) -> Tensor:
    return torch.where(total > 0, held / total, 0.0)


def by_votes(held: Tensor, total: Tensor) -> Tensor:
    """Select by the rule in use, as in `MaskEvidence.answer`; `check` compares both."""
    drawn = by_sum_where_found(held, total)
    found, both = held.sum(1) > 0, held[:, drawn].sum(1, dtype=torch.float64)
    either = held.sum(1, dtype=torch.float64) + (total - held)[:, drawn].sum(1, dtype=torch.float64)
    votes = (both > 0.5 * either) | (either == 0)
    votes = votes if bool((votes & found).any()) else found
    return by_sum(held[votes], total[votes])


def by_sum(held: Tensor, total: Tensor) -> Tensor:
    """Select Gaussians with more than half of their weight over all views in the masks."""
    return share(*(part.sum(0, dtype=torch.float64) for part in (held, total))) > MIN_MASK_FRACTION


def by_sum_where_found(held: Tensor, total: Tensor) -> Tensor:
    """Select like `by_sum`, without the views that have no mask."""
    found = held.sum(1) > 0
    return by_sum(held[found], total[found])


def by_majority(held: Tensor, total: Tensor) -> Tensor:
    """Select Gaussians that have more than half of their weight in the mask in more than half of the views that show
    them."""
    return 2 * (share(held, total) > MIN_MASK_FRACTION).sum(0) > (total > 0).sum(0)


RULES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "votes": by_votes,
    "sum": by_sum,
    "found": by_sum_where_found,
    "majority": by_majority,
}


def ious(chosen: Tensor, truth: Tensor, total: Tensor, whole: float) -> np.ndarray:
    """Return the IoU of the rendered selections [K, M] in all views.

    Args:
        truth, total: Weights [M] of the Gaussians in the masks of the object, and in all pixels.
        whole: Weight of all Gaussians in the masks of the object.
    """
    held, drawn = (chosen.float() @ torch.stack([truth, total], 1).float()).double().T
    return (held / (whole + drawn - held)).numpy()


def check(place: Place, whose: Tensor, selected: Tensor) -> None:
    """Check that `by_votes` agrees with the rule in use, except for one Gaussian in a thousand whose share is a
    half."""
    found = place.asked(whose, dilated=False)
    for text, chosen in enumerate(selected):
        answer = found.answer(text).mask
        assert int((answer ^ chosen).sum()) <= 1e-3 * int(answer.sum()), place.objects[text]


def measure(place: Place, damage: Damage, seed: int) -> tuple[dict[str, np.ndarray], Tensor]:
    """Return the IoU of every object by every rule, with median and best of single views, and the selections [Q, N].

    The selections are those of the rule in use.
    """
    whose, count = place.damaged(damage, seed), len(place.objects)
    of_all, rows, selected = place.total.sum(0, dtype=torch.float64), {}, []
    views = torch.arange(len(place.maps))
    for text in range(count):
        truth = place.held[text].sum(0, dtype=torch.float64)
        given = whose[text]
        held = place.held[given.clamp(min=0) + count * damage.dilated, views] * (given >= 0)[:, None]
        near = held.any(0).nonzero()[:, 0]  # no rule selects a Gaussian that no mask touches
        held, total = held[:, near], place.total[:, near]
        chosen = torch.stack([rule(held, total) for rule in RULES.values()])
        alone = (share(held, total) > MIN_MASK_FRACTION)[place.appears[text]]
        found = ious(torch.cat([chosen, alone]), truth[near], of_all[near], float(truth.sum()))
        single = found[len(RULES) :]
        values = dict(zip(RULES, found))
        for name, value in {**values, "median": float(np.median(single)), "best": float(single.max())}.items():
            rows.setdefault(name, []).append(value)
        mask = torch.zeros(len(of_all), dtype=torch.bool)
        mask[near] = chosen[0]
        selected.append(mask)
    return {name: np.array(values) for name, values in rows.items()}, torch.stack(selected)


def in_own_views(place: Place, selected: Sequence[Tensor]) -> list[tuple[float, float]]:
    """Return, for every seed, means over objects and views of the IoU of the mask of a view and of the answer rendered
    in it."""
    given, drawn = torch.zeros(2, len(selected), len(place.objects), dtype=torch.float64)
    whose = [place.damaged(Damage(), seed) for seed in range(len(selected))]
    for view, (labels, camera) in enumerate(zip(place.maps, place.cameras)):
        values, alpha = render(place.scene, camera, torch.cat(list(selected)).T.float())
        pictures = (values > MIN_MASK_FRACTION * alpha[..., None]).unflatten(2, (len(selected), -1))
        for seed in range(len(selected)):
            for text in place.appears[:, view].nonzero()[:, 0].tolist():
                exact, picture = labels == text, pictures[:, :, seed, text]
                mask = (labels == whose[seed][text, view]) & bool(whose[seed][text, view] >= 0)
                given[seed, text] += (mask & exact).sum() / (mask | exact).sum()
                drawn[seed, text] += (picture & exact).sum() / (picture | exact).sum()
    count = place.appears.sum(1)
    return [(float((a / count).mean()), float((b / count).mean())) for a, b in zip(given, drawn)]


def tabletop() -> Place:
    """Return the capture at its full size."""
    folder = SHARED / "captures" / "tabletop"
    names = json.loads((folder / "labels.json").read_text())["labels"]
    values = {int(value): i for i, value in enumerate(names)}
    assert list(values) == list(range(1, 13))
    files = sorted((folder / "instance").glob("*.png"))
    maps = [torch.from_numpy(np.array(Image.open(files[i]))).int() - 1 for i in training_indices("tabletop")]
    return Place("tabletop", tuple(names.values()), trained_scene("tabletop"), training_cameras("tabletop"), maps)


def of_world(world: World) -> Place:
    """Return a synthetic room without the classes that no training view shows."""
    shown = [i for i in range(world.classes) if bool((world.cells.maps == i).any())]
    lookup = torch.full((world.classes + 1,), -1, dtype=torch.int32)
    lookup[shown] = torch.arange(len(shown), dtype=torch.int32)
    maps = list(lookup[world.cells.maps])
    return Place(world.name, tuple(f"class {i}" for i in shown), world.scene, world.cameras, maps)


PLACES: dict[str, Callable[[], Place]] = {
    "tabletop": tabletop,
    "demo": lambda: of_world(demo()),
    "second": lambda: of_world(second()),
    "third": lambda: of_world(third()),
}


def add(report: Report, place: Place, damage: Damage, seed: int, rows: dict[str, np.ndarray]) -> None:
    """Add the counts of every rule and, for the first damage, the figures of every object."""
    key, said = f"{place.name}.{damage.name}.seed{seed}", []
    for rule in RULES:
        above, as_good = rows[rule] >= rows["median"] + 0.05, rows[rule] >= rows["best"]
        for name, count in (("above_median", above), ("not_below_best", as_good), ("both", above & as_good)):
            report.add(f"{key}.{name}.{rule}", int(count.sum()), f"of {len(place.objects)} objects")
        report.add(f"{key}.mean.{rule}", float(rows[rule].mean()), "IoU")
        said.append(f"{rule} {above.sum()} {as_good.sum()} {(above & as_good).sum()} {rows[rule].mean():.3f}")
    if damage == Damage():
        for name, values in rows.items():
            for thing, value in zip(place.objects, values):
                report.add(f"{key}.{thing}.{name}", value, "IoU")
    failed = [thing for thing, one, best in zip(place.objects, rows["votes"], rows["best"]) if one < best]
    print(key, *said, "below the best: " + (", ".join(failed) or "none"), sep="; ", flush=True)


def main(scenes: Sequence[str], own: bool) -> None:
    torch.set_grad_enabled(False)
    report = Report("segments")
    for scene in scenes:
        place, selections = PLACES[scene](), []
        for damage in DAMAGES:
            for seed in SEEDS:
                rows, selected = measure(place, damage, seed)
                add(report, place, damage, seed, rows)
                selections += [selected] if damage == Damage() else []
        check(place, place.damaged(Damage(), 0), selections[0])
        for seed, (given, drawn) in enumerate(in_own_views(place, selections) if own else []):
            print(f"{scene}.{Damage().name}.seed{seed}.own: given {given:.3f}, drawn {drawn:.3f}", flush=True)
    if list(scenes) == ["tabletop"]:
        report.write()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=tuple(PLACES), default=["tabletop"])
    parser.add_argument("--own", action="store_true", help="also compare in the views of the masks; takes minutes")
    given = parser.parse_args()
    main(given.scenes, given.own)
