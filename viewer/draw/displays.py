"""Colours of Gaussians that show a property in place of their own colour."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int

from pansplat.geometry.pose import rotations_from_quats
from pansplat_viewer.draw import color_maps

_LABELS = np.array(color_maps.SIZE * (np.arange(10) + 0.5) / 10, np.int64)  # of the table of `tab10`


def color_by_property(
    display: str,
    means: Float[np.ndarray, "n 3"],
    quats: Float[np.ndarray, "n 4"],
    scales: Float[np.ndarray, "n 3"],
    levels: Int[np.ndarray, "n"],
    views: Int[np.ndarray, "n"],
    view_positions: Float[np.ndarray, "view 3"],
) -> Float[np.ndarray, "n 3"]:
    """The colours of a display, RGB in [0, 1]: `normals`, `levels` or `views`.

    A normal points to the camera of the Gaussian's view. Without this camera it points to the origin of `means`.

    Args:
        display: the property.
        means, quats, scales: of the Gaussians; the axes of the means are those of the normals.
        levels, views: labels.
        view_positions: camera centres, in the axes of the means.
    """
    if display in ("levels", "views"):
        table = color_maps.get_table("tab10")[_LABELS].astype(np.float32) / 255
        return table[(levels if display == "levels" else views) % 10]
    colors = np.empty((len(means), 3), np.float32)
    cameras = np.concatenate((view_positions, np.zeros((1, 3)))).astype(np.float32)
    nearest = np.where((views >= 0) & (views < len(view_positions)), views, -1)
    for start in range(0, len(means), 1 << 18):  # limits the memory of the rotations
        part = slice(start, start + (1 << 18))
        rotations = rotations_from_quats(torch.from_numpy(np.array(quats[part]))).numpy()
        shortest = np.asarray(scales[part]).argmin(axis=1)
        normals = np.take_along_axis(rotations, shortest[:, None, None], axis=2)[..., 0]
        towards = ((cameras[nearest[part]] - means[part]) * normals).sum(axis=1, keepdims=True)
        colors[part] = 0.5 + 0.5 * np.where(towards < 0, -normals, normals)
    return colors
