"""The modules of the page in node: their imports, and those that need no browser as functions of HEADER and state."""

import dataclasses
import json
import math
import os
import re
import shutil
import subprocess
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from pansplat.export.page_data import PageConstants, PageHeader
from pansplat.export.page_program import bundle_programs
from pansplat.geometry.pose import blend_weights
from pansplat.inputs.panorama_sets import Link, Panorama
from pansplat.tours.graph import TourGraph
from pansplat.tours.limits import EDGE_HYSTERESIS, follow_edge, limit_step
from pansplat.tours.walks import find_next_nodes, find_way

FOLDER = Path(str(resources.files("pansplat.web")))
MODULES = {file.name: file.read_text("utf-8") for file in FOLDER.glob("*.js")}
WITHOUT_BROWSER = ("graph.js", "state.js", "camera.js", "choices.js", "doll.js")
IMPORT = re.compile(r'^import \{([^}]*)\} from "\./(\w+\.js)";$', re.MULTILINE)


def find_circle(modules: dict[str, str]) -> list[str]:
    """The modules of a circle of imports, or none."""
    done: set[str] = set()

    def visit(name: str, path: list[str]) -> list[str]:
        if name in path:
            return path[path.index(name) :]
        found = [] if name in done else [visit(other, [*path, name]) for _, other in IMPORT.findall(modules[name])]
        done.add(name)
        return max(found, key=len, default=[])

    return max((visit(name, []) for name in modules), key=len)


def test_imports_of_the_modules_have_no_circle() -> None:
    assert sum(len(IMPORT.findall(text)) for text in MODULES.values()) > 60
    assert find_circle(MODULES) == []
    planted = MODULES | {"camera.js": 'import { advance } from "./loop.js";\n' + MODULES["camera.js"]}
    assert {"camera.js", "loop.js"} <= set(find_circle(planted))


def test_the_modules_share_one_scope(node: str, tmp_path: Path) -> None:
    (tmp_path / "program.js").write_text(re.sub("</?script>", "", bundle_programs()))
    done = subprocess.run([node, "--check", tmp_path / "program.js"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_the_modules_read_all_fields_of_the_header() -> None:
    fields = {field.encode_name for field in msgspec.structs.fields(PageHeader)}
    read = {name for text in MODULES.values() for name in re.findall(r"\bHEADER\.(\w+)", text)}
    for text in MODULES.values():
        for names in re.findall(r"\{((?:[^{}]|\{[^{}]*\})*)\} = HEADER\b(?!\.)", text):
            read |= set(re.findall(r"\w+", re.sub(r": \{[^{}]*\}", "", names)))
    graph = {"next", "poor", "hysteresis", "reach", "positions"}  # of GRAPH, which is HEADER with `positions`
    assert fields - read <= graph


@pytest.fixture(scope="module")
def node() -> str:
    """The node of playwright; without it the tests fail in CI and are skipped elsewhere."""
    try:
        import playwright

        program: str | None = str(Path(playwright.__file__).parent / "driver" / "node")
    except ImportError:
        program = None
    program = program if program and Path(program).is_file() else shutil.which("node")
    if program is None:
        if os.environ.get("CI"):
            pytest.fail("CI needs playwright (pip install -e '.[dev]')")
        pytest.skip("needs playwright (pip install -e '.[dev]') or node")
    return program


def run(node: str, folder: Path, header: dict[str, Any], program: str, *values: Any) -> Any:
    """The JSON value that a program returns; it has all names of the modules that need no browser, and `values`."""
    (folder / "package.json").write_text('{"type": "module"}')
    for name in WITHOUT_BROWSER:
        shutil.copy(FOLDER / name, folder)
    imports = "".join(f'Object.assign(globalThis, await import("./{name}"));\n' for name in WITHOUT_BROWSER)
    (folder / "program.js").write_text(
        f"globalThis.HEADER = {json.dumps(header)};\nconst values = {json.dumps(values)};\n{imports}"
        f"const act = {program};\nconsole.log(JSON.stringify(act(...values)));\n"
    )
    done = subprocess.run([node, folder / "program.js"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


ROW = [(0.0, 0.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.0, 4.0), (30.0, 0.0, 0.0)]


EDGES, PARTS = ((0, 1), (1, 2), (3, 3)), (0, 0, 0, 1)


def make_house(nodes: list[int]) -> dict[str, Any]:
    """A floor 1.5 m below the origin and a wall at its far end, which is seen from the near side, with its top."""
    floor = [(-1, 1.5, 5), (1, 1.5, 5), (1, 1.5, -1), (-1, 1.5, 5), (1, 1.5, -1), (-1, 1.5, -1)]
    wall = [(-1, -1, 5), (1, -1, 5), (1, 1.5, 5), (-1, -1, 5), (1, 1.5, 5), (-1, 1.5, 5)]
    top = [(-1, -1, 5.2), (1, -1, 5.2), (1, -1, 5)]
    corners = [(*place, 0.5, 0.5) for place in (*floor, *wall)] + [(*place, 2.0, 1.0) for place in top]
    return {"nodes": nodes, "corners": corners}


def make_header() -> dict[str, Any]:
    """What the modules read of a header of level panoramas in a row; each edge blends its two views."""
    spots = [
        {"position": place, "mark": [place[0], place[1] + 1.5, place[2]], "name": "", "clearances": []}
        | {"ahead": [0.0, 0.0], "turns": [0.0] * 24}
        for place in ROW
    ]
    house = make_house([node for node, part in enumerate(PARTS) if part == 0])
    return msgspec.to_builtins(PageConstants()) | {
        "spots": spots,
        "views": [{"count": 1, "start": view} for view in range(len(ROW))],
        "level": np.eye(3).tolist(),
        "walk": [*range(len(ROW))],
        "edges": [(*edge, group) for group, edge in enumerate(EDGES)],
        "groups": [sorted({*edge}) for edge in EDGES],
        "parts": PARTS,
        "limits": [2.0] * (max(PARTS) + 1),
        "poor": [],
        "next": [],
        "doll": [house | {"moves": [(0.0, *ROW[node]) for node in house["nodes"]]}],
    }


SORTED = "state.sorted = { position: [0, 0, 0], part: 0, views: [0, 1], arrived: 0 };"


def test_the_graph_of_the_page_is_that_of_the_tour(node: str, tmp_path: Path) -> None:
    row = [(0, 0, 0), (0, 0.1, 1), (0, 0, 2), (0.2, 0, 3), (1, 0, 1), (1, 0, 2.2), (2, 0, 2), (0.5, 0, 2.9)]
    others = [(9, 0, 0), (9, 0, 9), (10, 0, 9.5)]  # parts of one and of two panoramas
    places = np.array([*row, *others])
    poses = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
    poses[:, :3, 3] = torch.from_numpy(places)
    edges = [(0, 1), (1, 2), (2, 3), (1, 4), (2, 5), (4, 5), (5, 6), (3, 7), (8, 8), (9, 10)]
    links = {6: (Link("8", 0.0),), 8: (Link("10", 0.0),)}
    panoramas = tuple(Panorama(str(node), Path(), pose, links=links.get(node, ())) for node, pose in enumerate(poses))
    overlaps = {edge: 0.1 + 0.02 * edge[1] for edge in edges}
    random = np.random.default_rng(1)
    clearances = {node: random.choice([0, 0.3, 0.5, 1, 3], (12, 24)) for node in (0, 1, 5, 8)}
    poor = ((1, 2), (4, 5))
    tour = TourGraph("", Path(), panoramas, 0.5, 10.0, (), overlaps, poor=poor, clearances=clearances)
    graph = {
        "positions": places.tolist(),
        "parts": tour.parts,
        "edges": edges,
        "next": find_next_nodes(tour),
        "poor": tour.poor,
        "clearances": [clearances[view].tolist() if view in clearances else [] for view in range(len(places))],
        "level": tour.level_axes.tolist(),
        "hysteresis": EDGE_HYSTERESIS,
        "reach": PageConstants().reach,
    }
    random = np.random.default_rng(0)
    positions = random.uniform((-1, -0.5, -1), (3, 0.5, 4), (60, 3))
    positions[40:] = random.uniform((3, -0.5, -1), (11, 0.5, 11), (20, 3))
    nodes, current = range(len(places)), random.integers(len(edges), size=60)
    starts = positions + random.uniform(-0.4, 0.4, (60, 3))
    program = """(graph, positions, current, starts) => positions.map((position, i) => ({
        nearest: graph.edges[nearestEdge(graph, position)],
        ofPart: graph.edges[nearestEdge(graph, position, partOfEdge(graph, current[i]))],
        followed: graph.edges[followEdge(graph, position, current[i])],
        ways: graph.positions.map((_, node) => findWay(graph, position, node)),
        waysOfPart: graph.positions.map((_, node) => findWay(graph, position, node, 0)),
        zooms: graph.positions.map((_, node) => isZoom(graph, node, graph.edges[current[i]][0])),
        step: limitStep(graph, starts[i], position),
    }))"""
    values = (graph, positions.tolist(), current.tolist(), starts.tolist())
    found = run(node, tmp_path, make_header(), program, *values)
    for position, number, case in zip(positions, current, found, strict=True):
        edge = edges[number]
        assert tuple(case["nearest"]) == tour.find_nearest_edge(position)[0]
        assert tuple(case["ofPart"]) == tour.find_nearest_edge(position, tour.parts[edge[0]])[0]
        assert tuple(case["followed"]) == follow_edge(tour, position, edge)
        assert case["ways"] == [find_way(tour, position, node) for node in nodes]
        assert case["waysOfPart"] == [find_way(tour, position, node, 0) for node in nodes]
        assert case["zooms"] == [tour.is_zoom(node, edge[0]) for node in nodes]
    steps = [limit_step(tour, start, end) for start, end in zip(starts, positions, strict=True)]
    np.testing.assert_allclose([case["step"] for case in found], steps, atol=1e-9)
    free = dataclasses.replace(tour, clearances={})
    along = [limit_step(free, start, end) for start, end in zip(starts, positions, strict=True)]
    for before, after in ((positions, along), (along, steps)):
        assert 0 < np.any(np.abs(np.array(before) - after) > 1e-6, axis=1).sum() < 30
    followed = [tuple(case["followed"]) for case in found]
    assert len({edge == tuple(case["nearest"]) for edge, case in zip(followed, found, strict=True)}) == 2, "hysteresis"
    pairs = zip(followed, current, strict=True)
    parts = [(tour.parts[edge[0]], tour.parts[edges[number][0]]) for edge, number in pairs]
    assert len({a == b for a, b in parts}) == 2, "a position near another part is in it"


def test_a_way_ends_in_the_start_view_or_straight_on_and_away_from_the_link_back(node: str, tmp_path: Path) -> None:
    header = make_header()
    header["plan"] = {"worlds": [0, 0, 0, 1]}
    header["links"] = [{"from": 3, "to": 2, "yaw": 1.0, "pitch": -0.6}]
    for number, spot in enumerate(header["spots"]):
        spot |= {"ahead": [0.4, 0.3], "hasStart": number == 1}
    headings = run(node, tmp_path, header, "() => [[0, 1], [1, 0], [3, 2], [0, 3]].map((way) => findHeading(...way))")
    level = [{"yaw": 0, "pitch": 0}, {"yaw": math.pi, "pitch": 0}]
    assert headings == [*level, {"yaw": 1.0, "pitch": -0.2}, None], "not down to the floor; of another world"
    program = "(ways) => ways.map(([node, heading, from]) => Object.values(chooseArrival(node, heading, from)))"
    way = {"yaw": 2.0, "pitch": 0.2}
    ways = [[1, way], [0, way], [0, None], [3, way, 2], [1, way, 2], [2, None, 3]]
    found = run(node, tmp_path, header, program, ways)
    assert found == [[0.4, 0.3], [2, 0], [0.4, 0.3], [1 + math.pi, 0], [0.4, 0.3], [0.4, 0.3]]
    for spot in header["spots"]:
        spot["turns"] = [0.1 * number for number in range(24)]
    found = run(node, tmp_path, header, program, [[1, way], [0, way], [3, way, 2]])
    bins = [math.floor((angle / (2 * math.pi) + 0.5) * 24) for angle in (2.0, 1 - math.pi)]
    expected = [0.4, 2 + 0.1 * bins[0], 1 + math.pi + 0.1 * bins[1]]
    assert [yaw for yaw, _ in found] == pytest.approx(expected), "from a wall that is close, but for a start view"


def test_a_camera_stays_at_photographs_without_gaussians(node: str, tmp_path: Path) -> None:
    header = make_header() | {"limits": [0, 2]}
    program = f"""() => {{
        {SORTED}
        walk(0.1, 0, 0.1);
        return [camera.position, cameraFor({{ position: [0.3, 0, 1.2] }}).position, isFixed()];
    }}"""
    assert run(node, tmp_path, header, program) == [[0, 0, 0], [0, 0, 2], True], "a script places it at one, too"


def test_walking_stays_near_the_edges_and_slows_down_at_the_limit(node: str, tmp_path: Path) -> None:
    program = f"""() => {{
        {SORTED}
        const places = [];
        for (let k = 0; k < 400; k++) {{ walk(0.05, 0, 0); places.push([...camera.position]); }}
        return places;
    }}"""
    places = np.array(run(node, tmp_path, make_header(), program))
    steps = np.diff(places[:, 0])
    assert (places[:, 1:] == 0).all() and 1.9 < places[-1, 0] <= 2 and (steps >= 0).all()
    assert steps[0] == pytest.approx(0.05) and steps[-1] < 0.005


def test_a_walk_stops_before_surfaces_but_a_script_may_place_the_camera_there(node, tmp_path) -> None:
    """The surfaces around the first panorama are 0.6 m away."""
    header = make_header() | {"limits": [30.0] * 2}
    header["spots"][0]["clearances"] = [[0.6] * 24] * 12
    program = f"""(walks) => {{
        {SORTED}
        return walks.map(([position, ...step]) => {{
            camera.position = cameraFor({{ position }}).position;
            const placed = [...camera.position];
            for (let k = 0; k < 99; k++) walk(...step);
            return [placed, camera.position];
        }});
    }}"""
    walks = [((0, 0, 0), *step) for step in ((0.03, 0, 0), (0, -0.03, 0), (0, 0, -0.03), (0.02, 0.02, 0))]
    walks += [((0.9, 0, 0), -0.03, 0, 0), ((0.33, 0, -0.1), 0.02, 0, 0.004)]
    *ends, (placed, back), (_, slid) = run(node, tmp_path, header, program, walks)
    assert [math.dist(end, start) for start, end in ends] == pytest.approx([0.35] * 4, abs=0.031)
    assert placed[0] == pytest.approx(0.9, abs=0.01) and back[0] < 0.3, "it can go back"
    assert slid[2] > 0 and math.hypot(slid[0], slid[2]) < 0.36, "it slides along"


def test_nothing_walks_before_the_gaussians_are_sorted_or_in_the_dolls_house(node: str, tmp_path: Path) -> None:
    program = f"""() => {{
        walk(1, 0, 0);
        const before = [...camera.position];
        {SORTED}
        state.doll.isOn = true;
        walk(1, 0, 0);
        return [before, camera.position];
    }}"""
    assert run(node, tmp_path, make_header(), program) == [[0, 0, 0], [0, 0, 0]]


def test_the_views_of_the_edge_are_blended_and_those_of_the_edge_before_fade_out(node: str, tmp_path: Path) -> None:
    program = """() => {
        shown.fill(1);
        const weights = [], across = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]];
        camera.position = [0, 0, 1.5];
        weights.push(blendWeights({ position: camera.position, rotation: across }));
        camera.position = [0, 0, 3];
        for (const now of [0, 250, 500, 1000]) {
            updateEdge(now);
            weights.push(blendWeights({ position: camera.position, rotation: across }));
        }
        return [weights, state.edge, state.fade];
    }"""
    header = make_header()
    weights, edge, fade = run(node, tmp_path, header, program)
    assert weights[0] == pytest.approx([0.25, 0.75, 0, 0]) and weights[-1] == pytest.approx([0, 0.5, 0.5, 0])
    assert [row[0] > 0 for row in weights] == [True, True, True, True, False] and (edge, fade) == (1, None)
    assert all(sum(row) == pytest.approx(1) for row in weights)


def test_a_picture_blends_views_as_pansplat_does(node: str, tmp_path: Path) -> None:
    """By their distance, and by whether they are ahead."""
    header = make_header()
    random = np.random.default_rng(0)
    places = [[0.0, 0.0, 0.0], *random.uniform((-1, -1, 0), (1, 1, 2), (9, 3)).tolist()]
    rotations = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in places]
    seen = [{"position": place, "rotation": turn.tolist()} for place, turn in zip(places, rotations, strict=True)]
    found = run(node, tmp_path, header, "(seen) => (shown.fill(1), seen.map(blendWeights))", seen)
    positions = torch.tensor(ROW[:2], dtype=torch.float64)
    for place, turn, weights in zip(places, rotations, found, strict=True):
        expected = blend_weights(torch.tensor(place).double(), positions, torch.from_numpy(turn[:, 2]))
        assert weights == pytest.approx([*expected.clamp_min(1e-4).tolist(), 0, 0])


# Where the corners of the doll's house are in the picture, from -1 to 1, and how far away.
PROJECT = """const project = (size) => findHouse().corners.map((place) => {
    const [x, y, z] = inAxes(rotationOf(camera), minus(place, camera.position));
    const scale = 1 / z / tangentOf(...size, camera.fov);
    return [x * scale * size[1] / size[0], y * scale, z];
});"""


def test_the_dolls_house_is_in_the_picture_and_a_zoom_has_limits(node: str, tmp_path: Path) -> None:
    program = f"""(size) => {{
        {PROJECT}
        Object.assign(camera, frameDoll(size));
        const seen = project(size);
        zoomDoll(100);
        const far = state.doll.zoom;
        orbit(1, 9);
        return [seen, far, camera.pitch, HEADER.spots.map((_, node) => isInDoll(node))];
    }}"""
    for size in ((1280, 720), (390, 844)):
        corners, far, pitch, inside = run(node, tmp_path, make_header(), program, size)
        *places, distances = np.array(corners).T
        assert 0.8 < np.abs(places).max() <= 1 and distances.min() > 0
        assert far == 2 and pitch == pytest.approx(-np.pi * 8 / 180) and inside == [True, True, True, False]


def test_the_dolls_house_stays_in_the_picture_when_it_is_turned(node: str, tmp_path: Path) -> None:
    """The house is 2 m wide and 6 m long; at first a phone shows it lengthwise."""
    program = f"""(size) => {{
        {PROJECT}
        Object.assign(camera, frameDoll(size));
        const turns = Array.from({{ length: 24 }}, (_, step) => {{
            orbit(Math.PI / 12, step < 12 ? 0.05 : -0.05);
            return [distanceOf(camera.position, state.doll.center), project(size)];
        }});
        return [turns, state.doll.first];
    }}"""
    turns, first = run(node, tmp_path, make_header(), program, (390, 844))
    distances, corners = zip(*turns, strict=True)
    assert (
        np.abs(corners)[..., :2].max() <= 1
        and min(distances) == pytest.approx(first, rel=0.01)
        and max(distances) > 1.3 * first
    )


def test_the_dolls_house_is_beside_an_open_floor_plan_and_below_it_on_a_phone(node: str, tmp_path: Path) -> None:
    program = f"""(size, covered) => {{
        {PROJECT}
        state.doll.covered = covered;
        Object.assign(camera, frameDoll(size));
        return project(size);
    }}"""
    for size, axis in (((720, 640), 0), ((320, 640), 1)):
        found = (np.array(run(node, tmp_path, make_header(), program, size, [bar, bar]))[:, axis] for bar in (300, 0))
        covered, free = (0.5 * size[axis] * (1 + places) for places in found)
        assert min(covered) >= 300 and max(covered) <= size[axis] - 56 * axis and min(free) < 300, "above the buttons"


def test_a_ray_meets_the_nearest_front_of_the_dolls_house(node: str, tmp_path: Path) -> None:
    rays = {
        "the floor": ((0, -8, 2), (0, 1, 0), 9.5),
        "the wall": ((0, 0, -9), (0, 0, 1), 14),
        "the back of the wall": ((0, 0, 9), (0, 0, -1), None),
        "the top of the wall": ((0.5, -8, 5.15), (0, 1, 0), None),
        "above the wall": ((0, -2, -9), (0, 0, 1), None),
        "behind": ((0, -8, 2), (0, -1, 0), None),
    }
    program = "(rays) => rays.map(([origin, ray]) => meetHouse(origin, ray))"
    found = run(node, tmp_path, make_header(), program, [ray[:2] for ray in rays.values()])
    assert dict(zip(rays, found, strict=True)) == {name: distance for name, (*_, distance) in rays.items()}


def test_a_pose_is_moved_to_within_the_limits_and_must_be_finite(node: str, tmp_path: Path) -> None:
    program = """() => {
        const far = cameraFor({ position: [9, 0, 1], pitch: 500, fov: 400 });
        try { cameraFor({ yaw: "x" }); } catch (error) { return [far, error.message]; }
    }"""
    far, message = run(node, tmp_path, make_header(), program)
    assert far["position"] == pytest.approx([2, 0, 1]) and far["fov"] == 130 and "finite" in message
    assert far["pitch"] == pytest.approx(np.radians(89.9)) and far["yaw"] == 0
