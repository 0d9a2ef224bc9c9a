"""The state of a session, the Gaussian under the pointer and the explanation of a selection, as JSON types."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from normlift_ns.analysis.explain import ViewVote
from normlift_ns.errors import InputError
from normlift_ns.query.engine import Finding
from normlift_ns.server import protocol
from normlift_ns.server.runs import ServedRun, to_jpeg, without_paths
from normlift_ns.session import actions
from normlift_ns.session.actions import diagnose_prompts, threshold_suggestion
from normlift_ns.session.objects import ObjectRow, list_objects
from normlift_ns.session.region import inside_polygon, near_path, project, visible_gaussians
from normlift_ns.session.state import State

MAX_OBJECTS = 24
_MAX_HISTOGRAMS = 8
_IMAGE_SIZE = 480
_CHANGED = "; the vote of neighboring Gaussians changed {:.0%} of the directions"


def region_mask(served: ServedRun, state: State, value: protocol.Region | protocol.Brush) -> Bool[Tensor, " n"]:
    """Return the mask of the visible Gaussians whose centers lie in a region of a view.

    Raises:
        ValueError: The camera is not valid, or the region contains no visible Gaussian.
    """
    camera, scene = value.camera.camera(), served.run.scene
    pixels, inside = project(scene.gaussians.means, camera)
    rows = np.flatnonzero(inside)
    if isinstance(value, protocol.Brush):
        hit = near_path(pixels[rows], np.array(value.points), value.radius)
    else:
        hit = inside_polygon(pixels[rows], np.array(value.polygon))
    mask = served.space.empty_mask()
    mask[torch.from_numpy(rows[hit])] = True
    drawn = state.drawn & served.visible
    mask &= visible_gaussians(scene.gaussians, camera, drawn, rasterize_mode=scene.rasterize_mode)
    if not bool(mask.any()):
        raise InputError("This region has no visible Gaussians. Choose another region.")
    return mask


def describe_state(state: State, rows: np.ndarray, *, details: bool) -> tuple[dict[str, Any], tuple[ObjectRow, ...]]:
    """Return the content of the message "state", and the listed objects.

    Args:
        rows: Indices of the Gaussians on the page; see `ServedRun.rows`.
        details: Include objects, histograms and the suggested threshold, which takes longer.
    """
    selection, answer, query = state.selection, state.answer, state.query
    content: dict[str, Any] = {
        "prompts": _prompts_json(state),
        "threshold": None if query is None else query.threshold,
        "suggested": threshold_suggestion(state) if details else None,
        "reliability": 0.0 if query is None else query.min_reliability,
        "used_rule": None if query is None else query.rule,
        "used_negatives": [] if query is None else list(query.negatives),
        "shown": state.shown, "color_mode": state.color_mode, "colormap": state.colormap,
        "legend": protocol.legend(state),
        "selected": int(selection.sum()),
        "selected_visible": int((selection & state.drawn).cpu().numpy()[rows].sum()),
        "hidden": int((~state.drawn).sum()), "total": len(state.space),
        "layers": [{"name": x.name, "count": int(x.mask.sum()), "visible": x.visible} for x in state.layers],
        "grow": state.grow_steps, "by_hand": not state.prompts_select, "warning": state.warning,
        "details": details, "histogram": None, "objects": None, "more_objects": 0,
    }  # fmt: skip
    if not details:
        return content, ()
    if answer is not None and state.prompts_select:
        colors = dict(zip(answer.texts, protocol.prompt_display_colors(state)))
        content["histogram"] = [
            {
                "text": one.text, "color": colors[one.text], "warning": one.warning, "nearest": one.nearest_position,
                "threshold": one.histogram.threshold, "suggested": one.histogram.suggested, **one.histogram.to_json(),
            }
            for one in diagnose_prompts(state, max_prompts=_MAX_HISTOGRAMS)
        ]  # fmt: skip
    found = list_objects(state, max_objects=MAX_OBJECTS)
    content["more_objects"], content["in_smaller_parts"] = found.left_out, found.in_smaller_parts
    return content, found.objects


def _prompts_json(state: State) -> list[dict[str, Any]]:
    """Return one row per prompt, with its result or its error."""
    answer = state.answer
    colors = protocol.prompt_display_colors(state)
    rows = []
    for prompt in state.prompts:
        row: dict[str, Any] = dict.fromkeys(("color", "verdict", "relevancy", "threshold", "count"))
        if answer is not None and prompt.error == "" and prompt.text in answer:
            finding = Finding(answer, answer.texts.index(prompt.text))
            row = {
                "color": colors[finding.index], "verdict": finding.verdict, "threshold": answer.question.threshold,
                "relevancy": None if finding.peak is None else min(1.0, finding.peak),
                "count": int(finding.mask.sum()),
            }  # fmt: skip
        rows.append({"text": prompt.text, "error": prompt.error or None, **row})
    return rows


def object_json(state: State, number: int, row: ObjectRow) -> dict[str, Any]:
    """Return a listed object as JSON types."""
    means, answer = state.space.means[row.mask].double(), state.answer
    ends = torch.quantile(means, means.new_tensor([0.01, 0.99]), dim=0).tolist()
    relevancy = None
    if answer is not None and state.prompts_select and row.text in answer:
        relevancy = min(1.0, float(answer[row.text].relevancy[row.mask].max()))
    return {
        "id": number, "name": row.name, "text": row.text, "count": row.size, "center": row.center, "color": row.color,
        "box": {"min": ends[0], "max": ends[1]}, "relevancy": relevancy, "reliability": row.reliability,
        "evidence": row.evidence, "views": row.mean_views,
    }  # fmt: skip


def describe_hover(
    served: ServedRun, state: State, value: protocol.Ray, objects: Sequence[tuple[int, ObjectRow]]
) -> dict[str, Any] | None:
    """Describe the Gaussian that `pick_gaussian` finds on the ray of the pointer; return None if it finds none."""
    with suppress(InputError):
        gaussian = actions.pick_gaussian(state, served.weights(value.origin, value.direction))
        position, answer = state.space.means[gaussian].double().cpu(), state.answer
        row = next(((number, one) for number, one in reversed(objects) if bool(one.mask[gaussian])), None)
        label, relevancy = None, None
        if answer is not None:
            best = int(answer.relevancy[gaussian].argmax()) if state.shown is None else state.shown
            relevancy = min(1.0, float(answer.relevancy[gaussian, best]))
            label = answer.texts[best] if bool(answer.selected[gaussian, best]) else None
        return {
            "gaussian": gaussian, "label": label, "relevancy": relevancy,
            "reliability": float(state.space.field.scalars.reliability[gaussian]),
            "object": None if row is None else {"id": row[0], "name": row[1].name},
            "position": position.tolist(), "selected": bool(state.selection[gaussian]),
            "distance": float((position - torch.tensor(value.origin, dtype=torch.float64)).norm()),
        }  # fmt: skip
    return None


def explanation_of(served: ServedRun, state: State) -> dict[str, Any]:
    """Return the content of the message "explanation": the images with the largest weight, and others that disagree.

    Raises:
        ValueError: Nothing is selected, or the votes of the images are no longer in the cache.
    """
    with served.analyzing:
        votes = served.run.votes
        why = votes.explain(state.selection.cpu(), refined=state.refined)
        groups = dict(zip(("support", "disagreement"), why.images_to_show()))
        images, problem = {}, None
        try:
            for picture in votes.pictures(dict.fromkeys(vote for group in groups.values() for vote in group)):
                images[picture.vote.view] = _data_url(to_jpeg(picture.image.cpu().numpy(), _IMAGE_SIZE))
        except (InputError, OSError) as error:
            problem = without_paths(f"Not all regions that voted can be outlined: {error}")
            images = _plain_images(served, [vote for group in groups.values() for vote in group]) | images

    def entry(vote: ViewVote) -> dict[str, Any]:
        facts = {"share": vote.share, "agreement": vote.agreement, "disagreement": vote.disagreement}
        return {"name": votes.names[vote.view], "url": images.get(vote.view), "regions": len(vote.regions), **facts}

    changed, count = _CHANGED.format(why.changed) if why.changed >= 0.005 else "", max(1, round(why.n_eff))
    facts = {"agreement": why.c_inter, "effective_views": why.n_eff, "problem": problem}
    facts |= {"name": state.name, "selected": why.gaussians}
    votes_of = {name: [entry(vote) for vote in group] for name, group in groups.items()}
    text = f"Based on about {count} image{'s' * (count > 1)}{changed}." if len(why.views) > 0 else why.words
    return {"text": text, **facts, **votes_of}


def _plain_images(served: ServedRun, votes: Sequence[ViewVote]) -> dict[int, str]:
    """Return the training images of votes as data URLs, without outlines; leave out images that cannot be read."""
    names, images = served.run.scene.train.names, {}
    for vote in votes:
        with suppress(InputError, OSError, ValueError):
            content = served.image(names.index(served.run.votes.names[vote.view]), _IMAGE_SIZE)
            images[vote.view] = _data_url(content)
    return images


def _data_url(jpeg: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
