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
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import quote, urljoin

import msgspec
import numpy as np
import scipy
import torch
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor

from pansplat import constants, pipeline
from pansplat.errors import InputError, InputWarning
from pansplat.export.doll_house import DollHouse, make_house
from pansplat.export.film import FilmPhotographs
from pansplat.export.page_data import (
    BATCH,
    MAX_DEGREE,
    PackedGaussians,
    PageConstants,
    PageHeader,
    count_bytes,
    pack_gaussians,
)
from pansplat.export.photographs import MAX_HEIGHT, PackedPhotograph, label_files, pack_photographs
from pansplat.export.plan_files import draw_page_plan
from pansplat.gaussians.scene import Gaussians, Scene, prune
from pansplat.geometry.level import find_direction, turn_axes
from pansplat.inputs.panorama_sets import PanoramaSet
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
from pansplat.tours.graph import Edge, TourGraph
from pansplat.tours.layout import REACH
from pansplat.tours.links import find_link_ring, link_parts
from pansplat.tours.merge import select_views
from pansplat.tours.outlook import find_turns, find_widest
from pansplat.tours.route import find_angles, find_start_angles
from pansplat.tours.scene_views import choose_scene_views
from pansplat.tours.walks import find_next_nodes, plan_walk

DEFAULT_GAUSSIANS = 600_000  # Gaussians of a page of about 13 MB
_PHOTO_GAUSSIANS = 300_000, 450_000  # least and most Gaussians beside photographs in one file; about 7 and 10 MB
MAX_GAUSSIANS = 4_000_000  # fit textures of 2048 texels a side, which every device has
MAX_FILE_BYTES = 64_000_000  # largest page in one file
_TARGET_BYTES = 15_000_000  # size of a page to which the degree of harmonics and the photographs are fitted
_GAUSSIANS_SHARE = 1 / 2  # largest part of these bytes for Gaussians beside photographs
GAUSSIAN_BYTES = 22  # bytes of a Gaussian in a page
_PHOTO_BYTES = 0.45  # bytes of a photograph in a page, over its squared rows
_PROGRAM_BYTES = 200_000  # size of a page without its data
_PART_BYTES = 1_500_000  # bytes of data between two steps of the progress bar; divisible by 3 for base64
_FIT_STEPS = 8  # steps that fit merged Gaussians to the images of all Gaussians
_POSTER_SIZE = (810, 960)  # height and width, pixels; as high as a portrait image
_NO_PLAN = {"worlds": (0,), "rooms": (), "drawing": "", "isSure": True, "size": (1.0, 1.0), "places": ()}
_SINGLE_REACH = 1.0  # metres from a panorama without others in its part, at most half the distance of its surfaces
_SHADERS = {"splat": ("page.vert", "splat.frag"), "accumulate": ("screen.vert", "accumulate.frag")}
_SHADERS |= {"resolve": ("screen.vert", "resolve.frag"), "mark": ("mark.vert", "mark.frag")}
_SHADERS |= {"photograph": ("screen.vert", "photograph.frag"), "house": ("house.vert", "house.frag")}

_WORKER = ("unpack.js", "sorter.js")
_LIBRARIES = ("graph.js", "renderer.js")  # scripts of their own, which know nothing of the page
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
        zooms: labels of the two panoramas of each edge along which it zooms.
        num_outside: panoramas without doll's house.
    """

    files: tuple[Path, ...]
    num_bytes: int
    num_gaussians: int
    photo_height: int = 0
    num_flights: int = 0
    zooms: tuple[tuple[str, str], ...] = ()
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
    has_cameras, prepared = len(scene.cam2world) > 0, _prepare(scene)
    facts = TourFacts(scene if has_cameras else prepared, folder=photographs[0].folder if photographs else None)
    tour = dataclasses.replace(facts.tour, poor=facts.poor)
    rooms = find_rooms(facts) if has_cameras else None
    scene = prepared
    flights = _plan_flights(tour, len(scene.cam2world))
    house, has_pictures = DollHouse((), (), b""), len(photographs) > 0 and photo_height != 0
    if rooms is not None:
        report_progress("building the doll's house", 0.0)
        house = make_house(scene, rooms, photographs if has_pictures else ())
    flown = _find_flown_parts(flights, tour.poor) if has_pictures else {*flights.parts}
    views = [view for view, part in enumerate(flights.parts) if part in flown]
    is_flown = torch.from_numpy(np.isin(scene.gaussians.views.numpy(), views))
    scene = dataclasses.replace(scene, gaussians=scene.gaussians.select(is_flown))
    kept = gaussians * len(views) // len(flights.parts)
    if len(scene.gaussians) > kept:
        report_progress("merging Gaussians", 0.1)
        scene = _merge(scene, flights.parts, kept, steps=_FIT_STEPS if has_cameras else 0)
    report_progress("compressing", 0.6)
    degree = _choose_degree(scene, _TARGET_BYTES * (_GAUSSIANS_SHARE if has_pictures and not split else 1))
    origin = scene.cam2world[:, :3, 3].mean(0).numpy()
    packed = pack_gaussians(scene.gaussians, origin, _order_views(scene, flights), degree)
    report_progress("drawing the poster", 0.7)
    first = flights.walk[0]
    start = scene.cam2world[first].clone()
    start[:3, :3] = torch.from_numpy(turn_axes(tour.level_axes, *_find_ahead(tour, facts, first)))
    poster = _draw_poster(scene, start, photographs if has_pictures else ())
    pictures: list[PackedPhotograph] = []
    if has_pictures:
        left = 0.75 * (_TARGET_BYTES - _PROGRAM_BYTES) - sum(map(len, packed.contents)) - len(poster + house.atlas)
        with stage(0.95):
            pictures = pack_photographs(prepared, photographs, math.inf if split else left, photo_height)
    report_progress("writing", 0.95)
    header = _describe_scene(prepared, packed, origin, flights, tour, facts, flown)
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
    files = _write_files(path, header, packed.contents, pictures, poster, house.atlas, split, title, address)
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
class _Flights:
    """How the camera moves.

    Attributes:
        parts: of each view; the camera moves within a part, and zooms to another one.
        groups: views that are blended together.
        edges: two views and the group that is blended between them; without edges all views are blended.
        walk: all views, in the order of a visit.
    """

    parts: tuple[int, ...]
    groups: tuple[tuple[int, ...], ...]
    edges: tuple[tuple[int, int, int], ...]
    walk: tuple[int, ...]


def _plan_flights(tour: TourGraph, count: int) -> _Flights:
    """The flights of a tour; without edges, the camera flies from view to view.

    Args:
        tour: of the scene.
        count: number of views.
    """
    if not tour.overlaps:
        views = tuple(range(count))
        return _Flights((0,) * count, (views,), (), views)
    scenes = choose_scene_views(tour)
    groups = tuple(dict.fromkeys(scenes.values()))
    edges = tuple((a, b, groups.index(scenes[a, b])) for a, b in tour.overlaps)
    return _Flights(tour.parts, groups, edges, tuple(dict.fromkeys(plan_walk(tour))))


def _find_ahead(tour: TourGraph, facts: TourFacts, view: int) -> tuple[float, float]:
    """Yaw and pitch of the start view of a panorama, else of its widest view."""
    return find_start_angles(tour, view) or (find_widest(facts.outlooks[view]), 0.0)


def _order_views(scene: Scene, flights: _Flights) -> list[int]:
    """The views of the part where the page starts, then the others; the nearest first."""
    first, parts = flights.walk[0], np.array(flights.parts)
    distances = (scene.cam2world[:, :3, 3] - scene.cam2world[first, :3, 3]).norm(dim=1).numpy()
    return np.lexsort((distances, parts != parts[first])).tolist()


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


def _find_flown_parts(flights: _Flights, poor: Sequence[Edge]) -> set[int]:
    """The parts that have a flight, all without edges: in the others the page shows photographs only.

    Args:
        poor: edges along which no camera flies.
    """
    flown = {flights.parts[a] for a, b, _ in flights.edges if a != b and (a, b) not in poor}
    return flown if flights.edges else {*flights.parts}


def _merge(scene: Scene, parts: Sequence[int], count: int, steps: int = _FIT_STEPS) -> Scene:
    """At most `count` Gaussians, an equal number for each panorama of different parts that have any.

    Args:
        scene: of `_prepare`.
        parts: of each view; they are merged one after the other.
        steps: of the fit of shapes; 0 fits colours only.
    """
    merged, seen = [], {parts[view] for view in scene.gaussians.views.unique().tolist()}
    total = sum(part in seen for part in parts)
    for part in dict.fromkeys(part for part in parts if part in seen):
        views = tuple(view for view, other in enumerate(parts) if other == part)
        chosen = select_views(scene, views)
        kept = max(count * len(views) // total, 1)
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
    flights: _Flights,
    tour: TourGraph,
    facts: TourFacts,
    flown: set[int],
) -> dict[str, Any]:
    """The numbers of a page, without those of single Gaussians; a part of `PageHeader`.

    Args:
        scene: of `_prepare`, with all Gaussians.
        flown: parts whose Gaussians are in the page.
    """
    level = tour.level_axes
    positions = scene.cam2world[:, :3, 3].numpy() - origin
    marks = positions + np.outer(facts.usual_heights, level[:, 1])
    spots = [
        {
            "name": name,
            "position": _round(position),
            "mark": _round(mark),
            "notes": [],
            "ahead": [round(angle, 5) for angle in _find_ahead(tour, facts, view)],
            "hasStart": tour.panoramas[view].start is not None,
            "turns": _round(find_turns(facts.outlooks[view])),
            "hidden": facts.hidden[view],
            "clearances": facts.clearances[view].round(2).tolist(),
        }
        for view, (name, position, mark) in enumerate(zip(scene.names, positions, marks, strict=True))
    ]
    reaches = _measure_reaches(scene, np.array(flights.parts))
    return {
        "count": sum(packed.counts),
        "degree": packed.degree,
        "colorRange": packed.color_range,
        "harmonicsScale": packed.harmonics_scale,
        "views": [{"start": each, "count": n} for each, n in zip(packed.starts, packed.counts, strict=True)],
        "loading": packed.order,
        "spots": spots,
        "links": _describe_links(link_parts(tour), spots, facts) if flights.edges else [],
        "level": [_round(row) for row in level],
        "parts": flights.parts,
        "groups": flights.groups,
        "edges": flights.edges,
        "next": find_next_nodes(tour) if flights.edges else [],
        "poor": tour.poor,
        "walk": flights.walk,
        "unit": 1 / scene.frame.unit,
        "limits": _limit_parts(reaches, positions, flights, flown),
    }


def _describe_plan(facts: TourFacts) -> dict[str, Any]:
    """The floor plan: its drawing, and where the panoramas are on it."""
    (svg, size, places), rooms = draw_page_plan(facts.plan), facts.plan.rooms
    return {
        "worlds": facts.tour.worlds,
        "rooms": [room.panoramas for room in rooms],
        "isSure": all(room.is_placed for room in rooms),
        "drawing": base64.b64encode(svg).decode(),
        "size": size,
        "places": places,
    }


def _describe_links(tour: TourGraph, spots: Sequence[dict[str, Any]], facts: TourFacts) -> list[dict[str, Any]]:
    """The links of a page. Those to other parts, and those to panoramas whose marks are hidden, have a ring."""
    links = []
    for (start, end), link in tour.links.items():
        direction = tour.find_direction(start, end)
        assert direction is not None
        yaw, pitch = find_angles(direction)
        found = {"from": start, "to": end, "text": link.text, "yaw": round(yaw, 5), "pitch": round(pitch, 5)}
        ring = find_link_ring(tour, start, end, facts.usual_heights[start], facts.outlooks[start])
        if ring is not None and (tour.parts[start] != tour.parts[end] or end in spots[start]["hidden"]):
            found["mark"] = _round(np.array(spots[start]["position"]) + ring)
        links.append(found)
    return links


def _measure_reaches(scene: Scene, parts: Int[np.ndarray, "view"]) -> Float[np.ndarray, "part"]:
    """Median distance of the Gaussians of each part from their cameras."""
    views = scene.gaussians.views.long()
    distances = (scene.gaussians.means.double() - scene.cam2world[views, :3, 3]).norm(dim=1).numpy()
    own = [distances[parts[views] == part] for part in range(parts.max() + 1)]
    return np.array([max(float(np.median(each)) if len(each) else 0.0, 1e-3) for each in own])


def _limit_parts(
    reaches: Float[np.ndarray, "part"], positions: Float[np.ndarray, "view 3"], flights: _Flights, flown: set[int]
) -> list[float]:
    """How far the camera may move in each part from its edges; without edges, from the nearest panorama."""
    parts = list(flights.parts)
    if not flights.edges and len(positions) > 1:
        distances = scipy.spatial.distance.cdist(positions, positions)
        longest_step = float(scipy.sparse.csgraph.minimum_spanning_tree(distances).toarray().max(initial=0.0))
        return [max(float(reaches[0]), 0.75 * longest_step)]
    most = REACH if len(reaches) > 1 else math.inf
    limits = [
        min(_SINGLE_REACH, 0.5 * reach) if parts.count(part) == 1 else min(reach, most)
        for part, reach in enumerate(reaches.tolist())
    ]
    return [limit if part in flown else 0.0 for part, limit in enumerate(limits)]


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
    zooms = tuple((names[a], names[b]) for a, b in header["poor"])
    num_flights = sum(a != b for a, b, _ in header["edges"]) - len(zooms)
    return PageFiles(tuple(files), total, count, photo_height, num_flights, zooms)


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
    return load_shader(name, "300 es", LAYER_STORAGE=0, BATCH=BATCH)
