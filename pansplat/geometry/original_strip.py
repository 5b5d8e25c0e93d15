"""Six cube faces of a panorama, and back, in the original's own order of operations, so that every bit is its own.

`pansplat.geometry.cubemap` computes the same numbers from positions in float64. The original finds them with numpy
in float32, as here: torch's sines and tangents differ in the last bit.

Source: OFFICIAL.md, sections 2.4 and 5; Jiang et al., UniFuse, https://arxiv.org/abs/2102.03550.
"""

import functools

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from pansplat.geometry.cubemap import official_faces


def original_strip(image: Float[Tensor, "channel height width"], face_size: int) -> Float[Tensor, "channel n strip"]:
    """What `cube_strip.strip_from_equirect` gives: the faces front right back left up down, side by side."""
    height, width = image.shape[-2:]
    column, row = (position.to(image.device) for position in _strip_positions(face_size, height, width))
    left, top = column.floor().long(), row.floor().long().clamp(0, height - 2)
    x, y = column - left, row - top
    # Weighed in float64 as they stand: by way of normalised coordinates, ties between two floats would break.
    above, below = (
        image[:, rows, left % width].double() * (1 - x) + image[:, rows, (left + 1) % width].double() * x
        for rows in (top, top + 1)
    )
    return (above * (1 - y) + below * y).to(image.dtype)


@functools.cache
def _strip_positions(face_size: int, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Column and row in the panorama of each pixel of the strip, 0 at the first pixel's centre: float64 of float32."""
    across = np.linspace(-0.5, 0.5, num=face_size, dtype=np.float32)
    a, e = np.meshgrid(across, -across)
    half = np.full_like(a, 0.5)
    faces = ((a, e, half), (half, e, -a), (-a, e, -half), (-half, e, a), (a, half, -e), (a, -half, e))
    x, up, z = (np.concatenate(axis, axis=1) for axis in zip(*faces, strict=True))
    longitude, latitude = np.arctan2(x, z), np.arctan2(up, np.sqrt(x**2 + z**2))
    column = (longitude / (2 * np.pi) + 0.5) * width - 0.5
    row = (-latitude / np.pi + 0.5) * height - 0.5
    return torch.from_numpy(column.astype(np.float64)), torch.from_numpy(row.astype(np.float64))


@functools.cache
def original_lookup(height: int) -> Float[Tensor, "height width 3"]:
    """For each pixel of a panorama, where to look in a stack of six faces: x, y and face, each in [-1, 1]; float32."""
    width, face = 2 * height, official_faces(height).numpy()
    longitude = ((np.linspace(0, width - 1, num=width, dtype=np.float32) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = -((np.linspace(0, height - 1, num=height, dtype=np.float32) + 0.5) / height - 0.5) * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    x, y = np.zeros_like(longitude), np.zeros_like(longitude)
    for number in range(4):
        own = face == number
        turn = longitude[own] - np.pi * number / 2
        x[own], y[own] = 0.5 * np.tan(turn), -0.5 * np.tan(latitude[own]) / np.cos(turn)
    for number, sign in ((4, 1.0), (5, -1.0)):
        own = face == number
        across = 0.5 * np.tan(np.pi / 2 - np.abs(latitude[own]))
        x[own], y[own] = across * np.sin(longitude[own]), sign * across * np.cos(longitude[own])
    stack = (np.clip(x, -0.5, 0.5) * 2, np.clip(y, -0.5, 0.5) * 2, face.astype(np.float32) / 2.5 - 1)
    return torch.from_numpy(np.stack(stack, axis=-1).astype(np.float32))


def original_panorama(
    faces: Float[Tensor, "batch 6 channel n n"], lookup: Float[Tensor, "height width 3"]
) -> Float[Tensor, "batch channel height width"]:
    """What `cube_strip.equirect_from_strip` gives, sampled in a stack of faces: a trace of other faces mixes in."""
    stack = faces.transpose(1, 2).contiguous()
    grid = lookup.to(stack).expand(len(stack), 1, *lookup.shape)
    return functional.grid_sample(stack, grid, mode="bilinear", padding_mode="border", align_corners=True)[:, :, 0]
