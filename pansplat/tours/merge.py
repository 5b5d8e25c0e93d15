"""The scene of a whole tour, merged from scenes of its edges or parts, and scenes of some of its panoramas."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import torch

from pansplat.gaussians.crop import keep_gaussians
from pansplat.gaussians.scene import Gains, Gaussians, Scene
from pansplat.tours.edges import find_walls
from pansplat.tours.graph import TourGraph, ViewNumbers
from pansplat.tours.scene_graph import describe_tour, list_starts
from pansplat.tours.scene_views import MAX_SCENE_VIEWS, choose_sources
from pansplat.tours.surfaces import find_surfaces


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


def _join_gains(gains: dict[ViewNumbers, Gains], parts: Sequence[int]) -> Gains:
    """Gains of all panoramas from those of scenes, each of which are relative to the mean of the scene's photographs.

    Panoramas that scenes have in common give the ratios of these means, by least squares. Scenes without gains are
    ignored; if none has any, the result is empty. Those of a part are relative to the mean of the part.

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
