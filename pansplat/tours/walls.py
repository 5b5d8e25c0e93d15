"""Walls and closed doors between the panoramas of a tour, through which no camera flies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch
from torch.nn import functional

from pansplat.gaussians.scene import Scene
from pansplat.geometry.equirect import pad_equirect, uv_from_directions
from pansplat.rendering import rasterize

_HEIGHT = 128  # rows of the depth of a panorama
_WINDOW = 2  # pixels around the direction of the other camera, 3 degrees
_DEPTH = 0.95  # of the distance of the other camera, the largest depth of a wall


@torch.no_grad()
def find_walls(scene: Scene, panoramas: Sequence[int], edges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """The edges that lead through a surface: each camera sees one in front of the other camera.

    Args:
        scene: of some panoramas, with all Gaussians of each.
        panoramas: the number in the tour of each of the scene's views.
        edges: pairs of panoramas; those with another panorama are left out.
    """
    view = {panorama: number for number, panorama in enumerate(panoramas)}
    inside = [(a, b) for a, b in edges if a != b and a in view and b in view]
    reaches = {}
    for node in {node for edge in inside for node in edge}:
        own = scene.gaussians.select(scene.gaussians.views == view[node])
        drawn = rasterize(own, scene.cam2world[view[node]], size=(_HEIGHT, 2 * _HEIGHT))
        depth = pad_equirect(torch.where(drawn.alpha > 0, drawn.depth, math.inf), _WINDOW)
        reaches[node] = functional.max_pool2d(depth[None], 2 * _WINDOW + 1, stride=1)[0]

    def is_blocked(node: int, other: int) -> bool:
        pose, target = scene.cam2world[view[node]].double(), scene.cam2world[view[other], :3, 3].double()
        offset = (target - pose[:3, 3]) @ pose[:3, :3]
        u, v = uv_from_directions(offset).tolist()
        row, column = min(int(v * _HEIGHT), _HEIGHT - 1), int(u * 2 * _HEIGHT) % (2 * _HEIGHT)
        return float(reaches[node][row, column]) < _DEPTH * float(offset.norm())

    return [(a, b) for a, b in inside if is_blocked(a, b) and is_blocked(b, a)]
