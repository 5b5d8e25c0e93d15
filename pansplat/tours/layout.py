"""Puts the worlds of a tour side by side in one, far enough apart that the nearest edge is of the camera's world."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch

from pansplat.geometry.level import level_pose, up_direction
from pansplat.inputs.panorama_sets import Panorama

REACH = 2.0  # metres in which a camera moves around the panoramas of its part
_GAP = 8.0  # metres between what the cameras of two worlds reach, so that few rooms meet in the floor plan
_ASPECT = 1.5  # width of all rows, relative to the square root of their area


def lay_out(panoramas: Sequence[Panorama]) -> tuple[Panorama, ...]:
    """The panoramas with poses in one world.

    The largest world stays where it is, and its frame is that of all. The others are turned, so that their first
    panoramas look in the direction of its first one, level, and stand in rows on its right and behind it, with their
    cameras at its height.

    Args:
        panoramas: of one or more worlds (`Panorama.world`).
    """
    members: dict[int, list[int]] = {}
    for node, panorama in enumerate(panoramas):
        members.setdefault(panorama.world, []).append(node)
    order = [*dict.fromkeys((max(members, key=lambda world: len(members[world])), *members))]
    poses = [torch.stack([panoramas[node].cam2world for node in members[world]]).double() for world in order]
    levels = [level_pose(group[0], up_direction(group))[:3, :3] for group in poses]
    places = [(group[:, :3, 3] @ level).numpy() for group, level in zip(poses, levels, strict=True)]
    sizes = np.array([np.ptp(place, axis=0)[[0, 2]] + 2 * REACH + _GAP for place in places])  # right, forward
    corners = arrange_in_rows(sizes)
    laid_out, axes, frame = list(panoramas), levels[0], panoramas[members[order[0]][0]].frame
    # Of each world the left front corner, and the mean height, move to those of the first one and its place in the row.
    ends = np.array([(place[:, 0].min(), place[:, 1].mean(), place[:, 2].max()) for place in places])
    for world, group, level, end, corner in zip(order, poses, levels, ends, corners, strict=True):
        if world == order[0]:
            continue
        motion = torch.eye(4, dtype=torch.float64)
        motion[:3, :3] = axes @ level.T
        motion[:3, 3] = axes @ torch.from_numpy(ends[0] - end + (corner[0], 0, -corner[1]))
        for node, pose in zip(members[world], motion @ group, strict=True):
            laid_out[node] = dataclasses.replace(panoramas[node], cam2world=pose, frame=frame)
    return tuple(laid_out)


def arrange_in_rows(sizes: np.ndarray) -> list[tuple[float, float]]:
    """Corners (right, backward) of boxes of these sizes in rows; the first one is at the origin."""
    width = max(_ASPECT * math.sqrt(float(sizes.prod(axis=1).sum())), float(sizes[:, 0].max()))
    corners, right, back, depth = [], 0.0, 0.0, 0.0
    for across, along in sizes.tolist():
        if right > 0 and right + across > width:
            right, back, depth = 0.0, back + depth, 0.0
        corners.append((right, back))
        right, depth = right + across, max(depth, along)
    return corners
