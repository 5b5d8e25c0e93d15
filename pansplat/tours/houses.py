"""The houses of a doll's house view: their panoramas, floors and ceilings, and where each is shown."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import list_storeys_of_worlds
from pansplat.tours.plan import Plan

_USUAL_CEILING = 0.65  # height over the camera of one that is not seen, in heights of the camera


@dataclass(frozen=True, eq=False)
class Houses:
    """The houses of a scene.

    Attributes:
        floors, ceilings: their distances below and above the camera of each view, metres.
        views: of each house: those of a storey that has as many closed rooms as views outside of them, or more.
        plan: the floor plan.
    """

    floors: Float[np.ndarray, "view"]
    ceilings: Float[np.ndarray, "view"]
    views: tuple[tuple[int, ...], ...]
    plan: Plan

    @property
    def level(self) -> Float[np.ndarray, "3 3"]:
        """Right, down and forward (columns) of a level camera."""
        return self.plan.tour.level_axes

    @cached_property
    def eyes(self) -> Float[np.ndarray, "view 3"]:
        """Right, down and forward of the cameras of all views."""
        return self.plan.tour.positions @ self.level

    @cached_property
    def hosts(self) -> tuple[int, ...]:
        """The house that each house is shown beside, by its links; itself if it stands apart."""
        of_view = {view: number for number, views in enumerate(self.views) for view in views}
        drawn = [self.plan.drawn.get(views[0]) for views in self.views]
        shown = [None if place is None or place.turn is None else of_view.get(place.beside) for place in drawn]
        return tuple(number if host is None else host for number, host in enumerate(shown))

    def show(self, house: int, places: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Where places of a house (right, down, forward) are shown: beside its host, on the same floor."""
        if (host := self.hosts[house]) == house:
            return places
        floors = self.eyes[:, 1] + self.floors
        own, other = (float(np.median(floors[list(self.views[number])])) for number in (house, host))
        flat = self.plan.drawn[self.views[house][0]].move(places[..., (0, 2)])
        return np.stack((flat[..., 0], places[..., 1] + other - own, flat[..., 1]), axis=-1)


def find_houses(facts: TourFacts) -> Houses:
    """The houses of a scene of all panoramas: their rooms are those of the floor plan."""
    tour, plan = facts.tour, facts.plan
    keys = list_storeys_of_worlds(tour)
    enclosed = {view for room in plan.rooms if room.is_closed for view in room.panoramas}
    houses = []
    for key in dict.fromkeys(keys):
        views = tuple(view for view, other in enumerate(keys) if other == key)
        missing = sum(view not in enclosed for view in views)
        if sum(room.is_closed and room.panoramas[0] in views for room in plan.rooms) >= max(missing, 1):
            houses.append(views)
    return Houses(
        np.array(facts.usual_heights),
        np.array([ceiling or _USUAL_CEILING * plan.camera_height for ceiling in facts.ceilings]),
        tuple(houses),
        plan,
    )
