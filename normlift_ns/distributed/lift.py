"""Distributed version of the steps of `pipeline`, with Gaussians and views divided among processes.

The result does not depend on the number of processes. The evidence of a view does not depend on other views, and
Gaussians are processed in the same blocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float, Float64, Int, Int32, Int64
from torch import Tensor

from normlift_ns import pipeline
from normlift_ns.core import lowrank
from normlift_ns.core.consensus import Consensus, check_consensus_inputs, sample_gaussians, sampled_consensus
from normlift_ns.core.evidence import Evidence
from normlift_ns.core.field import SemanticField, choose_form
from normlift_ns.core.lift import Lifted
from normlift_ns.core.neighbors import nearest_neighbors
from normlift_ns.core.partition import Communicator, Partition
from normlift_ns.core.refine import decay_width, labeled_share, refine_subset, sample_pairs, shared_region_cosines
from normlift_ns.distributed.communicator import (
    EvidenceShard,
    TorchCommunicator,
    all_gather_sparse,
    gather_halo,
    gather_sparse,
    redistribute_evidence,
)
from normlift_ns.evidence_collection import EvidenceCollection, Kernels, ViewObservations, chunk_views
from normlift_ns.io.run_dir import cache_folder
from normlift_ns.lifted_run import LiftedRun
from normlift_ns.options import LiftOptions
from normlift_ns.progress import StageTimer


def run_lift_distributed(team: TorchCommunicator, request: pipeline.LiftRequest) -> LiftedRun | None:
    """Run `run_lift` in several processes, each with the same request and the whole scene.

    Only process 0 writes and returns the run. All other processes return None.
    """
    prepared, before = pipeline.prepare_lift(request), StageTimer(request.report)
    run_dir = prepared.run_dir.with_name(team.broadcast_object(prepared.run_dir.name))  # clocks differ
    prepared = replace(prepared, run_dir=run_dir)
    if team.rank == 0:
        pipeline.check_target(prepared)
    pipeline.announce(prepared)
    pipeline.load_networks(prepared.source, cache_folder(run_dir))
    if team.rank == 0:
        pipeline.check_alignment(prepared, before, lambda: None)
    cache, device = cache_folder(run_dir), prepared.device
    collection = pipeline.plan_collection(
        prepared.scene, prepared.source, prepared.lift, cache, device=device, export=request.export
    )
    stages, facts = StageTimer(team.aggregate_progress(request.report)), {}
    options, means = collection.options, collection.gaussians.means
    kernels = pipeline.start_kernel_warm_up(collection.scene, collection.gaussians, options, collection.config)
    kernels.start_rasterization()
    portion = Partition.from_means(team, means)
    with team.shared_folder(cache):
        views = _collect(team, collection, portion, stages, kernels)
    table = views.features
    if options.consensus:
        with stages("consensus") as step:
            agreed = consensus_distributed(views, portion, **pipeline.consensus_options(options))
            step()
        table, facts = agreed.features, pipeline.consensus_facts(options, agreed)
    if options.recognition:
        with stages("recognition") as step:
            sample = gather_sample(views, portion, options.consensus_sample)
            local = pipeline.recognition_facts(views, options, sample) if team.rank == 0 else None
            facts |= team.broadcast_object(local)
            step()
    with stages("lift") as step:
        lifted, own = pipeline.lift_features(views, table, options)
        pipeline.check_directions(team.all_reduce(pipeline.count_directions(lifted)), len(means), collection.source)
        step()
    copied = None
    if options.refine:
        level = views.level if pipeline.measures_gate(options, facts) else None
        copied, options, vote_facts = vote_distributed(means, lifted, own, options, portion, stages, level=level)
        facts |= vote_facts
    with stages("store") as step:
        lifted = pipeline.with_stored_reliability(lifted, means[portion.indices], collection)
        statistics = pipeline.lift_statistics(collection, views, portion.all_gather(lifted.scalars.reliability), facts)
        provenance = pipeline.lift_provenance(collection, options, prepared.encoder, statistics)
        field = build_field_distributed(
            lifted, means, copied, portion,
            tolerance=options.tolerance, storage=options.storage, provenance=provenance,
        )  # fmt: skip
        step()
    if field is None:
        return None
    field = pipeline.add_null_level(field, collection, prepared.encoder)
    result = pipeline.LiftResult(pipeline.with_cost(field, stages, device), stages.seconds)
    return pipeline.write_lifted_run(prepared, result, before)


def _collect(
    team: TorchCommunicator,
    collection: EvidenceCollection,
    portion: Partition,
    stages: StageTimer,
    kernels: Kernels,
) -> ViewObservations:
    """Collect the chunks that this process can claim; return the observations of all views for its Gaussians."""
    chunks = chunk_views(collection.views, team.world_size)
    tables: dict[int, tuple[Tensor, Tensor]] = {}
    pieces: dict[int, EvidenceShard] = {}
    for index in team.claim_chunks(len(chunks)):
        evidence, features, level = collection.collect_chunk(chunks[index], stages, kernels)
        tables[index] = features, level
        with stages("evidence", len(collection.views)):
            pieces[index] = EvidenceShard.split(evidence, portion)
    with stages("exchange"):
        kernels.wait()
        evidence = redistribute_evidence(pieces, portion, len(chunks))
        features, level = _gather_tables(tables, team)
    return ViewObservations(evidence, features.to(portion.order.device, collection.config.dtype), level)


def _gather_tables(tables: Mapping[int, tuple[Tensor, Tensor]], team: Communicator) -> tuple[Tensor, Tensor]:
    """Return the features and levels of the regions of all chunks, in the order of the chunks."""
    local_chunks = sorted(tables)
    gathered = team.all_gather_object([[(chunk, *tables[chunk][0].shape) for chunk in local_chunks]])
    widths = {width for (shapes,) in gathered for _, _, width in shapes}
    counts = [(chunk, count) for (shapes,) in gathered for chunk, count, _ in shapes]
    empty = torch.zeros(0, max(widths)), torch.zeros(0, dtype=torch.int64)
    parts = (torch.cat([empty[i], *(tables[chunk][i] for chunk in local_chunks)]) for i in range(2))
    features, levels = (team.all_gather(part).split([count for _, count in counts]) for part in parts)
    order = sorted(range(len(counts)), key=lambda i: counts[i][0])
    return torch.cat([features[i] for i in order]), torch.cat([levels[i] for i in order])


def consensus_distributed(views: ViewObservations, portion: Partition, *, sample: int, **options: float) -> Consensus:
    """Run `consensus` in several processes. Process 0 computes it from the sampled Gaussians of all processes.

    Args:
        sample: Smallest number of Gaussians to sample in a region; see `consensus`.
        options: Arguments `power` and `least` of `consensus`.
    """
    team, (evidence, features, level) = portion.communicator, views
    check_consensus_inputs(evidence.num_regions, features, level)
    sampled, probability = gather_sample(views, portion, sample)
    if team.rank > 0:
        out = features.to(evidence.rows.weight.device, copy=True)
        return Consensus(team.broadcast(out), team.broadcast_object(None), len(probability))
    result = sampled_consensus(sampled, probability, features, level=level, **options)
    return result._replace(features=team.broadcast(result.features), agreement=team.broadcast_object(result.agreement))


def gather_sample(views: ViewObservations, portion: Partition, sample: int) -> tuple[Evidence, Float64[Tensor, " m"]]:
    """Return the evidence and the sampling probabilities of the Gaussians that the processes sample, in index order.

    Args:
        sample: Smallest number of Gaussians to sample in a region; see `consensus`.
    """
    team, evidence = portion.communicator, views.evidence
    chosen, probability = sample_gaussians(evidence.rows, evidence.num_regions, sample, portion)
    sampled = evidence.select_gaussians(chosen)
    order = team.all_gather(portion.indices[chosen]).argsort()
    rows, unlabeled = (all_gather_sparse(team, part).select_rows(order) for part in (sampled.rows, sampled.unlabeled))
    return replace(sampled, rows=rows, unlabeled=unlabeled), team.all_gather(probability)[order]


def vote_distributed(
    means: Float[Tensor, "n 3"],
    lifted: Lifted,
    own: Float[Tensor, " m"],
    options: LiftOptions,
    portion: Partition,
    stages: StageTimer,
    *,
    level: Int64[Tensor, " s"] | None = None,
) -> tuple[Int32[Tensor, " m"], LiftOptions, dict[str, Any]]:
    """Run `vote_directions` in several processes.

    Returns:
        The index of the Gaussian whose direction each Gaussian of this process takes, the options with the resolved
        parameters of the vote, and the manifest entries: the gate if it was measured, and the result of `vote_shares`.
    """
    team, gaussians = portion.communicator, portion.indices
    with stages("neighbors", len(gaussians)):
        progress = partial(stages.report, "neighbors")
        neighbors = nearest_neighbors(means, options.vote.k, of=gaussians, progress=progress, team=team)
    with stages("vote", len(gaussians)):
        halo = gather_halo(lifted, neighbors, portion)
        cosines = None
        if level is not None:
            pairs = sample_pairs(gaussians, halo.neighbors.index, len(means))
            cosines = team.all_gather(shared_region_cosines(halo.lifted, *pairs, level))
        options, facts = pipeline.with_gate(options, cosines)
        config = options.vote
        neighbors, reliability = halo.neighbors, portion.all_gather(lifted.scalars.reliability)[halo.gaussians]
        own = torch.cat([own, own.new_zeros(len(halo.gaussians) - len(own))])
        voters = portion.curve_rows
        voters = voters[labeled_share(lifted.evidence)[voters] >= config.numbers.min_labeled]
        rows = refine_subset(
            voters, neighbors, halo.lifted.directions, reliability, config,
            own=None if config.vote == "paper" else own,
            width=decay_width(team.all_gather(neighbors.spacing), config),
            progress=partial(stages.report, "vote"),
        )  # fmt: skip
        copied = halo.gaussians[rows[: len(gaussians)].long()].int()
        source = rows[: len(gaussians)].long()
        changed = team.all_reduce(pipeline.count_changes(halo.lifted, source, gaussians, len(means)))
        copied = copied if int(changed[0]) > 0 else gaussians.int()
        counts = team.all_reduce(pipeline.count_votes(copied, gaussians, neighbors, reliability))
    return copied, options, facts | pipeline.vote_shares(counts, changed, len(means))


def build_field_distributed(
    lifted: Lifted,
    means: Float[Tensor, "n 3"],
    source: Int[Tensor, " m"] | None,
    portion: Partition,
    *,
    tolerance: float,
    storage: str,
    provenance: Mapping[str, Any],
) -> SemanticField | None:
    """Run `SemanticField.build` in several processes; return the field in process 0, and None in the others.

    Args:
        lifted: Lift of this process's Gaussians.
        means: Centers of all Gaussians.
        source: Index of the Gaussian whose direction each of this process's Gaussians takes, or None without a vote.
        portion: Gaussians of this process.
        tolerance: See `SemanticField.build`.
        storage: See `SemanticField.build`.
        provenance: See `SemanticField.build`; only the argument of process 0 is used.
    """
    facts, basis = choose_form(lifted, storage, tolerance, portion)
    is_evidence = facts["form"] == "evidence"
    store = _gather_evidence(lifted, portion) if is_evidence else _gather_directions(lifted, basis, portion)
    scalars = lifted.scalars.map(portion.all_gather)
    sources = portion.all_gather(portion.indices.int() if source is None else source.int())
    if store is None:
        return None
    return SemanticField.assemble(scalars, sources, store, means, provenance=provenance, facts=facts)


def _gather_evidence(lifted: Lifted, portion: Partition) -> lowrank.StoredEvidence | None:
    """In process 0, return the evidence E of all Gaussians and the features F; return None in all other processes."""
    rows, unlabeled = (gather_sparse(portion, x) for x in (lifted.evidence.rows, lifted.evidence.unlabeled))
    if rows is None or unlabeled is None:
        return None
    return lowrank.StoredEvidence(replace(lifted.evidence, rows=rows, unlabeled=unlabeled), lifted.features.float())


def _gather_directions(lifted: Lifted, basis: Tensor | None, portion: Partition) -> lowrank.StoredDirections | None:
    """In process 0, return the directions of all Gaussians that have one; return None in all other processes."""
    coordinates, rows = lowrank.encode_directions(lifted, basis, portion.blocks())
    parts, gaussians = portion.communicator.gather(coordinates), portion.communicator.gather(portion.indices[rows])
    if parts is None or gaussians is None:
        return None
    return lowrank.arrange_directions(parts, gaussians, basis, len(portion.order))
