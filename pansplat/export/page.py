"""Writing of a page: its graph, the numbers of its panoramas, and a poster."""

from __future__ import annotations

import dataclasses
import io
import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from pansplat import pipeline
from pansplat.errors import InputError, InputWarning
from pansplat.export.doll_house import DollHouse, make_house
from pansplat.export.film import FilmPhotographs
from pansplat.export.page_data import (
    PageConstants,
    PageHeader,
    PageLink,
    PageNote,
    PagePlan,
    PageRing,
    PageSpot,
    pack_gaussians,
)
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
from pansplat.tours.graph import TourGraph
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
_NO_PLAN = PagePlan(worlds=(0,), drawing="", is_sure=True, size=(1.0, 1.0), places=())
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
    is_tour, tour = len(facts.tour.overlaps) > 0, facts.ways
    groups, edges, walk = _plan_graph(tour, is_tour)
    scene, origin = prepared, prepared.cam2world[:, :3, 3].mean(0).numpy()
    house, has_pictures = DollHouse((), b""), len(photographs) > 0 and photo_height != 0
    if has_cameras:
        report_progress("building the doll's house", 0.0)
        house = make_house(scene, find_houses(facts), origin, photographs if has_pictures else ())
    flown = {*tour.parts}
    if has_pictures and is_tour:  # a part of the tour without a flight is shown by photographs, without Gaussians
        flown = {tour.parts[a] for a, b in tour.overlaps if a != b and (a, b) not in tour.poor}
    views = [view for view, part in enumerate(tour.parts) if part in flown]
    is_flown = torch.from_numpy(np.isin(scene.gaussians.views.numpy(), views))
    scene = dataclasses.replace(scene, gaussians=scene.gaussians.select(is_flown))
    kept = gaussians * len(views) // len(tour.parts)
    if len(scene.gaussians) > kept:
        report_progress("merging Gaussians", 0.1)
        scene = merge(scene, tour.parts, kept, steps=FIT_STEPS if has_cameras else 0)
    report_progress("compressing", 0.6)
    degree = choose_degree(scene, _TARGET_BYTES * (_GAUSSIANS_SHARE if has_pictures and not split else 1))
    order = _order_views(scene, tour.parts, walk[0])
    packed = pack_gaussians(scene.gaussians, origin, order, degree)
    report_progress("drawing the poster", 0.7)
    start = scene.cam2world[walk[0]].clone()
    start[:3, :3] = torch.from_numpy(turn_axes(tour.level_axes, *_find_ahead(tour, facts, walk[0])))
    poster = _draw_poster(scene, start, photographs if has_pictures else ())
    pictures: list[PackedPhotograph] = []
    if has_pictures:
        left = 0.75 * (_TARGET_BYTES - _PROGRAM_BYTES) - sum(map(len, packed.contents)) - len(poster + house.atlas)
        with stage(0.95):
            pictures = pack_photographs(prepared, photographs, math.inf if split else left, photo_height)
    report_progress("writing", 0.95)
    linked = link_parts(tour)
    header = PageHeader(
        count=len(scene.gaussians),
        degree=packed.degree,
        color_range=packed.color_range,
        harmonics_scale=packed.harmonics_scale,
        views=packed.views,
        loading=tuple(order),
        spots=_describe_spots(prepared, origin, linked, facts, photographs),
        links=_describe_links(linked),
        level=tuple(map(_round, tour.level_axes)),
        parts=tour.parts,
        groups=groups,
        edges=edges,
        next=tuple(map(tuple, find_next_nodes(tour))),
        poor=tour.poor,
        walk=walk,
        unit=1 / scene.frame.unit,
        limits=_limit_parts(prepared, tour.parts, flown),
        doll=house.houses,
        photographs=tuple(picture.describe() for picture in pictures),
        plan=draw_page_plan(facts.plan) if has_cameras else _NO_PLAN,
        folder=None,
    )
    files = write_files(
        path, header, packed.contents, pictures, poster, house.atlas, split, title or path.stem, address
    )
    inside = sum(len(each.nodes) for each in house.houses)
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


def _plan_graph(
    tour: TourGraph, is_tour: bool
) -> tuple[tuple[tuple[int, ...], ...], tuple[tuple[int, int, int], ...], tuple[int, ...]]:
    """Groups of views that are blended together, edges with their groups, and all views in the order of a visit.

    In a scene that is no tour all views are blended everywhere.
    """
    views = tuple(range(len(tour)))
    scenes = choose_scene_views(tour) if is_tour else dict.fromkeys(tour.overlaps, views)
    groups = tuple(dict.fromkeys(scenes.values()))
    edges = tuple((a, b, groups.index(scenes[a, b])) for a, b in tour.overlaps)
    return groups, edges, tuple(dict.fromkeys(plan_walk(tour))) if is_tour else views


def _find_ahead(tour: TourGraph, facts: TourFacts, view: int) -> tuple[float, float]:
    """Yaw and pitch of the start view of a panorama, else of its widest view."""
    return find_start_angles(tour, view) or (find_widest(facts.outlooks[view]), 0.0)


def _order_views(scene: Scene, parts: Sequence[int], first: int) -> list[int]:
    """The views of the part where the page starts, then the others; the nearest first."""
    distances = (scene.cam2world[:, :3, 3] - scene.cam2world[first, :3, 3]).norm(dim=1).numpy()
    return np.lexsort((distances, np.array(parts) != parts[first])).tolist()


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


def _describe_spots(
    scene: Scene,
    origin: Float[np.ndarray, "3"],
    tour: TourGraph,
    facts: TourFacts,
    photographs: Sequence[PanoramaSet],
) -> tuple[PageSpot, ...]:
    """The panoramas of a page.

    Args:
        scene: of `prepare`.
        tour: with links between all parts (`link_parts`).
        photographs: of each view, which have notes; none without them.
    """
    positions = scene.cam2world[:, :3, 3].numpy() - origin
    marks = positions + np.outer(facts.usual_heights, tour.level_axes[:, 1])
    rooms = [room.panoramas for room in facts.plan.rooms] if len(positions) > 1 else []
    spots = []
    for view, (name, position, mark) in enumerate(zip(scene.names, positions, marks, strict=True)):
        outlook = facts.outlooks[view]
        rings = choose_rings(tour, view, facts.usual_heights[view], facts.hidden[view], outlook, rooms)
        ahead, notes = _find_ahead(tour, facts, view), photographs[view].context[0].notes if photographs else ()
        spots.append(
            PageSpot(
                name=name,
                position=_round(position),
                mark=_round(mark),
                notes=tuple(
                    PageNote(
                        _round(find_direction(scene.cam2world[view], note.yaw, note.pitch).numpy()),
                        note.text,
                        note.addresses,
                    )
                    for note in notes
                ),
                ahead=(round(ahead[0], 5), round(ahead[1], 5)),
                has_start=tour.panoramas[view].start is not None,
                turns=_round(find_turns(outlook)),
                rings=tuple(PageRing(node, None if away is None else _round(position + away)) for node, away in rings),
                clearances=tuple(map(tuple, tour.clearances[view].round(2).tolist())),
            )
        )
    return tuple(spots)


def _describe_links(tour: TourGraph) -> tuple[PageLink, ...]:
    angles = (
        (*way, link.text, *find_angles(tour.look(way[0], link.yaw, link.pitch))) for way, link in tour.links.items()
    )
    return tuple(PageLink(start, end, text, round(yaw, 5), round(pitch, 5)) for start, end, text, yaw, pitch in angles)


def _limit_parts(scene: Scene, parts: Sequence[int], flown: set[int]) -> tuple[float, ...]:
    """How far the camera may move in each part from its edges: at most the median distance of its Gaussians."""
    numbers, views = np.array(parts), scene.gaussians.views.long()
    distances = (scene.gaussians.means.double() - scene.cam2world[views, :3, 3]).norm(dim=1).numpy()
    limits, most = [], REACH if max(parts) > 0 else math.inf
    for part in range(max(parts) + 1):
        own = distances[numbers[views] == part]
        reach = max(float(np.median(own)) if len(own) else 0.0, 1e-3)
        limit = min(_SINGLE_REACH, 0.5 * reach) if parts.count(part) == 1 else min(reach, most)
        limits.append(limit if part in flown else 0.0)
    return tuple(limits)


def _round(vector: np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in np.float32(vector))
