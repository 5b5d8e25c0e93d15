"""What a scene keeps of a tour, and the graph of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from weakref import WeakKeyDictionary

from pansplat.gaussians.scene import Scene, SceneTour, Starts
from pansplat.geometry.level import wrap_angle
from pansplat.inputs.panorama_sets import Link, Panorama
from pansplat.inputs.placements import PLACED, ApproximatePlace, Placement
from pansplat.tours.graph import TourGraph

_GRAPHS: WeakKeyDictionary[Scene, TourGraph] = WeakKeyDictionary()  # `render` needs that of a scene for each picture


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
