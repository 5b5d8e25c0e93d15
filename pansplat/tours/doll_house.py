"""The doll's house view: what is drawn of a scene for a camera outside of its rooms.

The Gaussians of a view lie on surfaces that its camera saw. From outside, two things hide the rooms: what is around
them (ceilings, gardens behind windows, and what a camera saw of places far away), and the backs of the near walls.
`find_rooms` bounds the rooms, whatever the camera; `find_fronts` leaves out backs, for each position of the camera.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
import shapely
import torch
from jaxtyping import Bool, Float
from shapely.geometry import Polygon
from torch import Tensor

from pansplat.constants import FRONT_COSINE
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats
from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import assign_storeys, choose_camera_height, find_ceiling
from pansplat.tours.plan import Plan
from pansplat.tours.surfaces import locate_surfaces

_CEILING = 0.88  # of its height over the camera; above that nothing is drawn
_FLOOR = 1.12  # of the height of the camera; below that nothing is drawn
_USUAL_CEILING = 0.65  # height over the camera of one that is not seen, in heights of the camera
_WALL = 0.15  # how far behind the outline of a room its walls are drawn, in heights of the camera
_BEYOND = 0.4  # the same around a floor without walls, where furniture may stand
_NEAREST = 2.0  # a Gaussian is drawn up to this multiple of the distance to the nearest camera from its own camera
_COARSEST = 1  # pyramid level; coarser Gaussians lie behind the surfaces
_SHOWN = 0.9  # of the surfaces of a view without walls and floor
_OUTLIERS = 0.005  # of the Gaussians on each side of the box around the rooms
_SAMPLES = 20_000  # Gaussians of each view that the rooms are found by
_ROUGH = 0.505  # of `measure_roughness`: living_room has .49, 19 other storeys .42 at most, a heap .52
_NEIGHBORS, _PLACES = 12, 4000  # by which roughness is measured
_FEWEST = 5000  # Gaussians of a storey by which it is judged; of a predicted panorama there are about 10,000


@dataclass(frozen=True, eq=False)
class Rooms:
    """The rooms of a scene.

    Attributes:
        level: right, down and forward (columns) of a level camera.
        positions: of the cameras of all views.
        floors, ceilings: their distances below and above the camera of each view, metres.
        shape: the rooms from above, in plan coordinates.
        parts, storeys: of each view.
        plan: the floor plan.
        samples: of the Gaussians, which the rooms were found by.
    """

    level: Float[np.ndarray, "3 3"]
    positions: Float[np.ndarray, "view 3"]
    floors: Float[np.ndarray, "view"]
    ceilings: Float[np.ndarray, "view"]
    shape: shapely.Geometry
    parts: tuple[int, ...]
    storeys: tuple[int, ...]
    plan: Plan
    samples: Gaussians

    @cached_property
    def is_clear(self) -> tuple[bool, ...]:
        """Whether the surfaces of the part and the storey of each view are smooth enough to be seen from afar."""
        inside = self.samples.select(self.find_inside(self.samples))
        levels = [self.list_level(view) for view in range(len(self.parts))]
        clear = {views: _is_clear(inside, views) for views in set(levels)}
        return tuple(clear[views] for views in levels)

    def list_level(self, view: int) -> tuple[int, ...]:
        """The views of the part and the storey of a view."""
        keys = list(zip(self.parts, self.storeys, strict=True))
        return tuple(other for other, key in enumerate(keys) if key == keys[view])

    def contains(self, places: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Whether places in the world are in the rooms, from above, with their walls."""
        plan = np.asarray(places, np.float64) @ self.level[:, (0, 2)]
        return shapely.contains_xy(self.shape, plan[:, 0], plan[:, 1])

    def find_inside(self, gaussians: Gaussians) -> Bool[Tensor, "n"]:
        """Whether each Gaussian is on a surface in a room, below its ceiling, and its camera is near enough."""
        views, means = gaussians.views.long().cpu(), gaussians.means.cpu()
        positions = torch.from_numpy(self.positions)
        origin = positions.mean(dim=0)  # float32 is accurate around it
        means, positions = (means - origin.to(means)).float(), (positions - origin).float()
        offsets = means - positions[views]
        nearest = torch.full((len(means),), torch.inf)
        for position in positions:
            nearest = torch.minimum(nearest, (means - position).square().sum(dim=1))
        level = torch.from_numpy(self.level).float()
        down = offsets @ level[:, 1]
        floors, ceilings = torch.from_numpy(self.floors).float(), torch.from_numpy(self.ceilings).float()
        inside = (down > -_CEILING * ceilings[views]) & (down < _FLOOR * floors[views])
        inside &= offsets.square().sum(dim=1) <= _NEAREST**2 * nearest
        inside &= gaussians.levels.cpu() <= _COARSEST
        inside[inside.clone()] = torch.from_numpy(self.contains((means[inside].double() + origin).numpy()))
        return inside


def find_fronts(gaussians: Gaussians, positions: Float[Tensor, "view 3"], eye: Float[Tensor, "3"]) -> Bool[Tensor, "n"]:
    """Whether a camera sees each Gaussian from the side from which the camera of its view saw it.

    Both cameras are on one side of its plane, which is at right angles to its shortest axis, and the rays from them are
    at an angle with a cosine of at least `FRONT_COSINE`: axes are inaccurate (docs/rendering.md, section 10).

    Args:
        gaussians: of the views.
        positions: of the cameras of the views, in the world.
        eye: position of the camera.
    """
    means = gaussians.means.double()
    ray, seen = means - eye.to(means), means - positions.to(means)[gaussians.views.long()]
    shortest = gaussians.scales.abs().argmin(dim=1)
    axes = rotations_from_quats(gaussians.quats.double())
    normal = axes.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    is_same_side = (ray * normal).sum(dim=1) * (seen * normal).sum(dim=1) >= 0
    return is_same_side & ((ray * seen).sum(dim=1) >= FRONT_COSINE * ray.norm(dim=1) * seen.norm(dim=1))


def find_rooms(facts: TourFacts) -> Rooms:
    """The rooms of a scene of all panoramas: those of the floor plan, and the floors of panoramas without walls.

    Where a view shows neither, most of its surfaces are.
    """
    tour, scene, plan, gaussians = facts.tour, facts.scene, facts.plan, facts.scene.gaussians.to(device="cpu")
    level, count = tour.level_axes, len(tour)
    gaussians = gaussians.select(torch.isfinite(gaussians.means).all(dim=1))
    step = max(len(gaussians) // (_SAMPLES * max(len(gaussians.views.unique()), 1)), 1)
    gaussians = gaussians.select(torch.arange(0, len(gaussians), step))
    scene = dataclasses.replace(scene, gaussians=gaussians)
    unit = choose_camera_height(facts.heights, scene.far)
    ceilings = [find_ceiling(locate_surfaces(scene, view, level)) for view in range(count)]
    shapes = [Polygon(room.outline).buffer(_WALL * unit, join_style="mitre") for room in plan.rooms]
    enclosed = {view for room in plan.rooms for view in room.panoramas}
    for view in set(range(count)) - enclosed:
        if view in facts.outlines:
            shapes.append(shapely.make_valid(Polygon(facts.outlines[view].corners)).buffer(_BEYOND * unit))
        elif len(places := locate_surfaces(scene, view, level)):
            reach = float(np.quantile(np.hypot(places[:, 0], places[:, 2]), _SHOWN))
            shapes.append(shapely.Point(tour.positions[view] @ level[:, (0, 2)]).buffer(reach))
    return Rooms(
        level,
        tour.positions,
        np.array([height or unit for height in facts.heights]),
        np.array([ceiling or _USUAL_CEILING * unit for ceiling in ceilings]),
        shapely.union_all(shapes),
        tour.worlds,
        tuple(assign_storeys(tour)),
        plan,
        gaussians,
    )


def _is_clear(inside: Gaussians, views: tuple[int, ...]) -> bool:
    means = inside.means[torch.isin(inside.views, torch.tensor(views).to(inside.views))].double().numpy()
    return len(means) < _FEWEST or measure_roughness(means) <= _ROUGH


def measure_roughness(places: Float[np.ndarray, "n 3"]) -> float:
    """How thick the roughest fifth of some surfaces is beside its width, each place with its nearest neighbours.

    0 is smooth. In a heap of scattered places it is about .8.

    Args:
        places: on surfaces, more than 12.
    """
    chosen = places[:: max(len(places) // _PLACES, 1)]
    near = places[scipy.spatial.cKDTree(places).query(chosen, k=_NEIGHBORS + 1)[1]]
    sizes = np.linalg.svd(near - near.mean(axis=1, keepdims=True), compute_uv=False)
    return float(np.quantile(sizes[:, 2] / np.maximum(sizes[:, 1], 1e-12), 0.8))


def measure_box(
    means: Float[Tensor, "n 3"], level: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The least and the greatest coordinates, along level axes, of nearly all of some Gaussians."""
    places = means.double().cpu().numpy() @ level
    return np.quantile(places, _OUTLIERS, axis=0), np.quantile(places, 1 - _OUTLIERS, axis=0)
