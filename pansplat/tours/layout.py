"""Parts of a tour in one world: level, side by side, so far apart that the nearest edge is in the camera's part."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch

from pansplat.data.pairs import Panorama
from pansplat.geometry.path import level_pose, up_direction
from pansplat.geometry.world import working_factor

REACH = 2.0  # metres, in which a camera moves around the panoramas of its part
_GAP = 4.0  # metres, between what the cameras of two parts reach


def lay_out(panoramas: Sequence[Panorama], near: float) -> tuple[Panorama, ...]:
    """The panoramas with poses in one world.

    The largest part stays where it is. The others are turned, so that their first panoramas look in the direction of
    its first one, level, and stand in rows on its right and behind it, with their cameras at its height.

    Args:
        panoramas: of one or more parts (`Panorama.part`).
        near: smallest depth; states the unit of the world.
    """
    members: dict[int, list[int]] = {}
    for node, panorama in enumerate(panoramas):
        members.setdefault(panorama.part, []).append(node)
    order = sorted(members.values(), key=lambda nodes: -len(nodes))
    largest = order[0]
    others = [nodes for nodes in members.values() if nodes is not largest]  # in file order
    poses = {id(nodes): torch.stack([panoramas[node].cam2world for node in nodes]).double() for nodes in order}
    axes = {key: level_pose(group[0], up_direction(group))[:3, :3] for key, group in poses.items()}
    world, unit = axes[id(largest)], 1 / working_factor(near)
    margin = (REACH + _GAP / 2) * unit
    places = {key: (group[:, :3, 3] @ axes[key]).numpy() for key, group in poses.items()}  # right, down, forward
    sizes = {key: np.ptp(place, axis=0)[[0, 2]] + 2 * margin for key, place in places.items()}
    row = max(math.sqrt(sum(float(np.prod(size)) for size in sizes.values())), *(size[0] for size in sizes.values()))
    height = places[id(largest)][:, 1].mean()
    laid_out, corner, depth, origin = list(panoramas), np.zeros(2), 0.0, np.zeros(2)
    for nodes in (largest, *others):
        key = id(nodes)
        if corner[0] > 0 and corner[0] + sizes[key][0] > 1.001 * row:
            corner, depth = np.array((0.0, corner[1] + depth)), 0.0
        low, high = places[key].min(axis=0), places[key].max(axis=0)
        # The left end and the end in front; rows follow each other backwards.
        shift = np.array((corner[0] - low[0], height - places[key][:, 1].mean(), -corner[1] - high[2]))
        if nodes is largest:
            origin = shift
        corner[0] += sizes[key][0]
        depth = max(depth, sizes[key][1])
        turn, move = world @ axes[key].T, world @ torch.from_numpy(shift - origin)
        if nodes is largest:
            continue
        for node in nodes:
            pose = panoramas[node].cam2world.double().clone()
            pose[:3] = turn @ pose[:3]
            pose[:3, 3] += move
            laid_out[node] = dataclasses.replace(panoramas[node], cam2world=pose)
    return tuple(laid_out)
