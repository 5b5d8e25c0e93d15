"""Writing of a page: the reduced scene, the data of its panoramas, a poster and the program in one HTML file."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import html
import io
import ipaddress
import json
import math
import os
import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
import numpy as np
import scipy
import shapely
import torch
from jaxtyping import Float, Int
from PIL import Image
from shapely.geometry import Polygon
from torch import Tensor

from pansplat import constants, pipeline
from pansplat.errors import InputError, InputWarning
from pansplat.export.film import FilmPhotographs
from pansplat.export.page_data import MAX_DEGREE, PackedGaussians, PageHeader, count_bytes, pack_gaussians
from pansplat.export.photographs import PackedPhotograph, pack_photographs
from pansplat.gaussians.scene import Gaussians, Scene, prune
from pansplat.geometry.path import find_direction, path_poses, turn_pose
from pansplat.inputs.pairs import Pair
from pansplat.inputs.views import Views
from pansplat.predictor import Progress
from pansplat.refinement import DISPLAY_HEIGHT, RefineConfig, Refinement
from pansplat.rendering.color_fit import ColorFitConfig, fit_colors
from pansplat.rendering.image_planes import image_planes
from pansplat.shaders import load_shader
from pansplat.system.atomic import replacing
from pansplat.system.console import with_progress_bar
from pansplat.system.files import SOFTWARE, is_written
from pansplat.tours.doll_house import Rooms, find_rooms, measure_box
from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import choose_camera_height
from pansplat.tours.graph import EDGE_HYSTERESIS, TourGraph, select_views
from pansplat.tours.layout import REACH
from pansplat.tours.links import find_link_ring, find_way_along_link, link_parts
from pansplat.tours.outlook import choose_heading, find_blank, is_hidden
from pansplat.tours.plan import Plan
from pansplat.tours.route import Route, find_angles, plan_route
from pansplat.tours.surfaces import locate_surfaces

DEFAULT_GAUSSIANS = 600_000  # pages of about 13 MB
PHOTO_GAUSSIANS = 450_000  # the same of a page with photographs, about 10 MB
MAX_GAUSSIANS = 4_000_000  # fit textures of 2048 texels a side, which every device has
MAX_FILE_BYTES = 64_000_000  # of a page in one file
_TARGET_BYTES = 15_000_000  # harmonics of higher degree are left out of larger pages, and photographs are smaller
_GAUSSIANS_SHARE = 2 / 3  # of it, beside photographs
_PROGRAM_BYTES = 200_000  # of a page without its data
_PART_BYTES = 1_500_000  # of the data between two steps of the progress bar; divisible by 3
_FIT_STEPS = 8  # of merged Gaussians to the images of all Gaussians
_START_FOV = 75.0  # degrees, vertical, of a landscape image
_TALLEST = 1.5  # height of a portrait image relative to it; the poster has this height
_POSTER_SIZE = (810, 960)  # height and width, pixels
_ROUTE_RATE = 10  # samples of a flight a second
_SPEED = 0.3  # walking, fraction of the reach a second
_SINGLE_REACH = 1.0  # metres from a panorama without others in its part, at most half the distance of its surfaces
_BATCH = 256  # quads that are drawn together
_MAX_CAMERAS = 1024  # of a doll's house; their number has 10 bits (page.vert)
_SHADERS = {"splat": ("page.vert", "splat.frag"), "accumulate": ("screen.vert", "accumulate.frag")}
_SHADERS |= {"resolve": ("screen.vert", "resolve.frag"), "mark": ("mark.vert", "mark.frag")}
_SHADERS |= {"photograph": ("screen.vert", "photograph.frag")}

_ORIGIN = re.compile(r"(https?)://([a-z0-9_-]+(?:\.[a-z0-9_-]+)*)(?::([0-9]{1,5}))?/?")
_DEFAULT_PORTS = {"http": 80, "https": 443}

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
        degree: of its harmonics.
        embed: origins of the pages that may frame it and exchange messages with it.
        photo_height: of its photographs, pixels; 0 without photographs.
        num_flights: number of edges along which it flies.
        fades: labels of the two panoramas of each edge along which it fades.
        num_rough: panoramas without doll's house and distances, because their surfaces are too rough.
    """

    files: tuple[Path, ...]
    num_bytes: int
    num_gaussians: int
    degree: int
    embed: tuple[str, ...] = ()
    photo_height: int = 0
    num_flights: int = 0
    fades: tuple[tuple[str, str], ...] = ()
    num_rough: int = 0


@with_progress_bar
def write_page(
    scene: Scene,
    path: Path | str,
    *,
    gaussians: int = DEFAULT_GAUSSIANS,
    split: bool = False,
    title: str | None = None,
    embed: Sequence[str] = (),
    photographs: Sequence[Pair] = (),
    photo_height: int | None = None,
    progress: Progress | None = None,
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
        embed: origins of host pages that move the camera by messages (docs/web.md, Embedding).
        photographs: of each view, which the page shows there (`list_photographs`), with the notes of its
            tour; none without them.
        photo_height: their largest height, pixels, 0 for none; by default what fits, if it is split that of the files.
        progress: called with a description of the current work and the completed fraction.
    """
    path, embed = Path(path), parse_origins(embed)
    report: Progress = progress or (lambda what, fraction: None)
    if not 1 <= gaussians <= MAX_GAUSSIANS:
        raise InputError(f"`gaussians` must be 1 to {MAX_GAUSSIANS:,} in a page, got {gaussians:,}")
    report("checking the scene", 0.0)
    if scene.joint and scene.overlaps:
        warnings.warn(
            "a page follows the edges of a tour with all Gaussians of each panorama, got each surface once; its "
            "flights are straight. Export the folder of the photographs, or a scene file of --layers.",
            InputWarning,
            stacklevel=2,
        )
        scene = dataclasses.replace(scene, overlaps=(), links=(), starts=())
    has_cameras, prepared = len(scene.cam2world) > 0, _prepare(scene)
    facts = TourFacts(
        scene if has_cameras else prepared,
        folder=photographs[0].folder if photographs else None,
        level=None if scene.overlaps else path_poses(prepared.cam2world)[0, :3, :3].numpy(),
    )
    tour = dataclasses.replace(facts.tour, poor=facts.poor)
    rooms = find_rooms(facts) if 0 < len(scene.cam2world) <= _MAX_CAMERAS else None
    if rooms is not None and not rooms.plan.num_heights:
        rooms = None  # without a floor the doll's house is a heap
    scene = prepared
    flights = _plan_flights(scene, tour, facts)
    if len(scene.gaussians) > gaussians:
        report("merging Gaussians", 0.1)
        scene = _merge(scene, flights.parts, gaussians, steps=_FIT_STEPS if has_cameras else 0)
    report("compressing", 0.6)
    has_pictures = len(photographs) > 0 and photo_height != 0
    degree = _choose_degree(scene, _TARGET_BYTES * (_GAUSSIANS_SHARE if has_pictures and not split else 1))
    origin = scene.cam2world[:, :3, 3].mean(0).numpy()
    cameras = None if rooms is None else _find_cameras(scene, rooms)
    packed = pack_gaussians(scene.gaussians, origin, _order_views(scene, flights), degree, cameras)
    report("drawing the poster", 0.7)
    poster = _draw_poster(scene, flights.start, photographs if has_pictures else ())
    pictures: list[PackedPhotograph] = []
    if has_pictures:
        left = 0.75 * (_TARGET_BYTES - _PROGRAM_BYTES) - sum(map(len, packed.contents)) - len(poster)
        pictures = pack_photographs(
            scene,
            photographs,
            math.inf if split else left,
            photo_height,
            lambda what, fraction: report(what, 0.75 + 0.2 * fraction),
        )
    report("writing", 0.95)
    header = _describe_scene(scene, packed, origin, flights, tour, facts)
    header |= {"embed": embed, "doll": None, "photographs": [picture.describe() for picture in pictures]}
    header["rough"] = [] if rooms is None else [view for view, clear in enumerate(rooms.is_clear) if not clear]
    header["plan"] = _describe_plan(None if rooms is None else rooms.plan, tour, origin, flights.level)
    for pose, spot, photograph in zip(scene.cam2world, header["spots"], photographs, strict=False):
        spot["notes"] = [
            {
                "direction": _round(find_direction(pose, note.yaw, note.pitch).numpy()),
                "text": note.text,
                "addresses": note.addresses,
            }
            for note in photograph.context[0].notes
        ]
    if rooms is not None and cameras is not None:
        header["doll"] = _describe_rooms(scene, packed, cameras, rooms.storeys, origin, flights.level)
    files = _write_files(path, header, packed.contents, pictures, poster, split, title or path.stem)
    return dataclasses.replace(files, num_rough=len(header["rough"]))


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
        if first is None:
            yaw, pitch = choose_heading(facts.outlooks[0], 0.0), 0.0
        else:
            yaw, pitch = find_angles(level.T @ first)
        return _Flights(_look(start, level, yaw, pitch), level, yaw, pitch, (0,) * len(views), (views,))
    scenes = tour.choose_scene_views()
    groups = tuple(dict.fromkeys(scenes.values()))
    walk = tour.plan_walk()
    route = plan_route(tour, [*walk, *tour.find_walk(walk[-1], walk[0])[1:]])  # ends where it begins
    samples, jumps = _resample(route)
    start, (yaw, pitch) = torch.from_numpy(route.pose(0.0)), samples[0, 3:].tolist()
    if tour.find_start_view(walk[0]) is None:
        _, yaw = find_blank(facts.outlooks[walk[0]])
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


def _merge(scene: Scene, parts: Sequence[int], count: int, steps: int = _FIT_STEPS) -> Scene:
    """At most `count` Gaussians, an equal number for each panorama of different parts.

    Args:
        scene: of `_prepare`.
        parts: of each view; they are merged one after the other.
        steps: of the fit of shapes; 0 fits colours only.
    """
    merged = []
    for part in dict.fromkeys(parts):
        views = tuple(view for view, other in enumerate(parts) if other == part)
        chosen = select_views(scene, views)
        kept = max(count * len(views) // len(parts), 1)
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
    fitted = fit_colors(merged.gaussians, views.images, views.cam2world, views.masks, ColorFitConfig())
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
        Image.fromarray(pixels).save(file, "JPEG", quality=80, optimize=True)
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
    usual_height = choose_camera_height(facts.heights, scene.far)
    heights = [height or usual_height for height in facts.heights]
    starts = [tour.find_start_view(node) for node in range(len(tour))] or [None]
    marks = positions + np.outer(heights, level[:, 1])
    spots = [
        {
            "name": name,
            "position": _round(position),
            "mark": _round(mark),
            "notes": [],
            **_describe_outlook(facts, view, (marks - position) @ level),
            "radius": round(0.12 * height, 6),
            **({} if start is None else {"start": _round(np.array(find_angles(level.T @ start)))}),
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
        "links": _describe_links(link_parts(tour), positions, heights, level) if flights.edges else [],
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
        "filterVariance": constants.FILTER_VARIANCE["angular"],
        "speed": _SPEED * float(np.median(reaches)),
        "limits": _limit_parts(reaches, positions, flights, len(tour)),
    }


def _describe_outlook(facts: TourFacts, view: int, marks: Float[np.ndarray, "node 3"]) -> dict[str, Any]:
    """Where a camera at a view faces a wall (bits of the directions of `measure_outlook`), and the yaw of the widest
    view; and the panoramas whose marks furniture or walls hide.

    Args:
        marks: of all panoramas on the floor, relative to the camera.
    """
    is_blank, widest = find_blank(facts.outlooks[view])
    places = locate_surfaces(facts.scene, view, facts.level, min_opacity=0.5)
    hidden = [node for node, mark in enumerate(marks) if node != view and is_hidden(places, mark)]
    blank = sum(1 << number for number in np.flatnonzero(is_blank).tolist())
    return {"blank": blank, "ahead": round(widest, 3), "hidden": hidden}


def _describe_plan(
    plan: Plan | None, tour: TourGraph, origin: Float[np.ndarray, "3"], level: Float[np.ndarray, "3 3"]
) -> dict[str, Any]:
    """The floor plan: outlines and names of rooms and the doors, to the right and forward of the origin, and the world
    of each panorama; panoramas of other worlds are elsewhere."""
    worlds = tour.worlds or (0,)
    if plan is None or not plan.rooms:
        return {"worlds": worlds, "turns": [0.0] * (max(worlds) + 1), "rooms": [], "doors": []}
    turn, middle = tour.level_axes[:, (0, 2)].T @ level[:, (0, 2)], origin @ level[:, (0, 2)]
    turned = [dataclasses.replace(room, outline=room.outline @ turn) for room in plan.rooms]
    plan, rooms = dataclasses.replace(plan, rooms=tuple(turned)), []
    for room in plan.rooms:
        circle = shapely.maximum_inscribed_circle(Polygon(room.outline))
        label = [*_round(np.array(circle.coords[0]) - middle), round(2 * circle.length, 4)]
        outline = [_round(corner) for corner in room.outline - middle]
        rooms.append({"name": room.name, "nodes": room.panoramas, "outline": outline, "label": label})
    doors = [{"room": door.rooms[0], "ends": [_round(end) for end in door.ends @ turn - middle]} for door in plan.doors]
    return {"worlds": worlds, "turns": _round(np.array(plan.turns)), "rooms": rooms, "doors": doors}


def _find_cameras(scene: Scene, rooms: Rooms) -> Int[np.ndarray, "n"]:
    """The camera that saw each Gaussian in a room, -1 for those outside and on storeys that are not clear.

    In a joint scene, which has no labels, it is the nearest camera.

    Args:
        scene: of `_prepare`.
        rooms: in its unit.
    """
    gaussians = scene.gaussians
    cameras = gaussians.views.long()
    if len(scene.cam2world) > 1 and not cameras.any():
        cameras = torch.cdist(gaussians.means.double(), scene.cam2world[:, :3, 3]).argmin(dim=1)
    inside = rooms.find_inside(dataclasses.replace(gaussians, views=cameras)) & torch.tensor(rooms.is_clear)[cameras]
    return torch.where(inside, cameras, -1).numpy()


def _describe_rooms(
    scene: Scene,
    packed: PackedGaussians,
    cameras: Int[np.ndarray, "n"],
    storeys: tuple[int, ...],
    origin: Float[np.ndarray, "3"],
    level: Float[np.ndarray, "3 3"],
) -> dict[str, Any] | None:
    """The doll's house: ranges of its Gaussians, and the storeys and boxes of the views; None without Gaussians."""
    boxes: list[list[list[float]] | None] = [None] * len(scene.cam2world)
    for camera in np.unique(cameras[cameras >= 0]).tolist():
        means = scene.gaussians.means[torch.from_numpy(cameras == camera)].double() - torch.from_numpy(origin)
        boxes[camera] = [_round(corner) for corner in measure_box(means, level)]
    return {"ranges": packed.rooms, "storeys": storeys, "boxes": boxes} if any(boxes) else None


def _describe_links(
    tour: TourGraph,
    positions: Float[np.ndarray, "node 3"],
    heights: list[float],
    level: Float[np.ndarray, "3 3"],
) -> list[dict[str, Any]]:
    """The links of a page; those to other parts have a ring on the floor, and a place where the fade begins.

    Args:
        tour: of the scene.
        positions: of the cameras, relative to the page's origin.
        heights: of the cameras over the floor.
        level: axes of a level camera.
    """
    links = []
    for (start, end), link in tour.links.items():
        found: dict[str, Any] = {"from": start, "to": end, "text": link.text}
        way = find_way_along_link(tour, start, end)
        ring = find_link_ring(tour, start, end, heights[start])
        if way is not None and ring is not None and tour.parts[start] != tour.parts[end]:
            found["mark"] = _round(positions[start] + ring)
            found["leave"] = _round(positions[start] + way)
            found["yaw"] = round(find_angles(level.T @ way / np.linalg.norm(way))[0], 5)
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
    split: bool,
    title: str,
) -> PageFiles:
    """Write the page, and its parts if it is split.

    Args:
        contents: of the Gaussians of each view.
    """
    count, scripts = header["count"], {}
    tags: dict[int, list[str]] = {}  # by view
    for view, content in enumerate(contents):
        ends = [*range(_PART_BYTES, len(content), _PART_BYTES), len(content)]
        parts = [base64.b64encode(content[k:end]).decode() for k, end in pairwise((0, *ends))]
        calls = [f"addPart({view}, {'true' if part is parts[-1] else 'false'}" for part in parts]
        texts = [f'{call}, "{part}"); // {SOFTWARE}\n' for call, part in zip(calls, parts, strict=True)]
        named = {f"{hashlib.blake2b(text.encode(), digest_size=8).hexdigest()}.js": text for text in texts}
        header["views"][view]["files"] = [*named]
        scripts |= named if split else {}
        tags[view] = [
            f'<script type="text/plain">{part}</script><script>{call})</script>'
            for call, part in zip(calls, parts, strict=True)
        ]
    folder = path.with_name(f"{path.stem}_files")
    folder_address = quote(os.fsencode(folder.name)) if split else None
    elements: list[str] = []
    if split:
        for picture in pictures:
            scripts |= picture.make_scripts()
    else:
        first, *others = header["loading"]
        shown = [picture.make_elements() for picture in pictures] or [[] for _ in tags]
        # The smallest photograph of the first panorama, its Gaussians, and then its photograph.
        elements = [*shown[first][:1], *tags[first], *shown[first][1:]]
        for part in (tags, shown):
            elements += [element for view in others for element in part[view]]
    page = _fill_template(
        script_sources="'self' file: blob:" if split else "blob:",
        title=html.escape(title),
        style=_read("page.css"),
        poster=base64.b64encode(poster).decode(),
        count=f"{count:,}",
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
            f"{len(page) / 1e6:.0f} MB; split it (--split), or keep at most {fitting:,} Gaussians (--gaussians)"
        )
    files = [folder / name for name in scripts]
    if split:
        _make_folder(folder)
    for file, text in zip(files, scripts.values(), strict=True):
        with replacing(file) as temporary:
            temporary.write_text(text, "utf-8")
    with replacing(path) as temporary:
        temporary.write_bytes(page)
    _remove_old_parts(folder, set(scripts) if split else set())
    files.insert(0, path)
    total = len(page) + sum(map(len, scripts.values()))
    photo_height = max((picture.height for picture in pictures), default=0)
    names = [spot["name"] for spot in header["spots"]]
    fades = tuple((names[a], names[b]) for a, b in header["poor"])
    num_flights = sum(a != b for a, b, _ in header["edges"]) - len(fades)
    return PageFiles(tuple(files), total, count, header["degree"], header["embed"], photo_height, num_flights, fades)


def parse_origins(texts: Sequence[str]) -> tuple[str, ...]:
    """Origins as browsers write them: in lower case, without the default port."""
    origins = []
    for text in texts:
        found = _ORIGIN.fullmatch(text.lower()) if text.isascii() else None
        scheme, host, port = found.groups() if found else ("", "", None)
        number = int(port or _DEFAULT_PORTS.get(scheme, 0))
        try:
            if not 0 < number < 1 << 16:
                raise ValueError("no port")
            if host.rpartition(".")[2].isdigit():
                ipaddress.IPv4Address(host)
        except ValueError:
            raise InputError(
                "`embed` must hold origins such as https://example.com or http://localhost:8000, without a path, got "
                f"{text!r}; give the scheme and the host of the page with the frame"
            ) from None
        origins.append(f"{scheme}://{host}" + (f":{number}" if number != _DEFAULT_PORTS[scheme] else ""))
    return tuple(dict.fromkeys(origins))


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"cannot write {folder}: needed a folder for the parts of the page, got '{reason}'; choose another name"
        ) from error


def _remove_old_parts(folder: Path, kept: set[str]) -> None:
    """Remove the parts of the page that was replaced, by their names and content, and the folder if that empties it."""
    name = re.compile(r"[0-9a-f]{16}(_\d+)?\.js")
    old = [file for file in folder.glob("*.js") if file.name not in kept and name.fullmatch(file.name)]
    old = [file for file in old if is_written(file)]
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
