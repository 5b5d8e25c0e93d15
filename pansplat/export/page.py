"""Writing of a page: its graph, the numbers of its panoramas, and a poster."""

from __future__ import annotations

import base64
import dataclasses
import io
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor

from pansplat import pipeline
from pansplat.errors import InputError, InputWarning
from pansplat.export.doll_house import DollHouse, make_house
from pansplat.export.film import FilmPhotographs
from pansplat.export.page_data import PackedGaussians, PageConstants, pack_gaussians
from pansplat.export.page_files import PageFiles, write_files
from pansplat.export.page_scene import FIT_STEPS, choose_degree, merge, prepare
from pansplat.export.photographs import MAX_HEIGHT, PackedPhotograph, pack_photographs
from pansplat.export.plan_files import draw_page_plan
from pansplat.gaussians.scene import Scene
from pansplat.geometry.level import find_direction, turn_axes
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.rendering.image_planes import image_planes
from pansplat.system.console import with_progress_bar
from pansplat.system.files import SOFTWARE
from pansplat.system.progress import report_progress, stage
from pansplat.tours.facts import TourFacts
from pansplat.tours.graph import Edge, TourGraph
from pansplat.tours.houses import find_houses
from pansplat.tours.layout import REACH
from pansplat.tours.links import choose_rings, link_parts
from pansplat.tours.outlook import find_turns, find_widest
from pansplat.tours.route import find_angles, find_start_angles
from pansplat.tours.scene_views import choose_scene_views
from pansplat.tours.walks import find_next_nodes, plan_walk

DEFAULT_GAUSSIANS = 600_000  # Gaussians of a page of about 13 MB
_PHOTO_GAUSSIANS = 300_000, 450_000  # least and most Gaussians beside photographs in one file; about 7 and 10 MB
MAX_GAUSSIANS = 4_000_000  # fit textures of 2048 texels a side, which every device has
_TARGET_BYTES = 15_000_000  # size of a page to which the degree of harmonics and the photographs are fitted
_GAUSSIANS_SHARE = 1 / 2  # largest part of these bytes for Gaussians beside photographs
GAUSSIAN_BYTES = 22  # bytes of a Gaussian in a page
_PHOTO_BYTES = 0.45  # bytes of a photograph in a page, over its squared rows
_PROGRAM_BYTES = 200_000  # size of a page without its data
_POSTER_SIZE = (810, 960)  # height and width, pixels; as high as a portrait image
_NO_PLAN = {"worlds": (0,), "drawing": "", "isSure": True, "size": (1.0, 1.0), "places": ()}
_SINGLE_REACH = 1.0  # metres from a panorama without others in its part, at most half the distance of its surfaces


@with_progress_bar
def write_page(
    scene: Scene,
    path: Path | str,
    *,
    gaussians: int = DEFAULT_GAUSSIANS,
    split: bool = False,
    title: str | None = None,
    address: str | None = None,
    photographs: Sequence[PanoramaSet] = (),
    photo_height: int | None = None,
) -> PageFiles:
    """Write a scene as a web page.

    Args:
        scene: any number of panoramas; without one the page starts in the middle of the Gaussians. In a scene of a tour
            (`pansplat.predict`), the views of the nearest edge are blended, and flights follow the edges. In other
            scenes, all views are blended everywhere.
        path: the .html file.
        gaussians: largest number of Gaussians, such as that of `choose_gaussians`. Similar neighbours of a scene that
            has more are merged, and fitted to its own images; a prediction for so many is better.
        split: write the data to the folder `NAME_files` beside the page, for large scenes.
        title: of the page; by default the name of the file.
        address: of the page on the web, for previews of links to it. They show the poster of a split page.
        photographs: of each view, which the page shows there (`list_photographs`), with the notes of its
            tour; none without them.
        photo_height: largest height of photographs, pixels, 0 for none; by default what fits, in a split page that
            of the files.
    """
    path = Path(path)
    if not 1 <= gaussians <= MAX_GAUSSIANS:
        raise InputError(f"`gaussians` must be 1 to {MAX_GAUSSIANS:,} in a page, got {gaussians:,}")
    report_progress("checking the scene", 0.0)
    if scene.joint and scene.tour:
        warnings.warn(
            "a page follows the edges of a tour with all Gaussians of each panorama, got each surface once; its "
            "flights are straight. Export the folder of the photographs, or a scene file of --layers.",
            InputWarning,
            stacklevel=2,
        )
        scene = dataclasses.replace(scene, starts=(), tour=None)
    has_cameras, prepared = len(scene.cam2world) > 0, prepare(scene)
    facts = TourFacts(scene if has_cameras else prepared, folder=photographs[0].folder if photographs else None)
    is_tour = len(facts.tour.overlaps) > 0
    tour = facts.graph if is_tour else facts.bounds
    houses = find_houses(facts) if has_cameras else None
    scene = prepared
    graph = _plan_graph(tour) if is_tour else _join_all(tour)
    house, has_pictures = DollHouse((), (), b""), len(photographs) > 0 and photo_height != 0
    if houses is not None:
        report_progress("building the doll's house", 0.0)
        house = make_house(scene, houses, photographs if has_pictures else ())
    flown = _find_flown_parts(graph, tour.poor) if has_pictures and is_tour else {*graph.parts}
    views = [view for view, part in enumerate(graph.parts) if part in flown]
    is_flown = torch.from_numpy(np.isin(scene.gaussians.views.numpy(), views))
    scene = dataclasses.replace(scene, gaussians=scene.gaussians.select(is_flown))
    kept = gaussians * len(views) // len(graph.parts)
    if len(scene.gaussians) > kept:
        report_progress("merging Gaussians", 0.1)
        scene = merge(scene, graph.parts, kept, steps=FIT_STEPS if has_cameras else 0)
    report_progress("compressing", 0.6)
    degree = choose_degree(scene, _TARGET_BYTES * (_GAUSSIANS_SHARE if has_pictures and not split else 1))
    origin = scene.cam2world[:, :3, 3].mean(0).numpy()
    packed = pack_gaussians(scene.gaussians, origin, _order_views(scene, graph), degree)
    report_progress("drawing the poster", 0.7)
    first = graph.walk[0]
    start = scene.cam2world[first].clone()
    start[:3, :3] = torch.from_numpy(turn_axes(tour.level_axes, *_find_ahead(tour, facts, first)))
    poster = _draw_poster(scene, start, photographs if has_pictures else ())
    pictures: list[PackedPhotograph] = []
    if has_pictures:
        left = 0.75 * (_TARGET_BYTES - _PROGRAM_BYTES) - sum(map(len, packed.contents)) - len(poster + house.atlas)
        with stage(0.95):
            pictures = pack_photographs(prepared, photographs, math.inf if split else left, photo_height)
    report_progress("writing", 0.95)
    header = _describe_scene(prepared, packed, origin, graph, tour, facts, flown)
    header |= {"doll": [], "photographs": [picture.describe() for picture in pictures]}
    header["plan"] = _describe_plan(facts) if has_cameras else _NO_PLAN
    for pose, spot, photograph in zip(scene.cam2world, header["spots"], photographs, strict=False):
        for note in photograph.context[0].notes:
            direction = _round(find_direction(pose, note.yaw, note.pitch).numpy())
            spot["notes"].append({"direction": direction, "text": note.text, "addresses": note.addresses})
    for nodes, corners in zip(house.nodes, house.corners, strict=True):
        moves = [(turn, *_round(place - origin)) for turn, place in nodes.values()]
        corners = (corners - [*origin, 0, 0]).round(5).tolist()
        header["doll"].append({"nodes": [*nodes], "moves": moves, "corners": corners})
    title = title or path.stem
    files = write_files(path, header, packed.contents, pictures, poster, house.atlas, split, title, address)
    inside = sum(len(each["nodes"]) for each in header["doll"])
    return dataclasses.replace(files, num_outside=len(scene.cam2world) - inside if has_cameras else 0)


def choose_gaussians(heights: Sequence[int]) -> int:
    """The number of Gaussians of a page in one file: what photographs in it leave of 15 MB.

    Args:
        heights: of the photographs, pixels; none without them.
    """
    if not heights:
        return DEFAULT_GAUSSIANS
    left = _TARGET_BYTES - _PROGRAM_BYTES - _PHOTO_BYTES * sum(min(height, MAX_HEIGHT) ** 2 for height in heights)
    least, most = _PHOTO_GAUSSIANS
    return min(max(int(left / GAUSSIAN_BYTES), least), most)


@dataclass(frozen=True, eq=False)
class _PageGraph:
    """How the camera moves.

    Attributes:
        parts: of each view; the camera moves within a part, and zooms to another one.
        groups: views that are blended together.
        edges: two views and the group that is blended between them.
        walk: all views, in the order of a visit.
    """

    parts: tuple[int, ...]
    groups: tuple[tuple[int, ...], ...]
    edges: tuple[tuple[int, int, int], ...]
    walk: tuple[int, ...]


def _plan_graph(tour: TourGraph) -> _PageGraph:
    """The graph of a tour."""
    scenes = choose_scene_views(tour)
    groups = tuple(dict.fromkeys(scenes.values()))
    edges = tuple((a, b, groups.index(scenes[a, b])) for a, b in tour.overlaps)
    return _PageGraph(tour.parts, groups, edges, tuple(dict.fromkeys(plan_walk(tour))))


def _join_all(tour: TourGraph) -> _PageGraph:
    """The graph of a scene that is no tour, in which all views are blended everywhere."""
    views = tuple(range(len(tour)))
    return _PageGraph(tour.parts, (views,), tuple((a, b, 0) for a, b in tour.overlaps), views)


def _find_ahead(tour: TourGraph, facts: TourFacts, view: int) -> tuple[float, float]:
    """Yaw and pitch of the start view of a panorama, else of its widest view."""
    return find_start_angles(tour, view) or (find_widest(facts.outlooks[view]), 0.0)


def _order_views(scene: Scene, graph: _PageGraph) -> list[int]:
    """The views of the part where the page starts, then the others; the nearest first."""
    first, parts = graph.walk[0], np.array(graph.parts)
    distances = (scene.cam2world[:, :3, 3] - scene.cam2world[first, :3, 3]).norm(dim=1).numpy()
    return np.lexsort((distances, parts != parts[first])).tolist()


def _find_flown_parts(graph: _PageGraph, poor: Sequence[Edge]) -> set[int]:
    """The parts of a tour that have a flight: in the others the page shows photographs only.

    Args:
        poor: edges along which no camera flies.
    """
    return {graph.parts[a] for a, b, _ in graph.edges if a != b and (a, b) not in poor}


def _draw_poster(scene: Scene, pose: Float[Tensor, "4 4"], photographs: Sequence[PanoramaSet]) -> bytes:
    """A JPEG of the first view of the page; at a panorama it shows the photograph, if there is one."""
    shared = PageConstants()
    fov = math.degrees(2 * math.atan(shared.tallest * math.tan(math.radians(shared.start_fov / 2))))

    def draw() -> Float[np.ndarray, "height width 3"]:
        options = {"size": _POSTER_SIZE, "layout": "pinhole", "vertical_fov_degrees": fov}
        return pipeline.render(scene, pose, **options).color.clamp(0, 1).permute(1, 2, 0).numpy()

    (plane,) = image_planes("pinhole", _POSTER_SIZE, vertical_fov_degrees=fov)
    with torch.no_grad():
        stops = FilmPhotographs(photographs, scene.cam2world)
        image = stops.cover(*stops.find_stop(pose.numpy()), pose.numpy(), plane, draw)
    pixels = (image * 255).round().clip(0, 255).astype(np.uint8)
    with io.BytesIO() as file:
        Image.fromarray(pixels).save(file, "JPEG", quality=80, optimize=True, comment=SOFTWARE.encode())
        return file.getvalue()


def _describe_scene(
    scene: Scene,
    packed: PackedGaussians,
    origin: Float[np.ndarray, "3"],
    graph: _PageGraph,
    tour: TourGraph,
    facts: TourFacts,
    flown: set[int],
) -> dict[str, Any]:
    """The numbers of a page, without those of single Gaussians; a part of `PageHeader`.

    Args:
        scene: of `prepare`, with all Gaussians.
        flown: parts whose Gaussians are in the page.
    """
    level = tour.level_axes
    positions = scene.cam2world[:, :3, 3].numpy() - origin
    marks = positions + np.outer(facts.usual_heights, level[:, 1])
    linked, rooms = link_parts(tour), [room.panoramas for room in facts.plan.rooms] if len(positions) > 1 else []
    spots = [
        {
            "name": name,
            "position": _round(position),
            "mark": _round(mark),
            "notes": [],
            "ahead": [round(angle, 5) for angle in _find_ahead(tour, facts, view)],
            "hasStart": tour.panoramas[view].start is not None,
            "turns": _round(find_turns(facts.outlooks[view])),
            "rings": _describe_rings(linked, facts, view, position, rooms),
            "clearances": tour.clearances[view].round(2).tolist(),
        }
        for view, (name, position, mark) in enumerate(zip(scene.names, positions, marks, strict=True))
    ]
    reaches = _measure_reaches(scene, np.array(graph.parts))
    return {
        "count": sum(packed.counts),
        "degree": packed.degree,
        "colorRange": packed.color_range,
        "harmonicsScale": packed.harmonics_scale,
        "views": [{"start": each, "count": n} for each, n in zip(packed.starts, packed.counts, strict=True)],
        "loading": packed.order,
        "spots": spots,
        "links": _describe_links(linked),
        "level": [_round(row) for row in level],
        "parts": graph.parts,
        "groups": graph.groups,
        "edges": graph.edges,
        "next": find_next_nodes(tour),
        "poor": tour.poor,
        "walk": graph.walk,
        "unit": 1 / scene.frame.unit,
        "limits": _limit_parts(reaches, graph.parts, flown),
    }


def _describe_plan(facts: TourFacts) -> dict[str, Any]:
    """The floor plan: its drawing, and where the panoramas are on it."""
    svg, size, places = draw_page_plan(facts.plan)
    return {
        "worlds": facts.tour.worlds,
        "isSure": all(room.is_placed for room in facts.plan.rooms),
        "drawing": base64.b64encode(svg).decode(),
        "size": size,
        "places": places,
    }


def _describe_links(tour: TourGraph) -> list[dict[str, Any]]:
    links = []
    for (start, end), link in tour.links.items():
        direction = tour.find_direction(start, end)
        assert direction is not None
        yaw, pitch = find_angles(direction)
        links.append({"from": start, "to": end, "text": link.text, "yaw": round(yaw, 5), "pitch": round(pitch, 5)})
    return links


def _describe_rings(
    tour: TourGraph, facts: TourFacts, view: int, position: Float[np.ndarray, "3"], rooms: Sequence[Sequence[int]]
) -> list[dict[str, Any]]:
    """The rings that a page offers at a panorama."""
    rings = choose_rings(tour, view, facts.usual_heights[view], facts.hidden[view], facts.outlooks[view], rooms)
    return [{"node": node, "mark": None if offset is None else _round(position + offset)} for node, offset in rings]


def _measure_reaches(scene: Scene, parts: Int[np.ndarray, "view"]) -> Float[np.ndarray, "part"]:
    """Median distance of the Gaussians of each part from their cameras."""
    views = scene.gaussians.views.long()
    distances = (scene.gaussians.means.double() - scene.cam2world[views, :3, 3]).norm(dim=1).numpy()
    own = [distances[parts[views] == part] for part in range(parts.max() + 1)]
    return np.array([max(float(np.median(each)) if len(each) else 0.0, 1e-3) for each in own])


def _limit_parts(reaches: Float[np.ndarray, "part"], parts: Sequence[int], flown: set[int]) -> list[float]:
    """How far the camera may move in each part from its edges."""
    most = REACH if len(reaches) > 1 else math.inf
    limits = [
        min(_SINGLE_REACH, 0.5 * reach) if parts.count(part) == 1 else min(reach, most)
        for part, reach in enumerate(reaches.tolist())
    ]
    return [limit if part in flown else 0.0 for part, limit in enumerate(limits)]


def _round(vector: np.ndarray) -> list[float]:
    return [float(value) for value in np.float32(vector)]
