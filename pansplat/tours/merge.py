"""The scene of a whole tour: merged from scenes of its edges or parts, and its graph."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import torch

from pansplat.gaussians.crop import keep_gaussians
from pansplat.gaussians.scene import Gains, Gaussians, Scene, SceneTour, Starts
from pansplat.geometry.level import wrap_angle
from pansplat.inputs.panorama_sets import Link, Panorama
from pansplat.inputs.placements import PLACED, ApproximatePlace, Placement
from pansplat.tours.edges import find_walls
from pansplat.tours.graph import TourGraph, ViewNumbers
from pansplat.tours.scene_views import MAX_SCENE_VIEWS, choose_sources
from pansplat.tours.surfaces import find_surfaces

_GRAPHS: WeakKeyDictionary[Scene, TourGraph] = WeakKeyDictionary()  # `render` needs that of a scene for each picture


def merge_scenes(tour: TourGraph, load: Callable[[ViewNumbers], Scene], max_views: int = MAX_SCENE_VIEWS) -> Scene:
    """One scene of all panoramas. The Gaussians of each panorama are those of one scene (`choose_sources`).

    Args:
        tour: the graph.
        load: returns the scene of some panoramas (`make_set`); called once for each scene that is needed.
        max_views: of the predictor (`choose_sources`).
    """
    parts: dict[int, Gaussians] = {}
    gains: dict[ViewNumbers, Gains] = {}
    scene = None
    for views, provided in choose_sources(tour, max_views).items():
        scene = tour.place(load(views), views)
        gains[views] = scene.gains
        for node in provided:
            part = scene.gaussians.select(scene.gaussians.views == views.index(node))
            parts[node] = dataclasses.replace(part, views=torch.full_like(part.views, node, dtype=torch.int64))
    assert scene is not None
    merged = dataclasses.replace(
        scene,
        gaussians=Gaussians.cat([parts[node] for node in range(len(tour))]),
        cam2world=tour.cam2world,
        near=tour.near,
        far=tour.far,
        names=tuple(panorama.label for panorama in tour.panoramas),
        gains=_join_gains(gains, tour.parts),
        starts=list_starts(tour.panoramas),
    )
    edges = find_walls(dict(enumerate(find_surfaces(merged, tour.level_axes))), tour.overlaps)
    return dataclasses.replace(merged, tour=describe_tour(tour.with_walls(edges)))


def describe_tour(tour: TourGraph) -> SceneTour:
    """What a scene of all panoramas keeps of a tour."""
    overlaps = *tour.overlaps.items(), *((wall, 0.0) for wall in tour.walls)
    approximate = []
    for node, (beside, about) in tour.approximate.items():
        view = tour.panoramas[beside]
        scale = view.camera_height * view.frame.unit if about.is_in_heights else 1.0
        approximate.append((node, beside, scale * about.right, scale * about.forward, wrap_angle(about.yaw)))
    return SceneTour(
        tuple((a, b, overlap) for (a, b), overlap in overlaps),
        tuple((a, b, wrap_angle(link.yaw), wrap_angle(link.pitch), link.text) for (a, b), link in tour.links.items()),
        tuple(approximate),
    )


def list_starts(panoramas: Sequence[Panorama]) -> Starts:
    """The start views of panoramas, as a scene keeps them; nothing if there is none."""
    starts = tuple(view.start and (wrap_angle(view.start[0]), wrap_angle(view.start[1])) for view in panoramas)
    return starts if any(starts) else ()


def _join_gains(gains: dict[ViewNumbers, Gains], parts: Sequence[int]) -> Gains:
    """Gains of all panoramas from those of scenes, each of which are relative to the mean of the scene's photographs.

    Panoramas that scenes have in common give the ratios of these means, by least squares. Scenes without gains count
    with none; without any gains there are none. Those of a part are relative to the mean of the part.

    Args:
        gains: of each scene's views.
        parts: of the panoramas.
    """
    count = len(parts)
    known = [
        (node, scene, row)
        for scene, (views, rows) in enumerate(gains.items())
        if rows
        for node, row in zip(views, rows, strict=True)
    ]
    if not known:
        return ()
    system = np.zeros((len(known), count + len(gains)))
    for equation, (node, scene, _) in zip(system, known, strict=True):
        equation[node], equation[count + scene] = 1, -1
    logs = np.linalg.lstsq(system, np.log([row for *_, row in known]), rcond=None)[0][:count]
    for part in set(parts):
        members = np.array(parts) == part
        logs[members] -= logs[members].mean(axis=0)
    return tuple(map(tuple, np.exp(logs).tolist()))


def select_views(scene: Scene, views: ViewNumbers) -> Scene:
    """The scene of some panoramas of a scene that `merge_scenes` made."""
    is_shown = torch.isin(scene.gaussians.views, torch.tensor(views).to(scene.gaussians.views))
    return dataclasses.replace(keep_gaussians(scene, is_shown, views), starts=(), tour=None)


def make_graph(scene: Scene) -> TourGraph:
    """The graph of a scene's cameras, with the edges and links that `merge_scenes` has kept in the scene."""
    if scene not in _GRAPHS:
        _GRAPHS[scene] = _make_graph(scene, scene.tour or SceneTour(()))
    return _GRAPHS[scene]


def _make_graph(scene: Scene, tour: SceneTour) -> TourGraph:
    count = len(scene.cam2world)
    titles = [scene.names[k] if k < len(scene.names) else f"panorama {k + 1}" for k in range(count)]
    names = [f"{title} ({k + 1})" for k, title in enumerate(titles)]  # no two are equal, whatever the titles are
    links: list[list[Link]] = [[] for _ in range(count)]
    for start, end, yaw, pitch, text in tour.links:
        links[start].append(Link(names[end], yaw, pitch, text))
    placements = {
        view: Placement("not placed", about=ApproximatePlace(Path(names[beside]), right, forward, yaw))
        for view, beside, right, forward, yaw in tour.approximate
    }
    panoramas = tuple(
        Panorama(
            names[k],
            Path(names[k]),
            pose,
            title=titles[k],
            links=tuple(links[k]),
            start=scene.starts[k] if scene.starts else None,
            placement=placements.get(k, PLACED),
            frame=scene.frame,
        )
        for k, pose in enumerate(scene.cam2world.double())
    )
    walls = [(a, b) for a, b, overlap in tour.overlaps if a != b and overlap == 0]
    overlaps = {(a, b): overlap for a, b, overlap in tour.overlaps}
    graph = TourGraph("", Path(), panoramas, scene.near, scene.far, overlaps=overlaps)
    return graph.with_walls(walls) if walls else graph
