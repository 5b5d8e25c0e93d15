"""What the surfaces of a scene show of its tour. One place computes each part, once, and stores it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from pansplat.gaussians.scene import Scene
from pansplat.system.source_hash import hash_sources
from pansplat.system.store import Store, hash_parts
from pansplat.tours.edges import find_poor_edges, find_walls
from pansplat.tours.floor import FloorOutline, choose_camera_height, find_ceiling, find_floor, find_floor_outline
from pansplat.tours.graph import Edge, TourGraph, ViewNumbers
from pansplat.tours.outlook import find_hidden, measure_clearance, measure_outlook
from pansplat.tours.plan import Door, Plan, make_plan
from pansplat.tours.rooms import Room
from pansplat.tours.scene_graph import describe_tour, make_graph
from pansplat.tours.surfaces import Surfaces, find_surfaces

Value = TypeVar("Value")


def _stored(compute: Callable[[TourFacts], Value]) -> cached_property[Value]:
    """A property that is computed when it is read first, and stored under its name."""

    def read(facts: TourFacts) -> Value:
        if facts._store is None:
            return compute(facts)
        return facts._store.get(f"tour_{compute.__name__.strip('_')}", facts._key, lambda: compute(facts))

    return cached_property(read)


class TourFacts:
    """What a scene shows of a tour: each part is computed when it is read first.

    Attributes:
        scene: of some panoramas of the tour, in its world, with all Gaussians of each.
        tour: the graph, before its surfaces are known.
        views: the number in the tour of each of the scene's views.
    """

    def __init__(
        self,
        scene: Scene,
        tour: TourGraph | None = None,
        views: ViewNumbers | None = None,
        *,
        folder: Path | None = None,
    ) -> None:
        """Compute nothing yet.

        Args:
            scene: see the class.
            tour: by default that of the scene's cameras.
            views: by default all panoramas.
            folder: of the panoramas, in which the parts are stored; None keeps none.
        """
        self.scene = scene
        self.tour = make_graph(scene) if tour is None else tour
        self.views = tuple(range(len(self.tour))) if views is None else views
        self._store = None if folder is None else Store(folder, (FloorOutline, Room, Door))

    def prepare(self) -> TourFacts:
        """Compute what a viewer reads while it draws."""
        _ = self.outlines, self.outlooks, self.hidden, self.graph
        return self.forget_surfaces()

    def forget_surfaces(self) -> TourFacts:
        """Take the surfaces, which need much memory, out of it; they are found again when they are read."""
        vars(self).pop("surfaces", None)
        return self

    @cached_property
    def surfaces(self) -> dict[int, Surfaces]:
        """What each view shows, by panorama, in the level axes of the tour."""
        return dict(zip(self.views, find_surfaces(self.scene, self.tour.level_axes), strict=True))

    @cached_property
    def _key(self) -> str:
        """A hash of all that a part depends on."""
        tour, gaussians = self.tour, self.scene.gaussians
        edges = [row for row in describe_tour(tour).overlaps if {*row[:2]} <= {*self.views}]
        names = [(panorama.name, panorama.title) for panorama in tour.panoramas]
        arrays = gaussians.means, gaussians.opacities, gaussians.views, gaussians.levels, self.scene.cam2world
        return hash_parts(
            hash_sources(__name__),
            json.dumps([self.views, edges, tour.worlds, names, self.scene.joint]),
            tour.cam2world.numpy(),
            *(array.detach().cpu().numpy() for array in arrays),
        )

    @_stored
    def heights(self) -> list[float | None]:
        """Heights of the cameras over the floor, metres; None where a view shows no floor."""
        return [find_floor(own.samples) for own in self.surfaces.values()]

    @_stored
    def ceilings(self) -> list[float | None]:
        """Heights of the ceilings over the cameras, metres; None where a view shows none."""
        return [find_ceiling(own.samples) for own in self.surfaces.values()]

    @cached_property
    def usual_heights(self) -> list[float]:
        """The heights of all cameras of the tour, metres; the median of those that are known for the others."""
        known = dict(zip(self.views, self.heights, strict=True))
        usual = choose_camera_height(self.heights, self.tour.far)
        return [known.get(node) or usual for node in range(len(self.tour))]

    @_stored
    def _floors(self) -> list[FloorOutline | None]:
        return [find_floor_outline(own.samples, own.center[[0, 2]]) for own in self.surfaces.values()]

    @cached_property
    def outlines(self) -> dict[int, FloorOutline]:
        """The floor outlines of the views that show a floor, by panorama."""
        found = zip(self.views, self._floors, strict=True)
        return {node: outline for node, outline in found if outline is not None}

    @_stored
    def outlooks(self) -> Float[np.ndarray, "view bin"]:
        """Distances around the horizon (`measure_outlook`)."""
        return np.stack([measure_outlook(own) for own in self.surfaces.values()])

    @_stored
    def clearances(self) -> Float[np.ndarray, "view row bin"]:
        """Distances of the nearest surfaces around the cameras (`measure_clearance`)."""
        return np.stack([measure_clearance(own) for own in self.surfaces.values()])

    @cached_property
    def graph(self) -> TourGraph:
        """The tour with what its surfaces show: walls in place of edges, poor edges, and clearances."""
        tour = self.tour.with_walls(self.walls) if self.walls else self.tour
        clearances = dict(zip(self.views, self.clearances, strict=True))
        poor = tuple(edge for edge in self.poor if edge in tour.overlaps)
        return dataclasses.replace(tour, poor=poor, clearances=clearances)

    @property
    def ways(self) -> TourGraph:
        """The graph along whose edges a camera flies: without an edge, between any two panoramas."""
        return self.graph if self.tour.overlaps else self.graph.with_all_edges()

    @_stored
    def hidden(self) -> list[list[int]]:
        """For each view, the panoramas whose places on the floor surfaces hide (`find_hidden`)."""
        marks, hidden = self.tour.positions @ self.tour.level_axes, []
        marks[:, 1] += self.usual_heights
        for node, own in self.surfaces.items():
            found = find_hidden(own, marks - own.center)
            hidden.append([other for other in found if other != node])
        return hidden

    @_stored
    def walls(self) -> list[Edge]:
        """Edges through walls. Empty if `scene.tour` is known: `merge_scenes` has removed them."""
        return [] if self.scene.tour else find_walls(self.surfaces, self.tour.overlaps)

    @_stored
    def poor(self) -> tuple[Edge, ...]:
        """The edges whose flights would be poor (`find_poor_edges`); unknown where each surface is kept once."""
        return () if self.scene.joint else find_poor_edges(self.surfaces, self.tour.overlaps)

    @cached_property
    def plan(self) -> Plan:
        """The floor plan of a scene of all panoramas."""
        return Plan(self.tour, **self._plan)

    @_stored
    def _plan(self) -> dict[str, Any]:
        plan = make_plan([*self.surfaces.values()], self.tour, self.heights, self.ceilings, self._floors)
        return {name: value for name, value in vars(plan).items() if name != "tour"}
