"""Tables of the pages that `research.pages` updates, from the results files."""

from __future__ import annotations

import math

from normlift_ns.evaluation.published import TABLES, with_own_column
from research.accuracy_report import OTHERS
from research.agreement import by_regions
from research.documents import PRESETS, TITLES, Document, Documents, steps, table
from research.grid_tables import columns, geometry, real_columns, verdicts
from research.hard_case import DOUBLE, QUANTITIES
from research.numerics import CASES
from research.segments_tables import segments, segments_objects
from research.signals import STEP
from research.worlds import FACTORS

PREFIXES = {"tabletop": "tabletop.", "demo": "demo."}
"""Prefix of the keys of accuracy.json, by scene."""
FLAGS = {
    "exact": "`--precision double`", "float32": "default", "half_resolution": "`--lift-downscale 2`",
    "every_second_view": "`--max-views` half", "low_rank": "`--storage low_rank --tolerance 0.05`",
}  # fmt: skip


def tables(found: Documents) -> dict[str, str]:
    """Return every table by its name in the markers of the pages; `origin-…` is the line with the command and the
    machine."""
    accuracy, fit, signals, h100 = (found[name] for name in ("accuracy", "fit", "signals", "h100"))
    return {
        **{f"origin-{name}": f"`{one.command}` on {one.hardware}.\n" for name, one in found.items()},
        "ablation-both": ablation(accuracy, "both scenes", "", others=False),
        "undamaged": ablation(accuracy, "undamaged", "", "undamaged", others=False),
        "views3": ablation(accuracy, "3 views", "", "views3", others=False),
        **{f"ablation-{scene}": ablation(accuracy, scene, prefix) for scene, prefix in PREFIXES.items()},
        **{f"damage-{scene}": damage(accuracy, scene) for scene in PREFIXES},
        **{f"reliability-{scene}": reliability(accuracy, scene) for scene in PREFIXES},
        "evidence": evidence(signals),
        "opacity": opacity(signals),
        "views": views(signals),
        "mixtures": mixtures(signals),
        "parameters": parameters(fit),
        "held-out": held_out(fit),
        "presets": presets(found["presets"], accuracy, found["losses"]),
        "stages": stages(h100),
        "growth": growth(h100),
        "core-cpu": every_metric(found["cpu"]),
        "forms": every_metric(found["forms"], "_tol0.01_"),
        "numerics-rule": numerics_rule(),
        "numerics-cases": numerics_cases(),
        "numerics-errors": numerics_errors(found["numerics"], found["numerics_gpu"]),
        "overhead": overhead(found["overhead"]),
        "grid-choice": verdicts(found["grid"], "choice"),
        "grid-second": verdicts(found["grid"], "second"),
        "grid-third": verdicts(found["grid"], "third"),
        "grid-columns": columns(found["grid"], found["grid_real"]),
        "geometry": geometry(found["geometry"]),
        "grid-real": real_columns(found["grid_real"]),
        "segments": segments(found["segments"]),
        "segments-objects": segments_objects(found["segments"]),
        "plans": plans(found["planning_gpu"]),
        "agreement": by_regions(found["agreement"]),
        "worlds": worlds(found["worlds"]),
        "focal": focal(found["worlds"]),
        **{f"paper-{name}": published(name) for name in TABLES},
    }


def published(name: str) -> str:
    """Return one table of the paper, with an empty column for the reader's own numbers."""
    rows = with_own_column(TABLES[name], {})
    shown = [
        [
            "" if isinstance(x, float) and math.isnan(x) else f"{x:g}" if isinstance(x, float) else x
            for x in row.values()
        ]
        for row in rows
    ]
    return table(tuple(rows[0]), shown)


def ablation(accuracy: Document, label: str, prefix: str, group: str = "ablation", *, others: bool = True) -> str:
    """Return means over steps of damage, with the worst observation and the share that is copied."""
    v, rows = accuracy.values, []
    for name, title in TITLES.items():
        key = f"{prefix}{group}.{name}"
        if f"{key}.miou" not in v:
            continue
        scores = (accuracy.interval(f"{key}.{c}") for c in ("miou", "macc", "miou_2d"))
        worst = f"{v[f'{key}.worst']:+.1f}" if f"{key}.worst" in v and name != "none" else ""
        shares = (f"{100 * v[f'{key}.{x}']:.0f} %" if f"{key}.{x}" in v else "" for x in ("share_worse", "copied"))
        gain = accuracy.interval(f"{key}.gain") if name != "none" else ""
        rows.append((title, *scores, gain, worst, *shares))
    for name, title in OTHERS.items() if others else ():
        key = f"{prefix}baseline.{name}"
        rows.append((f"*{title}*", accuracy.interval(f"{key}.miou"), accuracy.interval(f"{key}.macc"), *[""] * 5))
    header = ("mIoU", "mAcc", "mIoU in held-out views", "better than without", "worst", "worse by > 1", "copied")
    return table((label, *header), rows)


def damage(accuracy: Document, scene: str) -> str:
    """Return the mIoU of every variant on every step."""
    start = f"{PREFIXES[scene]}ladder"
    names = [name for name in TITLES if f"{start}.{steps(accuracy)[0]}.{name}.miou" in accuracy.values]
    rows = [(step, *(accuracy.interval(f"{start}.{step}.{name}.miou") for name in names)) for step in steps(accuracy)]
    return table((f"{scene}, mIoU", *(TITLES[name] for name in names)), rows)


def reliability(accuracy: Document, scene: str) -> str:
    """Return the rank correlations of R and of the norm with accuracy."""
    v, prefix, rows = accuracy.values, PREFIXES[scene], []
    for step in (step for step in steps(accuracy) if f"{prefix}reliability.{step}.lowest_bin" in v):
        low, high = (v[f"{prefix}reliability.{step}.{end}_bin"] for end in ("lowest", "highest"))
        ranks = (f"{v[f'{prefix}{name}.{step}.spearman_bins']:.2f}" for name in ("reliability", "norm"))
        rows.append((step, *ranks, f"{low:.0f} to {high:.0f} %"))
    return table((scene, "by R", "by norm", "accuracy, lowest to highest tenth of R"), rows)


def evidence(signals: Document) -> str:
    """Return figures of Gaussians with and without evidence."""
    s, rows = signals.values, []
    for scene in PREFIXES:
        for group, label in (("all", "all"), ("zero", "R = 0"), ("seen", "R > 0")):
            key = f"{scene}.{STEP}.{group}"
            share, faint, right = (f"{100 * s[f'{key}.{x}']:.1f} %" for x in ("share", "faint", "accuracy_unrefined"))
            mean, seen = f"{s[f'{key}.opacity']:.3f}", f"{s[f'{key}.views']:.1f}"
            rows.append((f"{scene}, {label}", share, mean, faint, seen, right))
    return table(("", "share", "mean opacity", "opacity < 0.1", "views", "accuracy"), rows)


def opacity(signals: Document) -> str:
    """Return the comparison of R with opacity."""
    s, rows = signals.values, []
    for scene in PREFIXES:
        key = f"{scene}.{STEP}.opacity"
        fifths = ", ".join(f"{s[f'{key}.quintile{i}']:.2f}" for i in range(1, 6))
        rows.append((scene, *(f"{s[f'{key}.{x}']:.3f}" for x in ("spearman", "kendall", "jaccard")), fifths))
    header = ("R > 0 against opacity", "Spearman", "Kendall", "Jaccard, lowest fifths", "opacity by fifths of R")
    return table(header, rows)


def views(signals: Document) -> str:
    """Return the mIoU by number of views, before and after the vote."""
    counts = [k.split(".")[:3:2] for k in signals.values if ".views." in k and k.endswith(".paper.miou")]
    rows = [
        (f"{scene}, {n}", *(signals.interval(f"{scene}.views.{n}.{x}.miou") for x in ("none", "paper")))
        for scene, n in counts
    ]
    return table(("views", "before", "after"), rows)


def mixtures(signals: Document) -> str:
    """Return the share of pairs of classes whose equal mixture is nearest to a third class."""
    s = signals.values
    keys = [k for k in s if k.startswith("tabletop.drift.") and k.endswith("mix0.5")]
    noise = [k.split("noise")[1].split(".mix")[0] for k in keys]
    rows = [(scene, *(f"{s[f'{scene}.drift.noise{x}.mix0.5']:.1f} %" for x in noise)) for scene in PREFIXES]
    return table(("length of the noise", *noise), rows)


def parameters(fit: Document) -> str:
    """Return the fitted parameters."""
    names = ("k", "sigma_d", "tau", "gamma", "delta")
    groups = (("fitted, for `--vote paper`", "fitted"), ("fitted for plain voting", "fitted_knn"))
    rows = [(label, *(f"{fit.values[f'{group}.{x}']:g}" for x in names)) for label, group in groups]
    return table(("", *names), rows)


def held_out(fit: Document) -> str:
    """Return the gain of the fit on other damage."""
    rows = [
        (label, *(fit.interval(f"{scene}held_out.{key}", 2) for scene in ("", "tabletop.", "demo.")))
        for key, label in (
            ("none", "unrefined"),
            ("fitted", "fitted"),
            ("fitted_minus_start", "fitted, against the first guess"),
            ("squared_minus_linear", "weights A^2 instead of A"),
            ("squared_minus_linear_unrefined", "the same, unrefined"),
            ("dilute_minus_ignore", "`--unlabeled dilute` instead of `ignore`"),
        )
    ]
    return table(("mIoU on damage that was not fitted to", "both", "tabletop", "demo"), rows)


def presets(document: Document, accuracy: Document, losses: Document) -> str:
    """Return time, memory and error of the whole lift, and its effect on mIoU if that was measured."""
    v, rows = document.values, []
    for name, label in PRESETS.items():
        seconds, memory = f"{v[f'{name}.s']:.3g} s", f"{v[f'{name}.peak_gib']:.2f} GiB"
        error, other = f"{v[f'{name}.rms_error']:.2g}", f"{100 * v[f'{name}.other_share']:.2g} %"
        key = "tabletop." + ("ablation.posterior.miou" if name == "float32" else f"preset.{name}.miou")
        task = (accuracy.interval(key), losses.interval(name, 2))
        rows.append((label, FLAGS.get(name, "benchmark only"), seconds, memory, error, other, *task))
    header = ("preset", "how", "time", "peak memory", "RMS error", "directions off by > 0.1", "mIoU, tabletop")
    return table((*header, "mIoU, demo"), rows)


def stages(h100: Document) -> str:
    """Return the seconds of the stages of a lift on a GPU with their errors against float64, one column per scene."""
    v, error = h100.values, {metric.key: metric.error for metric in h100.metrics}
    scenes = [key.removesuffix(".total_s") for key in v if key.endswith(".total_s")]

    def row(name: str, key: str, form: str, scale: float = 1.0, *, with_error: bool = False) -> list[str]:
        cells = [form.format(v[f"{one}.{key}"] / scale) for one in scenes]
        if with_error:
            off = (error[f"{one}.{key}"] for one in scenes)
            cells = [f"{cell}, {'0' if e == 0 else f'{e:.0e}'}" for cell, e in zip(cells, off)]
        return [name, *cells]

    rows = [
        row("Gaussians", "gaussians", "{:.2f} M", 1e6),
        row("views", "views", "{:.0f}"),
        row("RGB render of the views, stock gsplat", "rgb_s", "{:.3f} s"),
        row("evidence", "evidence_s", "{:.3f} s", with_error=True),
        row("lift: reliability and directions", "lift_s", "{:.3f} s", with_error=True),
        row("evidence + lift over RGB", "evidence_lift_over_rgb", "{:.2f}"),
        row("neighbours, K = 36", "neighbors_s", "{:.3f} s", with_error=True),
        row("vote", "vote_s", "{:.3f} s", with_error=True),
        row("all of it", "total_s", "{:.2f} s"),
        row("one text query", "query_ms", "{:.1f} ms"),
        row("peak memory of the GPU", "peak_gib", "{:.1f} GiB"),
        row("stock gsplat's 512-channel backward", "gsplat512_s", "{:.1f} s"),
        row("intersections of the first view", "intersections_per_view", "{:.2f} M", 1e6),
        row("contributors per pixel", "contributors_per_pixel", "{:.0f}"),
        row("entries of the evidence", "nonzeros", "{:.1f} M", 1e6),
    ]
    return table(("", *scenes), rows)


def growth(h100: Document) -> str:
    """Return the time for evidence as one quantity grows."""
    found = [m for m in h100.metrics if m.key.startswith("growth.")]
    names = [m.key.split(".", 1)[1].removesuffix(".evidence_s").rsplit("_", 1) for m in found]
    rows = []
    for what in dict.fromkeys(name for name, _ in names):
        mine = [(size, metric.value) for (name, size), metric in zip(names, found) if name == what]
        label = {"scale": "side of the image", "n": "Gaussians"}.get(what, what)
        rows.append((label, ", ".join(f"{size}: {1e3 * time:.0f}" for size, time in mine)))
    return table(("quantity", "milliseconds"), rows)


def plans(document: Document) -> str:
    """Return the estimates of plans for whole lifts, and the measured times."""
    v, rows = document.values, []
    for case in (key.removesuffix(".ratio") for key in v if key.endswith(".ratio")):
        capture, front_end, state = case.split(".")
        seconds = (f"{v[f'{case}.{x}']:.1f} s" for x in ("told_s", "taken_s", "wall_s"))
        memory = (f"{v[f'{case}.told_{x}']:.1f}, {v[f'{case}.taken_{x}']:.1f} GiB" for x in ("gib", "gpu_gib")
                  if f"{case}.told_{x}" in v)  # fmt: skip
        rows.append((f"{capture}, {front_end}, {state}", *seconds, f"{v[f'{case}.ratio']:.2f}", *memory))
    header = ("", "plan", "lift", "whole process", "plan / lift", "memory: plan, lift")
    on_gpu = any(key.endswith("gpu_gib") for key in v)
    return table((*header, "GPU memory: plan, lift") if on_gpu else header, rows)


def overhead(document: Document) -> str:
    """Return the times of whole commands, measured in turns with those of another version."""
    v, rows = document.values, []
    for what in ("lift", "query"):
        for kind in ("wall", "cpu"):
            key = f"{what}_{kind}"
            costs = (f"{v[f'{key}_{one}']:.2f} ± {v[f'{key}_{one}_spread']:.2f} s" for one in ("before", "now"))
            rows.append((f"{what}, {kind} time", *costs, f"{v[f'{key}_change']:+.1%}"))
    return table(("command", "version 0.1", "now", "change"), rows)


def worlds(document: Document) -> str:
    """Return the margins of right and wrong worlds, and the results of the search."""
    v, rows = document.values, []
    for name in (key.removesuffix(".right.margin") for key in v if key.endswith(".right.margin")):
        found = [value for key, value in v.items() if key.startswith(f"{name}.") and key.endswith(".found")]
        seconds = [v[key.replace(".found", ".seconds")] for key in v if key.startswith(f"{name}.") and ".found" in key]
        margins = (f"{v[f'{name}.{world}.margin']:.1f}" for world in ("right", "wrong"))
        taken = f"{v[f'{name}.random.taken']:.0f} of {v[f'{name}.random.rotations']:.0f}"
        times = f"{min(seconds):.1f} to {max(seconds):.1f} s"
        rows.append((name, *margins, f"{sum(found):.0f} of {len(found)}", times, taken))
    header = ("margin, right world", "largest margin, wrong world", "worlds found", "time", "random rotations taken")
    return table(("", *header), rows)


def focal(document: Document) -> str:
    """Return PSNR and margin with wrong focal lengths."""
    v, rows = document.values, []
    for name in (key.removesuffix(".right.margin") for key in v if key.endswith(".right.margin")):
        keys = [f"{name}.focal{factor}" for factor in FACTORS]
        rows.append((name, *(f"{v[f'{key}.psnr']:.1f} ({v[f'{key}.margin']:.1f})" for key in keys)))
    return table(("", "right", *(f"{round(100 * factor - 100)} % longer" for factor in FACTORS[1:])), rows)


def every_metric(document: Document, having: str = "") -> str:
    """Return the unchanged metrics of one file whose keys contain a part."""
    rows = [
        (f"`{m.key}`", f"{m.value:.4g} {m.unit}", "" if m.error is None else f"{m.error:.1e}")
        for m in document.metrics
        if having in m.key
    ]
    return table(("what", "value", "relative error against float64"), rows)


def numerics_rule() -> str:
    """Return the quantities measured in hard cases, with their default bounds."""
    rows = [
        (name, quantity.unit, f"{quantity.bound:g}", f"{QUANTITIES[name + DOUBLE].bound:g}" if name != "wrong" else "0")
        for name, quantity in QUANTITIES.items()
        if not name.endswith(DOUBLE)
    ]
    return table(("error of", "in units of", "at most", "at most, `--precision double`"), rows)


def numerics_cases() -> str:
    """Return every hard case in words."""
    return table(
        ("case", "what it is", "expected", "what a person sees"),
        [(f"`{case.key}`", case.title, case.expected, case.seen) for case in CASES],
    )


def numerics_errors(cpu: Document, gpu: Document) -> str:
    """Return the errors of every hard case on both kinds of device, with their bounds."""
    rows = []
    for case in CASES:
        for name in (x for x in QUANTITIES if f"{case.key}.{x}" in cpu.values and not x.endswith(DOUBLE)):
            cells = []
            for quantity in (name, name + DOUBLE):
                key = f"{case.key}.{quantity}"
                errors = [f"{one.values[key]:.1g}" if key in one.values else "" for one in (cpu, gpu)]
                cells += [*errors, f"{case.bound(quantity):g}" if key in cpu.values else ""]
            rows.append((f"`{case.key}`", name, *cells))
    devices = ("CPU", "GPU", "at most")
    return table(("case", "error of", *devices, *(f"{x}, double" for x in devices)), rows)
