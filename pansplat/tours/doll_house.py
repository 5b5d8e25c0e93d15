"""The rooms of a doll's house: outlines from above, floors and ceilings, and which panoramas are in one house."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import shapely
import torch
from jaxtyping import Float
from shapely.geometry import Polygon

from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import assign_storeys, choose_camera_height, find_ceiling
from pansplat.tours.plan import Plan
from pansplat.tours.surfaces import sample_surfaces

_USUAL_CEILING = 0.65  # height over the camera of one that is not seen, in heights of the camera
_WALL = 0.15  # how far behind the outline of a room its walls are, in heights of the camera
_BROAD = 0.12, 0.88  # of its ends, at equal steps of azimuth: a floor goes on behind doors and windows
_LEAST_AREA = 0.4  # of a floor that is a room, squared camera heights


@dataclass(frozen=True, eq=False)
class Rooms:
    """The rooms of a scene.

    Attributes:
        level: right, down and forward (columns) of a level camera.
        positions: of the cameras of all views.
        floors, ceilings: their distances below and above the camera of each view, metres.
        outlines: views and outline, anticlockwise, of each room: those of the plan, then floors without walls.
        houses: the views of each storey of a world, if at least half of its rooms are on the plan.
        plan: the floor plan.
    """

    level: Float[np.ndarray, "3 3"]
    positions: Float[np.ndarray, "view 3"]
    floors: Float[np.ndarray, "view"]
    ceilings: Float[np.ndarray, "view"]
    outlines: tuple[tuple[tuple[int, ...], Polygon], ...]
    houses: tuple[tuple[int, ...], ...]
    plan: Plan


def find_rooms(facts: TourFacts) -> Rooms:
    """The rooms of a scene of all panoramas: those of the floor plan, and the floors of panoramas without walls."""
    tour, scene, plan, gaussians = facts.tour, facts.scene, facts.plan, facts.scene.gaussians.to(device="cpu")
    level, count = tour.level_axes, len(tour)
    gaussians = gaussians.select(torch.isfinite(gaussians.means).all(dim=1))
    scene = dataclasses.replace(scene, gaussians=gaussians)
    unit = choose_camera_height(facts.heights, scene.far)
    ceilings = [find_ceiling(sample_surfaces(scene, view, level)) for view in range(count)]
    outlines = [(room.panoramas, Polygon(room.outline)) for room in plan.rooms]  # anticlockwise
    keys = list(zip(tour.worlds, assign_storeys(tour), strict=True))
    enclosed = {view for views, _ in outlines for view in views}
    for view in set(range(count)) - enclosed:
        floor = facts.outlines.get(view)
        if floor is not None and outlines:
            sides = np.concatenate([np.diff(shapely.get_coordinates(outline), axis=0) for _, outline in outlines])
            x, y = max(sides, key=np.linalg.norm) / np.linalg.norm(sides, axis=1).max()
            axes = np.array(((x, -y), (y, x)))
            low, high = np.quantile(floor.corners @ axes, _BROAD, axis=0)
            beside = [outline for views, outline in outlines if keys[views[0]] == keys[view]]
            taken = shapely.union_all(beside).buffer(_WALL * unit, join_style="mitre")
            free = Polygon(shapely.get_coordinates(shapely.box(*low, *high)) @ axes.T).difference(taken)
            piece = max(shapely.get_parts(free), key=lambda piece: piece.area, default=None)
            if isinstance(piece, Polygon) and piece.area > _LEAST_AREA * unit**2:
                outlines.append(((view,), shapely.orient_polygons(piece)))
    houses = []
    for key in dict.fromkeys(keys):
        views = tuple(view for view, other in enumerate(keys) if other == key)
        missing = sum(view not in enclosed for view in views)
        if sum(room.panoramas[0] in views for room in plan.rooms) >= max(missing, 1):
            houses.append(views)
    return Rooms(
        level,
        tour.positions,
        np.array([height or unit for height in facts.heights]),
        np.array([ceiling or _USUAL_CEILING * unit for ceiling in ceilings]),
        tuple(outlines),
        tuple(houses),
        plan,
    )
