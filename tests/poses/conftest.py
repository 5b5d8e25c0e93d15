"""Synthetic bearings of points that two cameras see, and panoramas of textured box rooms with their depth."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch
from numpy import ndarray as Array

from pansplat.geometry.equirect import pixel_directions
from pansplat.poses.dense import Surroundings
from pansplat.poses.depth import DepthMap
from pansplat.poses.solvers import rotation_exp
from pansplat.sweep.panoramas import upright_rotation

_HALF = np.array((2.6, 1.35, 2.1))  # half the size of a room, metres


@dataclass(frozen=True)
class Bearings:
    """Bearings of the same points from two cameras, x2 = R x1 + t; the last ones are outliers."""

    first: Array
    second: Array
    rotation: Array
    translation: Array


Scene = Callable[..., Bearings]


@pytest.fixture(scope="session")
def scene() -> Scene:
    """A function that makes bearings; rotation and translation are random unless they are given."""

    def make(
        seed: int = 0,
        count: int = 200,
        *,
        noise: float = 0.0,
        outliers: float = 0.0,
        planar: bool = False,
        upright: bool = False,
        rotation: Array | None = None,
        translation: Array | None = None,
    ) -> Bearings:
        rng = np.random.default_rng(seed)
        points = rng.normal(size=(count, 3))
        points *= rng.uniform(1.5, 6, (count, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
        if planar:  # a wall 2 m ahead
            points = np.concatenate((rng.uniform(-4, 4, (count, 2)), np.full((count, 1), 2.0)), axis=1)
        if rotation is None:
            rotation = rotation_exp(rng.normal(size=3) * (0, 1, 0) if upright else rng.normal(size=3))
        if translation is None:
            translation = rng.normal(size=3)
            translation /= np.linalg.norm(translation)
        second = points @ rotation.T + translation
        bearings = [_unit(points), _unit(second)]
        bearings = [_unit(b + noise * rng.normal(size=b.shape)) for b in bearings]
        wrong = round(outliers * count)
        if wrong:
            bearings[1][-wrong:] = _unit(rng.normal(size=(wrong, 3)))
        return Bearings(bearings[0], bearings[1], rotation, translation)

    return make


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _make_textures(seed: int) -> Array:
    """Grey textures of the six walls with details of several sizes, (6 512 512) in [0, 255]."""
    rng = np.random.default_rng(seed)
    textures = np.zeros((6, 512, 512), np.float32)
    for size, strength in ((5, 25), (12, 30)):
        for texture in textures:
            noise = rng.normal(size=(size, size)).astype(np.float32)
            texture += strength * cv2.resize(noise, (512, 512), interpolation=cv2.INTER_NEAREST)
    return cv2.GaussianBlur(textures.transpose(1, 2, 0), (0, 0), 0.7).transpose(2, 0, 1) + 128


def _cast(rays: Array, centre: Array) -> tuple[Array, Array]:
    """The distance of a room's walls, and the axis of each that is hit."""
    with np.errstate(divide="ignore"):
        distance = (np.sign(rays) * _HALF - centre) / rays
    return distance.min(axis=-1), distance.argmin(axis=-1)


def _render_room(textures: Array, rotation: Array, centre: Array, height: int = 256) -> Array:
    """The panorama (height 2*height 3) of a camera in the room, 8 bit."""
    rays = pixel_directions(height, 2 * height, dtype=torch.float64).numpy() @ rotation.T
    distance, axis = _cast(rays, centre)
    points = centre + rays * distance[..., None]
    image = np.zeros(rays.shape[:2], np.float32)
    for wall in range(6):
        n, side = divmod(wall, 2)
        own = (axis == n) & ((rays[..., n] > 0) == bool(side))
        u, v = (((points[..., m] / _HALF[m] + 1) * 255.5).astype(np.float32) for m in range(3) if m != n)
        image[own] = cv2.remap(textures[wall], u, v, cv2.INTER_LINEAR)[own]
    return np.repeat(image.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.fixture(scope="session")
def render_room() -> Callable[..., Array]:
    """A function that makes the panorama of a room, by its number, from a rotation and a centre."""
    textures: dict[int, Array] = {}

    def render(room: int, rotation: Array, centre: Array) -> Array:
        if room not in textures:
            textures[room] = _make_textures(room)
        return _render_room(textures[room], rotation, centre)

    return render


@pytest.fixture(scope="session")
def look_around(render_room: Callable[..., Array]) -> Callable[..., Surroundings]:
    """A function that makes the surroundings of a camera in a room, with exact depth; its down is the world's y axis.

    The camera's height over the floor, 1.35 m less the y of its centre, is the unit of the depth.
    """

    def look(room: int, rotation: Array, centre: Array, deviation: float = 0.03) -> Surroundings:
        turn = upright_rotation(rotation, np.array((0.0, 1, 0)))
        turn = np.eye(3) if turn is None else turn
        rays = pixel_directions(192, 384, dtype=torch.float64).numpy() @ (rotation @ turn).T
        distance = _cast(rays, centre)[0]
        log_depth = np.log(distance / (_HALF[1] - centre[1]))
        seen = pixel_directions(256, 512, dtype=torch.float64).numpy() @ rotation.T
        points = centre + seen * _cast(seen, centre)[0][..., None]
        waves = np.random.default_rng(room).normal(size=(2, 3, 3))
        colour = 0.85 + 0.15 * np.sin(2 * points @ waves[0] + 9 * waves[1, 0])
        return Surroundings(
            colour * render_room(room, rotation, centre) / 255, DepthMap(log_depth, np.full((48, 96), deviation), turn)
        )

    return look


@pytest.fixture(scope="session")
def find_walls() -> Callable[[Array, Array], Array]:
    """A function that gives the distances of the walls along rays from a place in a room, metres."""
    return lambda rays, centre: _cast(rays, centre)[0]


@pytest.fixture(scope="module")
def few_samples() -> Iterator[None]:
    """Fewer random samples, and matches of the polish: rooms are easy, and their tests are about whole folders."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pansplat.poses.two_view._TOP_SETS", (80, 2500))
        patch.setattr("pansplat.poses.two_view._MAX_POLISHED", 250)
        yield
