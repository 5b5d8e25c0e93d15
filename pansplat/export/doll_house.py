"""The doll's house of a page: floors and walls of the rooms as triangles, with the photographs projected on them.

All is flat: a floor is the outline of a room, a wall is a side of it up to the ceiling, with gaps where doors lead to
other rooms. Each place has the colour that the nearest camera sees there, and places that none sees have the colours
around them.

Places are in level axes (right, down, forward), in the unit of the scene.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import shapely
import torch
from jaxtyping import Float, Int
from PIL import Image
from shapely.geometry import LineString, Polygon, box
from torch import Tensor

from pansplat import pipeline
from pansplat.export.page_data import PageHouse
from pansplat.export.photographs import read_photograph
from pansplat.gaussians.scene import Scene
from pansplat.geometry.equirect import sample_equirect, uv_from_directions
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.refinement.fusion import BACKGROUND_LEVEL, are_seen, measure_reach
from pansplat.tours.houses import Houses

# Lengths are fractions of the height of the cameras over the floor, about 1.5 m.
_TOP, _DOOR = 0.94, 0.6  # heights of walls and doors over the cameras, as shares of the ceiling's height there
_PARALLEL = 0.9  # least cosine between a door and its wall
_BEHIND = 0.4  # farthest room behind a door, and distance of the two sides of a wall
_THICK = 0.07  # thickness of the walls, seen from above
_STEP = 0.06  # between two places where cameras are compared
_SOFT, _WIDE = 1.0, 4.0  # widths in such steps: of the border of two cameras; over which hidden places are averaged
_TRIPOD = 0.42  # radius of the floor around a camera, which its photograph does not show
_EDGE, _EDGE_SOFT = 0.05, 0.03  # shares of the width and the height of a wall whose colours go on beside it
_GRAZING, _ASIDE = 0.02, 0.05  # least cosine between a ray and the normal of a surface; from a wall to where it is seen
_THROUGH, _OPEN = 1.3, 0.6  # an open wall: the camera sees to this factor of its distance, at this share of its places
_HIDDEN = 4.0  # factor of the distance of a camera whose surfaces are in front
_ATLAS, _MARGIN = 2048, 4  # side of the atlas, and space around each texture, texels
_FINEST = 150.0  # texels along a camera's height
_REACH_ROWS, _PHOTO_ROWS = 256, 1024  # rows of the images of surfaces, and of the photographs
_QUALITY, _KEPT = 80, 16  # quality of WebP; number of photographs in memory

Gap = tuple[int, Polygon, Float[np.ndarray, "2"], float]
"""A room with a gap to another one, the ground between them, the direction of the wall, and the upper edge."""


@dataclass(frozen=True, eq=False)
class Panel:
    """A flat part of the house.

    Attributes:
        corner: upper left, as its room shows it; a floor is seen from above.
        right, down: unit vectors.
        shape: in lengths along these.
        house, room: their numbers.
        facing: of the top of a wall, which has no texture: normal of the wall, to the right and forward.
    """

    corner: Float[np.ndarray, "3"]
    right: Float[np.ndarray, "3"]
    down: Float[np.ndarray, "3"]
    shape: shapely.Geometry
    house: int
    room: int
    facing: Float[np.ndarray, "2"] | None = None

    def locate(self, places: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Places in space of places in the plane."""
        return self.corner + places[..., :1] * self.right + places[..., 1:] * self.down


@dataclass(frozen=True, eq=False)
class DollHouse:
    """The houses as triangles, and their texture: WebP, empty without houses."""

    houses: tuple[PageHouse, ...]
    atlas: bytes


def build_panels(houses: Houses, is_open: Callable[[int, np.ndarray, float], bool]) -> list[Panel]:
    """The floors, the walls and their tops of all houses.

    Args:
        houses: all houses.
        is_open: whether the cameras of a room see through a wall of it that is on the floor at a height (downwards).
    """
    panels: list[Panel] = []
    down = houses.eyes[:, 1]
    for house, views in enumerate(houses.views):
        shapes = {number: room.shape for number, room in enumerate(houses.plan.rooms) if room.panoramas[0] in views}
        chosen = list(views)
        unit, ceiling = float(np.median(houses.floors[chosen])), float(np.median(houses.ceilings[chosen]))
        eye, floor = float(np.median(down[chosen])), float(np.median((down + houses.floors)[chosen]))
        top, every = eye - _TOP * ceiling, shapely.union_all(list(shapes.values()))
        doors = [(door.rooms[0], door.ends, eye - _DOOR * ceiling) for door in houses.plan.doors]
        walls = [(room, np.array(wall)) for room, shape in shapes.items() for wall in pairwise(shape.exterior.coords)]
        doors += [(room, wall, top) for room, wall in walls if is_open(room, wall, floor)]
        gaps: list[Gap] = []
        for room, (start, end), height in doors:
            step = (end - start) / np.linalg.norm(end - start)
            ground = LineString((start, end)).buffer(_BEHIND * unit, cap_style="flat")
            if room in shapes and any(ground.intersects(shapes[other]) for other in shapes if other != room):
                gaps.append((room, ground, step, height))
        closed = every.buffer(_BEHIND / 2 * unit, join_style="mitre").buffer(-_BEHIND / 2 * unit, join_style="mitre")
        for room, shape in shapes.items():
            sills = [
                (ground.intersection(closed).difference(every), h) for owner, ground, _, h in gaps if owner == room
            ]
            shape_with_sills = shapely.union_all([shape, *(sill for sill, _ in sills)]).buffer(0)
            for sill, height in sills:
                panels += _raise_jambs(sill, every, (height, floor, _THICK * unit), house, room)
            every = every.union(shape_with_sills)
            panels.append(_lay_floor(shape_with_sills, floor, house, room))
            panels += _raise_walls(shape, gaps, (top, floor, _THICK * unit), house, room)
    return panels


def _lay_floor(shape: shapely.Geometry, height: float, house: int, room: int) -> Panel:
    """A horizontal panel that is seen from above, along the longest side of a shape in the plan."""
    corners = np.concatenate([np.array(piece.exterior.coords) for piece in shapely.get_parts(shape)])
    sides = np.diff(corners, axis=0)
    along = sides[np.linalg.norm(sides, axis=1).argmax()]
    along = along / np.linalg.norm(along)
    axes = np.stack((along, (along[1], -along[0])), axis=1)  # to the right, and down in the picture
    low = (corners @ axes).min(axis=0)
    flat = shapely.transform(shape, lambda places: places @ axes - low)
    right, down, origin = (np.array((x, 0.0, z)) for x, z in (*axes.T, axes @ low))
    return Panel(origin + height * np.array((0, 1, 0)), right, down, flat, house, room)


def _raise_jambs(
    sill: shapely.Geometry, rooms: shapely.Geometry, sizes: tuple[float, float, float], house: int, room: int
) -> Iterator[Panel]:
    """The sides of a passage, which no room has. Sizes: heights of their tops and the floor (downwards), thickness."""
    top, floor, thickness = sizes
    for piece in shapely.get_parts(shapely.orient_polygons(sill)):
        for start, end in pairwise(np.array(piece.exterior.coords) if isinstance(piece, Polygon) else ()):
            if rooms.distance(shapely.Point((start + end) / 2)) > 0.3 * thickness:
                yield _stand(start, end, top, box(0, 0, np.linalg.norm(end - start), floor - top), house, room)


def _stand(start: np.ndarray, end: np.ndarray, top: float, shape: shapely.Geometry, house: int, room: int) -> Panel:
    """An upright panel between two places of the plan; the room is on the left of the way between them."""
    right, forward = (start - end) / np.linalg.norm(end - start)
    axes = np.array(((right, 0, forward), (0, 1, 0)))
    return Panel(np.array((end[0], top, end[1])), *axes, shape, house, room)


def _raise_walls(
    shape: Polygon, gaps: Sequence[Gap], sizes: tuple[float, float, float], house: int, room: int
) -> Iterator[Panel]:
    """The walls of a room without gaps, and their tops. Sizes: heights of tops and floor (downwards), thickness."""
    top, floor, thickness = sizes
    walls = list(pairwise(np.array(shape.exterior.coords)))
    steps = np.array([(end - start) / np.linalg.norm(end - start) for start, end in walls])
    normals = np.stack((-steps[:, 1], steps[:, 0]), axis=1)  # into the room
    before = np.roll(normals, 1, axis=0)
    away = -thickness * (normals + before) / np.maximum(1 + (normals * before).sum(axis=1), 0.3)[:, None]
    ends = away, np.roll(away, -1, axis=0)
    for (start, end), step, normal, first, last in zip(walls, steps, normals, *ends, strict=True):
        wall: shapely.Geometry = box(0, 0, np.linalg.norm(end - start), floor - top)
        cover: shapely.Geometry = Polygon([start, end, end + last, start + first])
        for _, ground, along, height in gaps:
            cut = ground.intersection(LineString((start, end)))
            if abs(step @ along) > _PARALLEL and cut.length > 0:
                left, right = np.sort((end - np.array(cut.coords)) @ step)
                wall = wall.difference(box(left, height - top, right, floor - top + 1))
                cover = cover.difference(ground) if height == top else cover
        if wall.area > thickness * (floor - top):
            yield _stand(start, end, top, wall, house, room)
            if cover.area > 0:
                yield dataclasses.replace(_lay_floor(cover.buffer(0), top, house, room), facing=normal)


@torch.no_grad()
def make_house(
    scene: Scene, houses: Houses, origin: Float[np.ndarray, "3"], photographs: Sequence[PanoramaSet] = ()
) -> DollHouse:
    """The doll's houses of a scene.

    Args:
        scene: with input cameras.
        houses: of the scene.
        origin: of the page, in the scene's world.
        photographs: of each view; without them the images of the Gaussians.
    """
    if not houses.views:
        return DollHouse((), b"")
    painter = _Painter(scene, houses, photographs)
    panels = build_panels(houses, painter.is_open)
    density, places = _pack(panels, _FINEST / float(np.median(houses.floors)))
    atlas = np.zeros((_ATLAS, _ATLAS, 3), np.uint8)
    shown = {host: list[np.ndarray]() for host in sorted(set(houses.hosts))}
    textures = []
    for panel, place in zip(panels, places, strict=True):
        flat = _triangulate(panel.shape)
        if panel.facing is None:
            textures.append((panel, place, *painter.paint(panel, density)))
            uv = (place + _MARGIN + density * flat) / _ATLAS
        else:
            along = houses.show(panel.house, np.array(((0.0, 0.0, 0.0), np.insert(panel.facing, 1, 0.0))))
            uv = np.broadcast_to(2 + (along[1] - along[0])[[0, 2]], flat.shape)
        world = houses.show(panel.house, panel.locate(flat)) @ houses.level.T - origin
        shown[houses.hosts[panel.house]].append(np.concatenate((world, uv), axis=1))
    for panel, place, color, seen in textures:
        beside = [other for other in textures if other[0].room == panel.room and other[0].down[1] == panel.down[1]]
        number = next(number for number, other in enumerate(beside) if other[0] is panel)
        known = max(sum(float(other[3].sum()) for other in beside), 1.0)
        mean = sum(other[2].sum(axis=(0, 1)) for other in beside) / known
        if panel.down[1] == 1 and not seen.any():
            color, seen = _continue_walls(beside, number, color.shape[:2]) or (color, seen)
        texture = (255 * _fill(color, seen, mean)).round().clip(0, 255).astype(np.uint8)
        padded, (left, upper) = cv2.copyMakeBorder(texture, *[_MARGIN] * 4, cv2.BORDER_REPLICATE), place
        atlas[upper : upper + padded.shape[0], left : left + padded.shape[1]] = padded
    with io.BytesIO() as file:
        Image.fromarray(atlas).save(file, "WEBP", quality=_QUALITY, method=6)
        corners = {host: np.concatenate(each).round(5).tolist() for host, each in shown.items()}
        made = [
            PageHouse(*_list_nodes(houses, host, origin), tuple(map(tuple, each))) for host, each in corners.items()
        ]
        return DollHouse(tuple(made), file.getvalue())


def _list_nodes(houses: Houses, host: int, origin: Float[np.ndarray, "3"]) -> tuple[tuple, tuple]:
    """The views of a house and of rooms beside it, and how they are moved (`PageHouse`)."""
    found = {}
    for house in np.flatnonzero(np.array(houses.hosts) == host).tolist():
        for view in houses.views[house]:
            turn = 0.0 if house == host else houses.plan.drawn[view].turn or 0.0
            place = houses.level @ houses.show(house, houses.eyes[view]) - origin
            found[view] = turn, *place.astype(np.float32).tolist()
    nodes = tuple(sorted(found))
    return nodes, tuple(found[view] for view in nodes)


def _continue_walls(
    walls: Sequence[tuple[Panel, Any, np.ndarray, np.ndarray]], number: int, size: tuple[int, int]
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]] | None:
    """A texture of a wall that no camera sees: the colours at the edges of the walls beside it, from one to the other;
    None if none of them is seen.

    Args:
        walls: of a room, in order, with their textures.
        number: of the wall.
        size: rows and columns of the texture.
    """
    order = [*walls[number + 1 :], *walls[:number]]  # the next wall is on the left
    seen = [(color[: size[0]], known[: size[0]]) for _, _, color, known in order if len(known) >= size[0]]
    seen = [(color, known) for color, known in seen if known.any(axis=1).all()]
    if not seen:
        return None
    edges = []
    for (color, known), side in ((seen[0], -1), (seen[-1], 1)):
        count = max(round(_EDGE * known.shape[1]), 1)
        while not known[:, ::side][:, :count].any(axis=1).all():
            count += 1
        shown = (values[:, ::side][:, :count].sum(axis=1) for values in (color, known))
        sums = [cv2.GaussianBlur(each.reshape(size[0], -1), (1, 0), 0, sigmaY=_EDGE_SOFT * size[0]) for each in shown]
        edges.append(sums[0] / np.maximum(sums[1], 1e-9).reshape(-1, 1))
    share = np.linspace(0, 1, size[1], dtype=np.float32)[None, :, None]
    return (1 - share) * edges[0][:, None] + share * edges[1][:, None], np.ones(size, np.float32)


def _triangulate(shape: shapely.Geometry) -> Float[np.ndarray, "corner 2"]:
    """Corners of triangles of a shape, clockwise in a picture with the second axis down."""
    shape = shapely.set_precision(shape, 1e-4 * max(shape.bounds[2:]))  # without the slivers of differences
    pieces = shapely.orient_polygons(shapely.get_parts(shapely.constrained_delaunay_triangles(shape)))
    return shapely.get_coordinates(pieces).reshape(-1, 4, 2)[:, :3].reshape(-1, 2)


def _measure(panel: Panel, density: float) -> tuple[int, int]:
    """Width and height of the texture of a panel, texels, with margins."""
    if panel.facing is not None:
        return 0, 0
    width, height = (math.ceil(density * length) + 2 * _MARGIN for length in panel.shape.bounds[2:])
    return width, height


def _pack(panels: Sequence[Panel], density: float) -> tuple[float, Int[np.ndarray, "panel 2"]]:
    """The largest density, texels a length, with which all textures fit, and their left upper corners."""
    while True:
        sizes = [_measure(panel, density) for panel in panels]
        places, left, upper, row = np.zeros((len(panels), 2), int), 0, 0, 0
        for number in sorted(range(len(panels)), key=lambda k: -sizes[k][1]):
            width, height = sizes[number]
            if left + width > _ATLAS:
                left, upper, row = 0, upper + row, 0
            places[number] = left, upper
            left, row = left + width, max(row, height)
        if upper + row <= _ATLAS and max(width for width, _ in sizes) <= _ATLAS:
            return density, places
        density *= 0.95


class _Painter:
    """Projects photographs on panels."""

    def __init__(self, scene: Scene, houses: Houses, photographs: Sequence[PanoramaSet]) -> None:
        self.houses, self.poses, self.level = houses, scene.cam2world.double().cpu(), torch.from_numpy(houses.level)

        @functools.lru_cache(maxsize=_KEPT)
        def read(view: int) -> Float[Tensor, "3 height width"]:
            if photographs:
                return read_photograph(scene, view, photographs[view], _PHOTO_ROWS)
            rows, blend = min(scene.height, _PHOTO_ROWS), "joint" if scene.joint else view
            return pipeline.render(scene, scene.cam2world[view], blend=blend, size=(rows, 2 * rows)).color.clamp(0, 1)

        self.read = read
        self.reaches = []
        for view, pose in enumerate(self.poses):
            own = scene.gaussians.levels < BACKGROUND_LEVEL
            if not scene.joint:
                own &= scene.gaussians.views == view
            self.reaches.append(measure_reach(scene.gaussians.select(own), pose, _REACH_ROWS).cpu())
        self.eyes = houses.eyes

    def is_open(self, room: int, wall: Float[np.ndarray, "2 2"], floor: float) -> bool:
        """Whether the nearest camera of a room sees through a wall, which is open then, or a window."""
        views, (start, end) = self.houses.plan.rooms[room].panoramas, wall
        view = min(views, key=lambda view: np.linalg.norm(self.eyes[view][[0, 2]] - (start + end) / 2))
        shares, heights = np.meshgrid(np.linspace(0.1, 0.9, 9), np.linspace(0, 0.8, 5))
        flat = start + shares.reshape(-1, 1) * (end - start)
        down = self.eyes[view][1] + heights.reshape(-1) * (floor - self.eyes[view][1])
        offsets = np.stack((flat[:, 0], down, flat[:, 1]), axis=1) - self.eyes[view]
        behind = torch.from_numpy(self.eyes[view] + _THROUGH * offsets) @ self.level.T
        return bool(are_seen(behind, self.poses[view], self.reaches[view]).double().mean() > _OPEN)

    def paint(self, panel: Panel, density: float) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
        """The texture of a panel, premultiplied, and where it is seen, 0 to 1."""
        width, height = (size - 2 * _MARGIN for size in _measure(panel, density))
        unit = float(np.median(self.houses.floors))
        coarse = [max(round(size / density / (_STEP * unit)), 1) for size in (width, height)]
        grid = _grid(*coarse, width / density, height / density)
        costs = np.array([self._judge(panel, grid, view, unit) for view in self.houses.views[panel.house]])
        is_seen = np.isfinite(costs)
        shares = is_seen & (costs == costs.min(axis=0))
        wide = np.array([cv2.GaussianBlur(share.astype(np.float32), (0, 0), _WIDE / 2) for share in shares]) * is_seen
        shares = is_seen & (wide == wide.max(axis=0))  # no small pieces
        shares = np.array([cv2.GaussianBlur(share.astype(np.float32), (0, 0), _SOFT) for share in shares]) * is_seen
        shares /= np.maximum(shares.sum(axis=0), 1e-9)
        places = torch.from_numpy(panel.locate(_grid(width, height, width / density, height / density)))
        color = np.zeros((height, width, 3), np.float32)
        for number, view in enumerate(self.houses.views[panel.house]):
            if not shares[number].any():
                continue
            share = cv2.resize(shares[number], (width, height))  # linear
            chosen = torch.from_numpy(share > 0)
            offsets = (places[chosen] - torch.from_numpy(self.eyes[view])) @ self.level.T @ self.poses[view, :3, :3]
            found = sample_equirect(self.read(view), uv_from_directions(offsets).float()).T.numpy()
            color[share > 0] += share[share > 0][:, None] * found
        return color, cv2.resize(is_seen.any(axis=0).astype(np.float32), (width, height))

    def _judge(
        self, panel: Panel, grid: Float[np.ndarray, "h w 2"], view: int, unit: float
    ) -> Float[np.ndarray, "h w"]:
        """How badly a camera shows places of a panel: its distance, more where something is in front; inf if unseen."""
        room = self.houses.plan.rooms[panel.room]
        places, normal = panel.locate(grid), np.cross(panel.down, panel.right)  # into the room
        offsets = places - self.eyes[view]
        distance = np.linalg.norm(offsets, axis=-1)
        world = torch.from_numpy(places.reshape(-1, 3)) @ self.level.T
        is_shown = are_seen(world, self.poses[view], self.reaches[view]).numpy().reshape(distance.shape)
        clear = cv2.GaussianBlur(is_shown.astype(np.float32), (0, 0), _WIDE)
        house = list(self.houses.views[panel.house])
        aside = np.linalg.norm((places[..., None, :] - self.eyes[house])[..., (0, 2)], axis=-1)
        # Whether each place is on the floor under each camera of the house, where its tripod stands.
        is_under = (aside < _TRIPOD * unit) & (offsets[..., 1:2] > 0.5 * unit)
        cost = distance * (1 + (_HIDDEN - 1) * (1 - clear))
        # What stands before a tripod does not replace it.
        is_seen = is_shown | ((view in room.panoramas) & ~is_under.any(axis=-1))
        is_seen &= (-(offsets @ normal) > _GRAZING * distance) & ~is_under[..., house.index(view)]
        ahead = shapely.Point(self.eyes[view][[0, 2]])
        outline = room.shape
        if outline.contains(ahead) and outline.area < 0.999 * outline.convex_hull.area:
            flat = (places + _ASIDE * unit * normal)[..., (0, 2)][is_seen]
            ways = shapely.linestrings(np.stack(np.broadcast_arrays(flat, self.eyes[view][[0, 2]]), axis=-2))
            shapely.prepare(outline)
            is_seen[is_seen.copy()] = shapely.covers(outline, ways)
        return np.where(is_seen, cost, np.inf)


def _grid(columns: int, rows: int, width: float, height: float) -> Float[np.ndarray, "rows columns 2"]:
    """Centres of equal cells of a rectangle."""
    x, y = (np.arange(columns) + 0.5) * width / columns, (np.arange(rows) + 0.5) * height / rows
    return np.stack(np.meshgrid(x, y), axis=-1)


def _fill(
    color: Float[np.ndarray, "h w 3"], weight: Float[np.ndarray, "h w"], mean: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "h w 3"]:
    """Premultiplied colours over the colours around them, ever more blurred away from what is known, or over a mean."""
    if min(weight.shape) > 1 and weight.min() < 1:
        size = (weight.shape[1] + 1) // 2, (weight.shape[0] + 1) // 2
        half, share = (cv2.resize(values, size, interpolation=cv2.INTER_AREA) for values in (color, weight))
        known = np.minimum(4 * share, 1)
        below = _fill(half * (known / np.maximum(share, 1e-9))[..., None], known, mean)
        below = cv2.resize(below, weight.shape[::-1], interpolation=cv2.INTER_LINEAR)
        return color + (1 - weight[..., None]) * below
    return color + (1 - weight[..., None]) * mean
