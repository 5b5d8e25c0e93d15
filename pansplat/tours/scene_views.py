"""Chooses the panoramas of the scene of an edge, of the whole scene, and of each prediction."""

from __future__ import annotations

import dataclasses
import itertools
import math
from functools import lru_cache

import numpy as np

from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.tours.graph import Edge, TourGraph, ViewNumbers, add_self_edges
from pansplat.tours.walks import plan_walk

MAX_SCENE_VIEWS = 3  # panoramas of the scene of an edge
_MAX_PREDICTED = 16  # panoramas that a window predicts at once; bounds its memory and the time until they are shown
_MIN_BASELINE = 0.03  # least distance of two views, as a fraction of far; nearer ones have no accurate depth


@lru_cache(maxsize=8)
def choose_scene_views(tour: TourGraph) -> dict[Edge, ViewNumbers]:
    """The panoramas of the scene of each edge: two, or three that overlap with each other; one of a self-edge.

    Edges share scenes where they can, so that fewer scenes are predicted and exchanged.
    """
    around = {node: set(tour.neighbours(node)) for node in range(len(tour))}
    triangles = [(a, b, c) for a, b in tour.overlaps for c in sorted(around[a] & around[b]) if c > b]
    triangles.sort(key=lambda nodes: (-_weakest_overlap(tour, nodes), nodes))
    scenes: dict[Edge, ViewNumbers] = {}
    for needed in (2, 1):
        for nodes in triangles:
            free = [edge for edge in itertools.combinations(nodes, 2) if edge not in scenes]
            if len(free) >= needed:
                scenes |= {edge: nodes for edge in free}
    for edge in tour.overlaps:
        if edge not in scenes:
            scenes[edge] = _add_baseline(tour, edge)
    return scenes


def choose_sources(tour: TourGraph, max_views: int = MAX_SCENE_VIEWS) -> dict[ViewNumbers, tuple[int, ...]]:
    """The scenes that one scene of all panoramas is made of, and the panoramas whose Gaussians each provides.

    They are the parts, if the predictor takes as many views. Else they are scenes of `choose_scene_views`, those of
    the largest overlaps first, until all panoramas are provided.

    Args:
        max_views: of the predictor.
    """
    parts = tour.list_parts()
    if max_views > MAX_SCENE_VIEWS and max(map(len, parts)) <= max_views:
        return {part: part for part in parts}
    scenes = sorted(set(choose_scene_views(tour).values()), key=lambda nodes: (-_weakest_overlap(tour, nodes), nodes))
    sources: dict[ViewNumbers, tuple[int, ...]] = {}
    missing = set(range(len(tour)))
    for views in scenes:
        if provided := tuple(node for node in views if node in missing):
            sources[views] = provided
            missing -= set(provided)
    return sources


def choose_predictions(tour: TourGraph, max_views: int) -> dict[int, ViewNumbers]:
    """The panoramas that each panorama is predicted with, so that scenes of edges are parts of few predictions.

    They are its part. A part of more than 16 panoramas is cut into pieces of its walk; the best neighbour of each
    panorama of a piece is predicted with it. There are none for a predictor of scenes of edges.

    Args:
        max_views: of the predictor.
    """
    if max_views <= MAX_SCENE_VIEWS:
        return {}
    predictions: dict[int, ViewNumbers] = {}
    walk = dict.fromkeys(plan_walk(tour))
    for part in range(max(tour.parts) + 1):
        nodes = [node for node in walk if tour.parts[node] == part]
        for piece in np.array_split(nodes, math.ceil(len(nodes) / min(max_views, _MAX_PREDICTED))):
            members = piece.tolist()
            neighbours = {end for node in members for end in tour.find_edge(node)}
            predictions |= dict.fromkeys(members, tuple(sorted({*members, *neighbours})))
    return predictions


def leave_out(tour: TourGraph, node: int) -> PanoramaSet:
    """A pair whose target is a panorama, and whose context is what the tour without it would show at its position.

    That is the scene of the nearest edge of its world.
    """
    overlaps = {edge: overlap for edge, overlap in tour.overlaps.items() if node not in edge}
    overlaps = add_self_edges(overlaps, {*range(len(tour))} - {node})
    others = dataclasses.replace(tour, overlaps=overlaps)
    near = [edge for edge in overlaps if tour.worlds[edge[0]] == tour.worlds[node]]
    edge = near[int(tour.measure_distances(near, tour.positions[node]).argmin())]
    pair = tour.make_set(choose_scene_views(others)[edge])
    target = (tour.originals or tour.panoramas)[node]
    return dataclasses.replace(pair, name=target.name, targets=(target,))


def _weakest_overlap(tour: TourGraph, nodes: ViewNumbers) -> float:
    """The smallest overlap of the edges between the panoramas of a scene."""
    edges = itertools.combinations_with_replacement(nodes, 2)
    return min(tour.overlaps[edge] for edge in edges if edge in tour.overlaps)


def _add_baseline(tour: TourGraph, edge: Edge) -> ViewNumbers:
    """The edge's panoramas, with the best neighbour of either if they are too close together for depth."""
    if edge[0] == edge[1]:
        return edge[:1]
    if tour.length(edge) >= _MIN_BASELINE * tour.far:
        return edge
    others = [
        (tour.overlaps[around], node)
        for around in tour.overlaps
        for node in around
        if around != edge and set(around) & set(edge) and node not in edge
    ]
    return tuple(sorted((*edge, max(others)[1]))) if others else edge
