"""Tours: many panoramas of one place as a graph, the scenes of its edges, routes along it, and its floor plan.

An edge joins two panoramas that show the same surfaces. A camera flies along edges; the scene of an edge is predicted
from its two panoramas and a third one that overlaps with both. Panoramas without poses are parts of their own, with a
self-edge and the scene of a single view. Between parts the image fades.
"""

from pansplat.tours.doll_house import Rooms, find_fronts, find_rooms, fit_box, measure_box
from pansplat.tours.edges import find_poor_edges
from pansplat.tours.floor import (
    FloorOutline,
    FloorPlan,
    choose_camera_height,
    draw_floor_plan,
    find_camera_height,
    find_floor_outline,
    find_floor_outlines,
    find_other_storeys,
    find_storeys,
    paint_floor_plan,
    trace_floor,
    write_floor_plan,
)
from pansplat.tours.graph import (
    EDGE_HYSTERESIS,
    MAX_SCENE_VIEWS,
    Edge,
    TourGraph,
    ViewNumbers,
    find_tours,
    list_starts,
    make_graph,
    merge_scenes,
    select_views,
)
from pansplat.tours.links import find_link_ring, find_way_along_link
from pansplat.tours.outlook import choose_heading, find_blank, is_hidden, measure_outlook
from pansplat.tours.overlap import connect
from pansplat.tours.route import FADE_SECONDS, STOP_REACH, STOP_SECONDS, Route, find_angles, plan_route
from pansplat.tours.walls import find_walls

__all__ = [
    "EDGE_HYSTERESIS",
    "FADE_SECONDS",
    "MAX_SCENE_VIEWS",
    "STOP_REACH",
    "STOP_SECONDS",
    "Edge",
    "FloorOutline",
    "FloorPlan",
    "Rooms",
    "Route",
    "TourGraph",
    "ViewNumbers",
    "choose_camera_height",
    "choose_heading",
    "connect",
    "draw_floor_plan",
    "find_angles",
    "find_blank",
    "find_camera_height",
    "find_floor_outline",
    "find_floor_outlines",
    "find_fronts",
    "find_link_ring",
    "find_other_storeys",
    "find_poor_edges",
    "find_rooms",
    "find_storeys",
    "find_tours",
    "find_walls",
    "find_way_along_link",
    "fit_box",
    "is_hidden",
    "list_starts",
    "make_graph",
    "measure_box",
    "measure_outlook",
    "merge_scenes",
    "paint_floor_plan",
    "plan_route",
    "select_views",
    "trace_floor",
    "write_floor_plan",
]
