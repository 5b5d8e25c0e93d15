"""Writing of a page: the reduced scene, the data of its panoramas, a poster and the program in one HTML file."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import html
import io
import json
import math
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import quote, urljoin

import msgspec
import numpy as np
import scipy
import shapely
import torch
from jaxtyping import Float, Int
from PIL import Image
from shapely.geometry import Point, Polygon
from torch import Tensor

from pansplat import constants, pipeline
from pansplat.errors import InputError, InputWarning
from pansplat.export.doll_house import DollHouse, make_house
from pansplat.export.film import FilmPhotographs
from pansplat.export.page_data import MAX_DEGREE, PackedGaussians, PageHeader, count_bytes, pack_gaussians
from pansplat.export.photographs import MAX_HEIGHT, PackedPhotograph, label_files, pack_photographs
from pansplat.gaussians.scene import Gaussians, Scene, prune
from pansplat.geometry.path import find_direction, path_poses, turn_pose
from pansplat.inputs.pairs import Pair
from pansplat.inputs.views import Views
from pansplat.refinement import DISPLAY_HEIGHT, RefineConfig, Refinement
from pansplat.rendering.color_fit import fit_colors
from pansplat.rendering.image_planes import image_planes
from pansplat.shaders import load_shader
from pansplat.system.atomic import replacing
from pansplat.system.console import with_progress_bar
from pansplat.system.descriptions import describe_count, list_first
from pansplat.system.files import SOFTWARE, is_written
from pansplat.system.progress import report_progress, stage
from pansplat.tours.doll_house import find_rooms
from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import assign_storeys
from pansplat.tours.graph import EDGE_HYSTERESIS, Edge, TourGraph, select_views
from pansplat.tours.layout import REACH
from pansplat.tours.links import find_link_ring, find_way_along_link, link_parts
from pansplat.tours.outlook import choose_arrival, find_turned
from pansplat.tours.plan import Plan, Room
from pansplat.tours.route import Route, find_angles, plan_route

DEFAULT_GAUSSIANS = 600_000  # pages of about 13 MB
PHOTO_GAUSSIANS = 450_000  # the same of a page with photographs, about 10 MB
MAX_GAUSSIANS = 4_000_000  # fit textures of 2048 texels a side, which every device has
MAX_FILE_BYTES = 64_000_000  # of a page in one file
_TARGET_BYTES = 15_000_000  # harmonics of higher degree are left out of larger pages, and photographs are smaller
_GAUSSIANS_SHARE = 1 / 2  # of it, beside photographs
_FLOWN_SHARE, _STILL_SHARE = (
    2 / 3,
    1 / 4,
)  # of the Gaussians of a panorama, with and without flights, beside photographs
_GAUSSIAN_BYTES, _PHOTO_BYTES = 22, 0.45  # of a page: a Gaussian, and a photograph as a fraction of its squared rows
_PROGRAM_BYTES = 200_000  # of a page without its data
_PART_BYTES = 1_500_000  # of the data between two steps of the progress bar; divisible by 3
_FIT_STEPS = 8  # of merged Gaussians to the images of all Gaussians
_START_FOV = 75.0  # degrees, vertical, of a landscape image
_TALLEST = 1.5  # height of a portrait image relative to it; the poster has this height
_POSTER_SIZE = (810, 960)  # height and width, pixels
_UNKNOWN_FLOOR, _ROUGH_OUTLINE = (
    1.5,
    0.1,
)  # metres, around a panorama without a floor; of what is smoothed of a floor's end
_ROUTE_RATE = 10  # samples of a flight a second
_SPEED = 0.3  # walking, fraction of the reach a second
_SINGLE_REACH = 1.0  # metres from a panorama without others in its part, at most half the distance of its surfaces
_BATCH = 256  # quads that are drawn together
_SHADERS = {"splat": ("page.vert", "splat.frag"), "accumulate": ("screen.vert", "accumulate.frag")}
_SHADERS |= {"resolve": ("screen.vert", "resolve.frag"), "mark": ("mark.vert", "mark.frag")}
_SHADERS |= {"photograph": ("screen.vert", "photograph.frag"), "house": ("house.vert", "house.frag")}

_WORKER = ("unpack.js", "sorter.js")
_LIBRARIES = ("graph.js", "renderer.js")  # which know nothing of the page; scripts of their own
_IMPORT = re.compile(r'^import \{[^}]*\} from "\./(\w+\.js)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export ", re.MULTILINE)


@dataclass(frozen=True)
class PageFiles:
    """The files of a page that was written.

    Attributes:
        files: the page, and its parts if it is split.
        num_bytes: of all files.
        num_gaussians: in the page.
        photo_height: of its photographs, pixels; 0 without photographs.
        num_flights: number of edges along which it flies.
        fades: labels of the two panoramas of each edge along which it fades.
        num_outside: panoramas without doll's house.
    """

    files: tuple[Path, ...]
    num_bytes: int
    num_gaussians: int
    photo_height: int = 0
    num_flights: int = 0
    fades: tuple[tuple[str, str], ...] = ()
    num_outside: int = 0


@with_progress_bar
def write_page(
    scene: Scene,
    path: Path | str,
    *,
    gaussians: int = DEFAULT_GAUSSIANS,
    split: bool = False,
    title: str | None = None,
    address: str | None = None,
    photographs: Sequence[Pair] = (),
    photo_height: int | None = None,
) -> PageFiles:
    """Write a scene as a web page.

    Args:
        scene: any number of panoramas; without one the page starts in the middle of the Gaussians. In a scene of a tour
            (`pansplat.predict_tour`), the views of the nearest edge are blended, and flights follow the edges. In other
            scenes, all views are blended everywhere.
        path: the .html file.
        gaussians: largest number of Gaussians; similar neighbours are merged.
        split: write the data to the folder `NAME_files` beside the page, for large scenes.
        title: of the page; by default the name of the file.
        address: of the page on the web, for previews of links to it. They show the poster of a split page.
        photographs: of each view, which the page shows there (`list_photographs`), with the notes of its
            tour; none without them.
        photo_height: their largest height, pixels, 0 for none; by default what fits, if it is split that of the files.
    """
    path = Path(path)
    if not 1 <= gaussians <= MAX_GAUSSIANS:
        raise InputError(f"`gaussians` must be 1 to {MAX_GAUSSIANS:,} in a page, got {gaussians:,}")
    report_progress("checking the scene", 0.0)
    if scene.joint and scene.overlaps:
        warnings.warn(
            "a page follows the edges of a tour with all Gaussians of each panorama, got each surface once; its "
            "flights are straight. Export the folder of the photographs, or a scene file of --layers.",
            InputWarning,
            stacklevel=2,
        )
        scene = dataclasses.replace(scene, overlaps=(), links=(), starts=(), approximate=())
    has_cameras, prepared = len(scene.cam2world) > 0, _prepare(scene)
    facts = TourFacts(
        scene if has_cameras else prepared,
        folder=photographs[0].folder if photographs else None,
        level=None if scene.overlaps else path_poses(prepared.cam2world)[0, :3, :3].numpy(),
    )
    tour = dataclasses.replace(facts.tour, poor=facts.poor)
    rooms = find_rooms(facts) if has_cameras else None
    plan = None if rooms is None or not rooms.plan.num_heights else rooms.plan
    floors = _outline_floors(facts, () if plan is None else plan.rooms) if has_cameras else []
    scene = prepared
    flights = _plan_flights(scene, tour, facts)
    house, has_pictures = DollHouse((), b""), len(photographs) > 0 and photo_height != 0
    if rooms is not None:
        report_progress("building the doll's house", 0.0)
        house = make_house(scene, rooms, flights.level, photographs if has_pictures else ())
    heights = [min(each.image_height, photo_height or MAX_HEIGHT) for each in photographs if has_pictures and not split]
    shares = _share_gaussians(flights, tour.poor, gaussians, heights)
    kept = round(gaussians * sum(shares[part] for part in flights.parts) / len(flights.parts))
    if len(scene.gaussians) > kept:
        report_progress("merging Gaussians", 0.1)
        scene = _merge(scene, flights.parts, gaussians, steps=_FIT_STEPS if has_cameras else 0, shares=shares)
    report_progress("compressing", 0.6)
    degree = _choose_degree(scene, _TARGET_BYTES * (_GAUSSIANS_SHARE if has_pictures and not split else 1))
    origin = scene.cam2world[:, :3, 3].mean(0).numpy()
    packed = pack_gaussians(scene.gaussians, origin, _order_views(scene, flights), degree)
    report_progress("drawing the poster", 0.7)
    poster = _draw_poster(scene, flights.start, photographs if has_pictures else ())
    pictures: list[PackedPhotograph] = []
    if has_pictures:
        left = 0.75 * (_TARGET_BYTES - _PROGRAM_BYTES) - sum(map(len, packed.contents)) - len(poster + house.atlas)
        with stage(0.95):
            pictures = pack_photographs(scene, photographs, math.inf if split else left, photo_height)
    report_progress("writing", 0.95)
    header = _describe_scene(scene, packed, origin, flights, tour, facts)
    header |= {"doll": [], "photographs": [picture.describe() for picture in pictures]}
    header["plan"] = _describe_plan(plan, floors, tour, origin, flights.level)
    for pose, spot, photograph in zip(scene.cam2world, header["spots"], photographs, strict=False):
        spot["notes"] = [
            {
                "direction": _round(find_direction(pose, note.yaw, note.pitch).numpy()),
                "text": note.text,
                "addresses": note.addresses,
            }
            for note in photograph.context[0].notes
        ]
    for nodes, corners in zip(() if rooms is None else rooms.houses, house.corners, strict=True):
        header["doll"].append({"nodes": nodes, "corners": (corners - [*origin, 0, 0]).round(5).tolist()})
    title = title or path.stem
    files = _write_files(path, header, packed.contents, pictures, poster, house.atlas, split, title, address)
    inside = sum(len(each["nodes"]) for each in header["doll"])
    return dataclasses.replace(files, num_outside=len(scene.cam2world) - inside if has_cameras else 0)


@dataclass(frozen=True, eq=False)
class _Flights:
    """How the camera moves.

    Attributes:
        start: first pose, without roll.
        level: axes of a level camera (columns right, down, forward); yaws are relative to it.
        yaw, pitch: of the start, radians.
        parts: of each view; the camera moves within a part, and the image fades to another one.
        groups: views that are blended together.
        edges: two views and the group that is blended between them; without edges all views are blended.
        next: the next panorama on the way from a panorama (row) to another one (column).
        route: positions, yaws and pitches of the flight through all panoramas, `_ROUTE_RATE` a second; empty without
            edges.
        jumps: samples of the route after which the camera jumps to another part.
        hysteresis: distance by which another edge must be nearer than the current one.
    """

    start: Float[Tensor, "4 4"]
    level: Float[np.ndarray, "3 3"]
    yaw: float
    pitch: float
    parts: tuple[int, ...]
    groups: tuple[tuple[int, ...], ...]
    edges: tuple[tuple[int, int, int], ...] = ()
    next: tuple[tuple[int, ...], ...] = ()
    route: Float[np.ndarray, "time 5"] = field(default_factory=lambda: np.zeros((0, 5)))
    jumps: tuple[int, ...] = ()
    hysteresis: float = 0.0


def _plan_flights(scene: Scene, tour: TourGraph, facts: TourFacts) -> _Flights:
    """The flights of a tour; without edges, the camera flies from view to view.

    Args:
        scene: of `_prepare`.
        tour, facts: of the scene before.
    """
    views = tuple(range(len(scene.cam2world)))
    if not tour.overlaps:
        first, level = tour.find_start_view(0), facts.level
        start = path_poses(scene.cam2world)[0]
        view = None if first is None else find_angles(level.T @ first)
        yaw, pitch = choose_arrival(facts.outlooks[0], 0.0, start=view)
        return _Flights(_look(start, level, yaw, pitch), level, yaw, pitch, (0,) * len(views), (views,))
    scenes = tour.choose_scene_views()
    groups = tuple(dict.fromkeys(scenes.values()))
    walk = tour.plan_walk()
    route = plan_route(tour, [*walk, *tour.find_walk(walk[-1], walk[0])[1:]])  # ends where it begins
    samples, jumps = _resample(route)
    start, (yaw, pitch) = torch.from_numpy(route.pose(0.0)), samples[0, 3:].tolist()
    if tour.find_start_view(walk[0]) is None:
        _, (yaw, pitch) = find_turned(facts.outlooks[walk[0]])
    start[:3, :3] = torch.from_numpy(route.level)
    return _Flights(
        _look(start, route.level, yaw, pitch),
        route.level,
        yaw,
        pitch,
        tour.parts,
        groups,
        tuple((a, b, groups.index(scenes[a, b])) for a, b in tour.overlaps),
        tuple(tuple(row) for row in tour.find_next_nodes()),
        samples,
        jumps,
        EDGE_HYSTERESIS,
    )


def _order_views(scene: Scene, flights: _Flights) -> list[int]:
    """The views of the part where the page starts, then the others; the nearest first."""
    distances = (scene.cam2world[:, :3, 3] - flights.start[:3, 3]).norm(dim=1).numpy()
    parts = np.array(flights.parts)
    return np.lexsort((distances, parts != parts[distances.argmin()])).tolist()


def _look(pose: Float[Tensor, "4 4"], level: Float[np.ndarray, "3 3"], yaw: float, pitch: float) -> Tensor:
    """The pose (4, 4) with the same position that looks in the direction of two angles, relative to `level`."""
    turned = turn_pose(pose, yaw, torch.from_numpy(-level[:, 1]))
    return turn_pose(turned, pitch, -turned[:3, 0])


def _resample(route: Route) -> tuple[Float[np.ndarray, "time 5"], tuple[int, ...]]:
    """Positions, yaws and pitches at `_ROUTE_RATE`, and the samples after which the camera jumps."""
    columns = np.stack([*route.positions.T, route.yaws, route.pitches])
    rate = _ROUTE_RATE * route.seconds / (len(route.yaws) - 1)
    sections = []
    for section in np.split(columns, route.jumps + 1, axis=1):
        steps = np.arange(section.shape[1])
        at = np.linspace(0, steps[-1], max(round(steps[-1] * rate), 1) + 1)
        sections.append(np.stack([np.interp(at, steps, column) for column in section], axis=1))
    ends = np.cumsum([len(section) for section in sections])[:-1] - 1
    return np.concatenate(sections), tuple(ends.tolist())


def _prepare(scene: Scene) -> Scene:
    """The visible Gaussians on the CPU; with a camera in the middle if there is none."""
    gaussians = prune(scene.gaussians.to(device="cpu"), min_opacity=constants.ALPHA_CUT)
    numbers = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities[:, None])
    finite = torch.stack([(value.abs() <= constants.MAX_MAGNITUDE).all(1) for value in numbers]).all(0)
    gaussians = gaussians.select(finite & (gaussians.harmonics.abs() <= constants.MAX_MAGNITUDE).flatten(1).all(1))
    if not len(gaussians):
        raise InputError(
            "the scene has no visible Gaussians, and a page needs at least one; check it with `pansplat info`"
        )
    poses, names = scene.cam2world.double().cpu(), scene.names
    if not len(poses):
        poses, names = torch.eye(4, dtype=torch.float64)[None], ("start",)
        poses[0, :3, 3] = gaussians.means.double().median(0).values
    if scene.joint or len(poses) < 2 or int(gaussians.views.max()) >= len(poses):
        # The Gaussians of all views are drawn together.
        gaussians = dataclasses.replace(gaussians, views=torch.zeros_like(gaussians.views))
    names = tuple(names[k] if k < len(names) else f"panorama {k + 1}" for k in range(len(poses)))
    return dataclasses.replace(scene, gaussians=gaussians, cam2world=poses, names=names)


def _share_gaussians(
    flights: _Flights, poor: Sequence[Edge], gaussians: int, heights: Sequence[int]
) -> dict[int, float]:
    """The share of an equal number of Gaussians that the panoramas of each part keep in one file.

    It is all if photographs of their full height fit beside them. Else it is less: they are seen in motion only.

    Args:
        poor: edges along which no camera flies.
        gaussians: of the page.
        heights: of the photographs in the file.
    """
    left = _TARGET_BYTES - _PROGRAM_BYTES - _GAUSSIAN_BYTES * gaussians
    if _PHOTO_BYTES * sum(height**2 for height in heights) <= left or not heights:
        return dict.fromkeys(flights.parts, 1.0)
    flown = {flights.parts[a] for a, b, _ in flights.edges if a != b and (a, b) not in poor}
    return {part: _FLOWN_SHARE if part in flown or not flights.edges else _STILL_SHARE for part in flights.parts}


def _merge(
    scene: Scene, parts: Sequence[int], count: int, steps: int = _FIT_STEPS, shares: Mapping[int, float] | None = None
) -> Scene:
    """At most `count` Gaussians, an equal number for each panorama of different parts.

    Args:
        scene: of `_prepare`.
        parts: of each view; they are merged one after the other.
        steps: of the fit of shapes; 0 fits colours only.
        shares: of the equal number that a part keeps; by default all.
    """
    merged = []
    for part in dict.fromkeys(parts):
        views = tuple(view for view, other in enumerate(parts) if other == part)
        chosen = select_views(scene, views)
        kept = max(int(count * len(views) * (1.0 if shares is None else shares[part])) // len(parts), 1)
        if len(chosen.gaussians) > kept:
            chosen = _merge_part(chosen, kept, steps)
        labels = torch.tensor(views)[chosen.gaussians.views.long()]
        merged.append(dataclasses.replace(chosen.gaussians, views=labels))
    return dataclasses.replace(scene, gaussians=Gaussians.cat(merged))


@torch.no_grad()
def _draw_inputs(scene: Scene) -> Views:
    """Images of the scene at its input cameras, at twice its rows: those of the scene do not show the gaps between
    merged Gaussians."""
    height = min(2 * scene.height, DISPLAY_HEIGHT)
    owners = scene.gaussians.views.unique().tolist()
    images = [
        pipeline.render(scene, pose, blend=view if view in owners else "joint", size=(height, 2 * height)).color
        for view, pose in enumerate(scene.cam2world)
    ]
    masks = torch.ones(len(images), height, 2 * height, dtype=torch.bool)
    return Views(torch.stack(images), scene.cam2world, masks, scene.near, scene.far, scene.names)


def _merge_part(scene: Scene, count: int, steps: int) -> Scene:
    """At most `count` Gaussians, fitted to the images of all at the input cameras."""
    views = _draw_inputs(scene)
    refinement = Refinement(scene, views, RefineConfig(gaussians=count, splits=()))
    for step in range(steps):
        refinement.step(step / steps)
    merged = refinement.scene()
    fitted = fit_colors(merged.gaussians, views.images, views.cam2world, views.masks)
    return dataclasses.replace(merged, gaussians=fitted)


def _choose_degree(scene: Scene, num_bytes: float) -> int:
    """The highest degree of harmonics with which the data of a page is small enough even if nothing is compressed."""
    count = len(scene.gaussians)
    degrees = range(min(scene.gaussians.degree, MAX_DEGREE), 0, -1)
    return next((degree for degree in degrees if count_bytes(count, degree) * 4 / 3 <= num_bytes), 0)


def _draw_poster(scene: Scene, pose: Float[Tensor, "4 4"], photographs: Sequence[Pair]) -> bytes:
    """A JPEG of the first view of the page; at a panorama it shows the photograph, if there is one."""
    fov = math.degrees(2 * math.atan(_TALLEST * math.tan(math.radians(_START_FOV / 2))))

    def draw() -> Float[np.ndarray, "height width 3"]:
        options = {"size": _POSTER_SIZE, "layout": "pinhole", "vertical_fov_degrees": fov}
        return pipeline.render(scene, pose, **options).color.clamp(0, 1).permute(1, 2, 0).numpy()

    (plane,) = image_planes("pinhole", _POSTER_SIZE, vertical_fov_degrees=fov)
    with torch.no_grad():
        image = FilmPhotographs(photographs, scene.cam2world).mix([(pose.numpy(), 1.0, draw)], plane, 0.0)
    pixels = (image * 255).round().clip(0, 255).astype(np.uint8)
    with io.BytesIO() as file:
        Image.fromarray(pixels).save(file, "JPEG", quality=80, optimize=True, comment=SOFTWARE.encode())
        return file.getvalue()


def _describe_scene(
    scene: Scene,
    packed: PackedGaussians,
    origin: Float[np.ndarray, "3"],
    flights: _Flights,
    tour: TourGraph,
    facts: TourFacts,
) -> dict[str, Any]:
    """The numbers of a page, without those of single Gaussians; a part of `PageHeader`."""
    level = flights.level
    positions = scene.cam2world[:, :3, 3].numpy() - origin
    heights = facts.usual_heights
    starts = [tour.find_start_view(node) for node in range(len(tour))] or [None]
    marks = positions + np.outer(heights, level[:, 1])
    spots = [
        {
            "name": name,
            "position": _round(position),
            "mark": _round(mark),
            "notes": [],
            **_describe_outlook(facts, view, start),
            "radius": round(0.12 * height, 6),
        }
        for view, (name, position, mark, height, start) in enumerate(
            zip(scene.names, positions, marks, heights, starts, strict=True)
        )
    ]
    reaches = _measure_reaches(scene, np.array(flights.parts))
    views_of_page = [
        {"position": _round(position), "start": start, "count": count}
        for position, start, count in zip(positions, packed.starts, packed.counts, strict=True)
    ]
    return {
        "count": len(scene.gaussians),
        "degree": packed.degree,
        "colorRange": packed.color_range,
        "harmonicsScale": packed.harmonics_scale,
        "views": views_of_page,
        "loading": packed.order,
        "spots": spots,
        "links": _describe_links(link_parts(tour), spots, heights, facts.outlooks) if flights.edges else [],
        "level": [_round(row) for row in level],
        "start": {
            "position": _round(flights.start[:3, 3].numpy() - origin),
            "yaw": round(flights.yaw, 5),
            "pitch": round(flights.pitch, 5),
            "fov": _START_FOV,
        },
        "parts": flights.parts,
        "groups": flights.groups,
        "edges": flights.edges,
        "hysteresis": flights.hysteresis,
        "reach": REACH,
        "next": flights.next,
        "poor": tour.poor,
        "routeRate": _ROUTE_RATE,
        "route": (flights.route - [*origin, 0.0, 0.0]).round(4).tolist(),
        "jumps": flights.jumps,
        "batch": _BATCH,
        "near": constants.NEAR,
        "unit": 1 / scene.frame.unit,
        "tallest": _TALLEST,
        "filterVariance": constants.FILTER_VARIANCE,
        "speed": _SPEED * float(np.median(reaches)),
        "limits": _limit_parts(reaches, positions, flights, len(tour)),
    }


def _describe_outlook(facts: TourFacts, view: int, start: Float[np.ndarray, "3"] | None) -> dict[str, Any]:
    """The rule of `choose_arrival` at a view, as the bits of the directions from which a camera turns, and yaw and
    pitch to which it does; and the panoramas whose marks furniture or walls hide.

    Args:
        start: direction of the start view.
    """
    angles = None if start is None else find_angles(facts.level.T @ start)
    is_turned, ahead = find_turned(facts.outlooks[view], angles)
    turned = sum(1 << number for number in np.flatnonzero(is_turned).tolist())
    clearances = facts.clearances[view].round(2).tolist()
    return {"turned": turned, "ahead": _round(np.array(ahead)), "hidden": facts.hidden[view], "clearances": clearances}


def _outline_floors(facts: TourFacts, rooms: Sequence[Room]) -> list[Room]:
    """Rooms around the panoramas that stand in none of the floor plan: where their floor ends, else a circle."""
    floors: list[Room] = []
    tour, storeys = facts.tour, assign_storeys(facts.tour)
    for node, center in enumerate(tour.positions @ tour.level_axes[:, (0, 2)]):
        point = Point(center)
        if not any(room.storey == storeys[node] and Polygon(room.outline).contains(point) for room in rooms):
            found = facts.outlines.get(node)
            shape = point.buffer(_UNKNOWN_FLOOR) if found is None else Polygon(found.corners)
            outline = np.array(shape.simplify(_ROUGH_OUTLINE).exterior.coords)[:-1]
            name = tour.panoramas[node].title or tour.panoramas[node].name
            floors.append(Room(name, (node,), outline, storeys[node], tour.is_placed(node)))
    return floors


def _describe_plan(
    plan: Plan | None,
    floors: Sequence[Room],
    tour: TourGraph,
    origin: Float[np.ndarray, "3"],
    level: Float[np.ndarray, "3 3"],
) -> dict[str, Any]:
    """The floor plan: outlines and names of rooms and the doors, to the right and forward of the origin, and the world
    of each panorama; panoramas of other worlds are elsewhere.

    Args:
        floors: of `_outline_floors`.
    """
    worlds = tour.worlds or (0,)
    known = [] if plan is None else [*plan.rooms]
    if not known and not floors:
        return {"worlds": worlds, "drawn": [], "turns": [0.0] * (max(worlds) + 1), "rooms": [], "doors": []}
    turn, middle = tour.level_axes[:, (0, 2)].T @ level[:, (0, 2)], origin @ level[:, (0, 2)]
    turned = [dataclasses.replace(room, outline=room.outline @ turn) for room in (*known, *floors)]
    turns = Plan(tour, tuple(turned), (), math.nan, None, None, 0, 0).turns
    rooms = []
    for number, room in enumerate(turned):
        circle = shapely.maximum_inscribed_circle(Polygon(room.outline))
        label = [*_round(np.array(circle.coords[0]) - middle), round(2 * circle.length, 4)]
        outline = [_round(corner) for corner in room.outline - middle]
        rooms.append(
            {
                "name": room.name,
                "nodes": room.panoramas,
                "outline": outline,
                "label": label,
                "hasWalls": number < len(known),
            }
        )
    doors = [] if plan is None else plan.doors
    doors = [{"room": door.rooms[0], "ends": [_round(end) for end in door.ends @ turn - middle]} for door in doors]
    found = [tour.approximate.get(node) for node in range(len(tour))]
    drawn = [each and (each.beside, *_round(each.place @ turn - middle), round(each.turn, 5)) for each in found]
    return {"worlds": worlds, "drawn": drawn, "turns": _round(np.array(turns)), "rooms": rooms, "doors": doors}


def _describe_links(
    tour: TourGraph,
    spots: Sequence[dict[str, Any]],
    heights: Sequence[float],
    outlooks: Sequence[Float[np.ndarray, "bin"]],
) -> list[dict[str, Any]]:
    """The links of a page. Those to other parts, and those to panoramas whose marks are hidden, have a ring on the
    floor; the first ones a place where the fade begins.

    Args:
        tour: of the scene.
        spots: the descriptions of the panoramas.
        heights: of the cameras over the floor.
        outlooks: of the panoramas (`measure_outlook`).
    """
    links = []
    for (start, end), link in tour.links.items():
        found: dict[str, Any] = {"from": start, "to": end, "text": link.text}
        position, is_elsewhere = np.array(spots[start]["position"]), tour.parts[start] != tour.parts[end]
        way = find_way_along_link(tour, start, end)
        if way is not None:
            ring = find_link_ring(tour, start, end, heights[start], outlooks[start])
            assert ring is not None
            if is_elsewhere or end in spots[start]["hidden"]:
                found["mark"] = _round(position + ring)
            if is_elsewhere:
                found["leave"] = _round(position + way)
                found["yaw"] = round(find_angles(tour.level_axes.T @ way / np.linalg.norm(way))[0], 5)
        links.append(found)
    return links


def _measure_reaches(scene: Scene, parts: Int[np.ndarray, "view"]) -> Float[np.ndarray, "part"]:
    """Median distance of the Gaussians of each part from their cameras."""
    views = scene.gaussians.views.long()
    distances = (scene.gaussians.means.double() - scene.cam2world[views, :3, 3]).norm(dim=1).numpy()
    reaches = np.full(parts.max() + 1, 1e-3)
    for part in range(len(reaches)):
        own = distances[parts[views] == part]
        if len(own):
            reaches[part] = max(float(np.median(own)), 1e-3)
    return reaches


def _limit_parts(
    reaches: Float[np.ndarray, "part"], positions: Float[np.ndarray, "view 3"], flights: _Flights, num_panoramas: int
) -> list[float]:
    """How far the camera may move in each part from its edges; without edges, from the nearest panorama."""
    parts = list(flights.parts)
    if not flights.edges:
        if num_panoramas == 1:
            return [min(_SINGLE_REACH, 0.5 * float(reaches[0]))]
        distances = scipy.spatial.distance.cdist(positions, positions)
        longest_step = float(scipy.sparse.csgraph.minimum_spanning_tree(distances).toarray().max(initial=0.0))
        return [max(float(reaches[0]), 0.75 * longest_step)]
    most = REACH if len(reaches) > 1 else math.inf
    return [
        min(_SINGLE_REACH, 0.5 * reach) if parts.count(part) == 1 else min(reach, most)
        for part, reach in enumerate(reaches.tolist())
    ]


def _round(vector: np.ndarray) -> list[float]:
    return [float(value) for value in np.float32(vector)]


def _write_files(
    path: Path,
    header: dict[str, Any],
    contents: Sequence[bytes],
    pictures: Sequence[PackedPhotograph],
    poster: bytes,
    atlas: bytes,
    split: bool,
    title: str,
    address: str | None,
) -> PageFiles:
    """Write the page, and its parts if it is split.

    Args:
        contents: of the Gaussians of each view.
        atlas: of the doll's house.
    """
    count, names = header["count"], [spot["name"] for spot in header["spots"]]
    labels = label_files(names)
    parts: dict[str, bytes] = {}
    tags: dict[int, list[str]] = {}  # by view
    for view, content in enumerate(contents):
        ends = [len(content)] if split else [*range(_PART_BYTES, len(content), _PART_BYTES), len(content)]
        chunks = [content[start:end] for start, end in pairwise((0, *ends))]
        named = {_name_part(labels[view], chunk, "bin"): chunk for chunk in chunks}
        header["views"][view]["files"] = [*named]
        parts |= named
        calls = [f"addPart({view}, {'true' if chunk is chunks[-1] else 'false'})" for chunk in chunks]
        tags[view] = [
            f'<script type="text/plain">{base64.b64encode(chunk).decode()}</script><script>{call}</script>'
            for call, chunk in zip(calls, chunks, strict=True)
        ]
    folder = path.with_name(f"{path.stem}_files")
    folder_address = quote(os.fsencode(folder.name)) if split else None
    elements: list[str] = []
    texts = {"og:title": title, "og:description": f"{describe_count(len(names), 'panorama')}: {list_first(names)}"}
    if split:
        preview = _name_part("preview", poster, "jpg")
        parts[preview] = poster
        base = address if not address or address.endswith((".html", "/")) else f"{address}/"
        texts["og:image"] = urljoin(base or "", f"{folder_address}/{preview}")
        for picture in pictures:
            parts |= picture.make_files()
    else:
        parts = {}
        first, *others = header["loading"]
        shown = [picture.make_elements() for picture in pictures] or [[] for _ in tags]
        # The smallest photograph of the first panorama, its Gaussians, and then its photograph.
        elements = [*shown[first][:1], *tags[first], *shown[first][1:]]
        for kind in (tags, shown):
            elements += [element for view in others for element in kind[view]]
    if atlas:
        elements.append(
            f'<img id="atlas" alt="" hidden src="data:image/webp;base64,{base64.b64encode(atlas).decode()}">'
        )
    page = _fill_template(
        connections="'self'" if split else "'none'",
        title=html.escape(title),
        description=html.escape(texts["og:description"]),
        properties="\n".join(f'<meta property="{name}" content="{html.escape(text)}">' for name, text in texts.items()),
        style=_read("page.css"),
        poster=base64.b64encode(poster).decode(),
        header=_to_script(msgspec.to_builtins(msgspec.convert(header | {"folder": folder_address}, PageHeader))),
        shaders=_to_script({name: [_load_shader(stage) for stage in stages] for name, stages in _SHADERS.items()}),
        worker=_to_script("".join(map(_read, _WORKER))),
        programs=_bundle_programs(),
        parts="\n".join(elements),
    ).encode(errors="replace")  # a title from a file name that is not UTF-8
    if len(page) > MAX_FILE_BYTES and not split:
        fitting = math.floor(0.95 * count * MAX_FILE_BYTES / len(page))
        raise InputError(
            f"{path}: needed a page of at most {MAX_FILE_BYTES // 1_000_000} MB in one file, got "
            f"{len(page) / 1e6:.0f} MB; write a folder (--out without a suffix), or keep at most {fitting:,} "
            "Gaussians (--gaussians)"
        )
    files = [folder / name for name in parts]
    if split:
        _make_folder(folder)
    with replacing(path) as temporary_page:  # the page appears last; with it, other exports see which parts it needs
        temporary_page.write_bytes(page)
        for file, part in zip(files, parts.values(), strict=True):
            with replacing(file) as temporary:
                temporary.write_bytes(part)
    _remove_old_parts(folder)
    files.insert(0, path)
    total = len(page) + sum(map(len, parts.values()))
    photo_height = max((picture.height for picture in pictures), default=0)
    fades = tuple((names[a], names[b]) for a, b in header["poor"])
    num_flights = sum(a != b for a, b, _ in header["edges"]) - len(fades)
    return PageFiles(tuple(files), total, count, photo_height, num_flights, fades)


def _name_part(label: str, content: bytes, suffix: str) -> str:
    return f"{label}_{hashlib.blake2b(content, digest_size=8).hexdigest()}.{suffix}"


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"cannot write {folder}: needed a folder for the parts of the page, got '{reason}'; choose another name"
        ) from error


def _remove_old_parts(folder: Path) -> None:
    """Remove the parts that no page beside the folder needs, by their names and content, and the folder if that empties
    it. A page of another export that is being written has a temporary name there (`replacing`)."""
    name = re.compile(r"(?:\w[\w-]*_)?([0-9a-f]{16})(_\d+)?\.(js|bin|jpg)")
    found = [(file, part[1]) for file in folder.glob("*") if (part := name.fullmatch(file.name)) and is_written(file)]
    needed, address = set(), f'"folder": {_to_script(quote(os.fsencode(folder.name)))}'.encode()
    for page in folder.parent.glob("*.htm*") if found else ():
        with suppress(IsADirectoryError):
            content = page.read_bytes()
            needed |= {
                digits.decode() for digits in re.findall(rb"[0-9a-f]{16}", content if address in content else b"")
            }
    old = [file for file, digits in found if digits not in needed]
    for file in old:
        with suppress(OSError):
            file.unlink()
    if old:
        with suppress(OSError):
            folder.rmdir()


def _bundle_programs() -> str:
    """The modules of the page as scripts: a page from disk cannot import files.

    Modules follow those that they import, as in a browser. All share one scope, so their names differ.
    """
    texts: dict[str, str] = {}

    def add(name: str) -> None:
        text = _read(name)
        for other in _IMPORT.findall(text):
            if other not in texts:
                add(other)
        texts[name] = _EXPORT.sub("", _IMPORT.sub("", text))

    add("page.js")
    libraries = "\n".join(f'<script>\n"use strict";\n{texts.pop(name)}</script>' for name in _LIBRARIES)
    return f'{libraries}\n<script>\n(() => {{\n"use strict";\n{"".join(texts.values())}}})();\n</script>'


def _fill_template(**values: str) -> str:
    """page.html with its names in double braces replaced."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], _read("page.html"))


def _to_script(value: Any) -> str:
    """JSON that may stand in a <script> element."""
    return json.dumps(value).replace("<", "\\u003c")


def _read(name: str) -> str:
    return (resources.files("pansplat.web") / name).read_text("utf-8")


def _load_shader(name: str) -> str:
    return load_shader(name, "300 es", LAYER_STORAGE=0, BATCH=_BATCH)
