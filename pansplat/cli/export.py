"""`pansplat export`: a scene file in another format; panoramas as a web page, plan, training set or photographs.

Each kind of file is a dataclass of the options that only it has.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from msgspec import Meta
from tyro.conf import Positional

from pansplat.cli.inputs import Computation, Out, ScenePrediction
from pansplat.errors import InputError
from pansplat.system.console import progress_bar
from pansplat.system.descriptions import describe_count, list_first
from pansplat.system.files import (
    SCENE_SUFFIXES,
    find_scene_suffix,
    is_scene_file,
    require_new_folder,
    require_output_file,
    require_output_folder,
    require_replaceable,
)
from pansplat.system.options import Count, Real
from pansplat.system.progress import report_progress, stage

if TYPE_CHECKING:
    from pansplat.gaussians.scene import Scene
    from pansplat.inputs.panorama_sets import PanoramaSet

_INDEX_NAME = "index.html"  # name of the page in a folder
_MIN_GAUSSIANS, _GOOD_GAUSSIANS = 12_000, 20_000  # for each panorama: least without a note; suggested
_MAX_GAUSSIANS = 2_000_000  # most Gaussians that the note suggests for a page in one file
_MIN_POINT_OPACITY, _MAX_POINTS = 0.1, 200_000  # points of a training set: least opacity, and their number


@dataclass(frozen=True)
class _SceneFile:
    """For a file of Gaussians, or of points."""

    suffixes: ClassVar = SCENE_SUFFIXES
    files: ClassVar = "a .ply"

    points: bool = False
    """Write a .ply of plain points with colours, for programs without Gaussians."""

    def write(self, export: Export) -> None:
        """Write the scene of a file with each surface once, or with --layers all Gaussians, and print its size."""
        from pansplat.gaussians.formats import save_scene
        from pansplat.gaussians.ply import save_points

        if self.points and find_scene_suffix(export.out) != ".ply":
            raise InputError(f"--points is for {self.files}, got {export.out}; leave it out")
        if not is_scene_file(export.path):
            raise InputError(
                f"{export.path}: needed a scene file to write {export.out}, got another path; pansplat predict makes "
                "scenes of panoramas"
            )
        scene, _ = export.open(joint=not export.layers)
        write, kind = (save_points, "points") if self.points else (save_scene, "Gaussians")
        write(scene, export.out)
        size, count = export.out.stat().st_size, len(scene.gaussians)
        print(f"{export.out}: {count:,} {kind}, {size:,} bytes ({size / max(count, 1):.1f} each)")


@dataclass(frozen=True)
class _FloorPlan:
    """For a floor plan."""

    suffixes: ClassVar = (".svg", ".png")
    files: ClassVar = "a floor plan"

    def write(self, export: Export) -> None:
        """Write the plan and print its rooms."""
        from pansplat.export.plan_files import describe_plan, write_plan

        if export.prediction.options.refine_steps is None:  # a refinement moves walls by less than their uncertainty
            options = dataclasses.replace(export.prediction.options, refine_steps=0)
            export = dataclasses.replace(export, prediction=dataclasses.replace(export.prediction, options=options))
        scene, photographs = export.open()
        plan = write_plan(scene, export.out, photographs[0].folder if photographs else None)
        print(f"{export.out}: {'; '.join(describe_plan(plan))}")


@dataclass(frozen=True)
class Page:
    """For a web page."""

    suffixes: ClassVar = (".html", "")
    files: ClassVar = "an .html page"

    gaussians: Count | None = None
    """Largest number of Gaussians: 600,000 by default, beside photographs in one file 300,000 to 450,000, as these
    leave bytes. The prediction has so many; similar neighbours of a scene file are merged."""
    photo_height: Annotated[int, Meta(ge=0, le=4096)] | None = None
    """Largest height of the photographs that the page shows at panoramas; 0 for none. By default what fits into 15 MB,
    at least 1024, in a folder that of the files, at most 4096."""
    serve: bool = False
    """Then show the page to headsets and phones in the local network, by https, until Ctrl+C."""
    title: str | None = None
    """Title of the page; by default the name of the scene."""
    address: str | None = None
    """Address that a folder will have on the web (https://...), for the picture in previews of links to it."""

    def write(self, export: Export) -> None:
        """Write the page, print its size, and serve it."""
        from pansplat.export.page import GAUSSIAN_BYTES, choose_gaussians, write_page
        from pansplat.export.page_server import serve_page

        out, split = export.out, not export.out.suffix
        if self.address is not None and not (split and self.address.startswith(("http://", "https://"))):
            wrong = f"{self.address!r} for {out}"
            raise InputError(f"--address: needed https://... and a folder, got {wrong}; give a whole address and NAME/")
        if split:
            require_output_folder("--out", out)
            require_replaceable("--out", [out / _INDEX_NAME], export.overwrite)
            out = out / _INDEX_NAME
        shows_all = not export.crop  # photographs would show what a crop leaves out
        has_photographs = shows_all and self.photo_height != 0 and not is_scene_file(export.path)

        def choose_count(heights: Sequence[int]) -> int:
            shown = heights if has_photographs and not split else ()
            return self.gaussians or choose_gaussians([min(height, self.photo_height or height) for height in shown])

        with progress_bar():
            with stage(0.8):
                scene, photographs = export.open(choose_count)
            count = choose_count([photograph.image_height for photograph in photographs])
            out.parent.mkdir(parents=True, exist_ok=True)
            page = write_page(
                scene,
                out,
                gaussians=count,
                split=split,
                title=self.title or _name_page(export.path, photographs),
                address=self.address,
                photographs=photographs if shows_all else (),
                photo_height=self.photo_height,
            )
        beside = f" and {len(page.files) - 1} files in {page.files[1].parent.name}/" if split else ""
        pictures, rows = "", max((photograph.image_height for photograph in photographs), default=0)
        if has_photographs:
            kept = f"{page.photo_height} rows" if page.photo_height == rows else f"{page.photo_height} of {rows} rows"
            all_kept = "" if page.photo_height >= min(rows, 4096) or split else " (a folder, -o NAME, keeps all)"
            pictures = f" {describe_count(len(photographs), 'photograph')} of {kept}{all_kept},"
        how = "upload them, or show them with --serve" if split else "open it in a browser"
        print(f"{out}{beside}: {page.num_gaussians:,} Gaussians,{pictures} {page.num_bytes / 1e6:.1f} MB; {how}")
        if page.zooms:
            flights, zooms = describe_count(page.num_flights, "flight"), describe_count(len(page.zooms), "zoom")
            names = list_first([" and ".join(ends) for ends in page.zooms])
            print(
                f"note: {out}: {flights} between panoramas, and {zooms} ({names}), because their surfaces disagree; "
                "one more photograph between two such panoramas would help",
                file=sys.stderr,
            )
        if page.num_outside:
            views, why = describe_count(page.num_outside, "panorama"), "fewer than half of the rooms there have walls"
            print(f"note: {out}: without doll's house of {views}, because {why} on the floor plan", file=sys.stderr)
        if photographs and not shows_all:
            print(f"note: {out}: without photographs, which would show what is left out", file=sys.stderr)
        panoramas = max(len(scene.cam2world), 1)
        if self.gaussians is None and count // panoramas < _MIN_GAUSSIANS:
            more = min(_GOOD_GAUSSIANS * panoramas, _MAX_GAUSSIANS)
            size = (page.num_bytes + GAUSSIAN_BYTES * (more - page.num_gaussians)) / 1e6
            print(
                f"note: {out}: {count // panoramas:,} Gaussians for each of {describe_count(panoramas, 'panorama')}; "
                f"--gaussians {more} shows more detail in about {size:.0f} MB",
                file=sys.stderr,
            )
        if self.serve:
            serve_page(page)


def _name_page(path: Path, photographs: Sequence[PanoramaSet]) -> str:
    """The name of a tour by its author, else that of its folder or file."""
    from pansplat.inputs.web_tours import is_web_tour_file

    named = path.resolve()
    if photographs and is_web_tour_file(named):
        named = named.parent
    tour = photographs[0].context[0].tour if photographs else ""
    name = named.name if named.is_dir() else named.stem.removesuffix(".compressed")
    return tour or name.replace("_", " ")


@dataclass(frozen=True)
class _TrainingSet:
    """For a folder to train further from."""

    suffixes: ClassVar = ()
    files: ClassVar = "a folder to train from"

    training_set: bool = False
    """Write a folder to train further from: cube faces with poses, and points."""

    @progress_bar()
    def write(self, export: Export) -> None:
        """Write cube faces, poses and points to a new folder."""
        import torch

        from pansplat.export.training_set import POINTS, write_dataset
        from pansplat.gaussians.ply import make_colors, save_points
        from pansplat.gaussians.scene import prune
        from pansplat.inputs.reconstructions.nerfstudio import Z_UP
        from pansplat.system.atomic import replacing_folder

        require_new_folder("--out", export.out)
        if export.crop or export.remove_floaters:
            raise InputError(f"--crop and --remove-floaters are not for {self.files}, got {export.out}; leave them out")
        if is_scene_file(export.path):
            raise InputError(
                f"{export.path}: needed the folder of the panoramas to write their cube faces, got a scene file; give "
                "the folder"
            )
        with stage(0.8):
            scene, source = export.prediction.open(export.path, joint=not export.layers)
        assert source is not None
        gaussians = prune(scene.gaussians, degree=0, min_opacity=_MIN_POINT_OPACITY)
        gaussians = gaussians.select(torch.isfinite(gaussians.means).all(dim=1))
        if len(gaussians) > _MAX_POINTS:
            chosen = torch.randperm(len(gaussians), generator=torch.Generator().manual_seed(0))[:_MAX_POINTS]
            gaussians = gaussians.select(chosen.sort().values)
        views = [
            dataclasses.replace(panorama, cam2world=pose)
            for panorama, pose in zip(source.panoramas, scene.frame.globalize(scene.cam2world), strict=True)
        ]
        means = scene.frame.globalize_places(gaussians.means).cpu().numpy()
        colors = make_colors(gaussians).cpu().numpy()
        with replacing_folder(export.out) as folder:
            count = write_dataset(folder, views, source.siblings, means, colors)
            save_points(dataclasses.replace(scene, gaussians=gaussians).rotated(Z_UP[:3, :3]), folder / POINTS)
        print(
            f"{export.out}: {count} cube faces of {describe_count(len(views), 'panorama')}, "
            f"{len(gaussians):,} points; sparse/0 is a "
            "model of COLMAP, transforms.json is for nerfstudio"
        )


@dataclass(frozen=True)
class _Photographs:
    """For a folder of photographs."""

    suffixes: ClassVar = ()
    files: ClassVar = "a folder of photographs"

    photos: bool = False
    """Write the panoramas of a tour as 2:1 photographs to a new folder, with titles, links, notes and start views. Blur
    masks are applied; no poses are estimated or written."""

    @progress_bar()
    def write(self, export: Export) -> None:
        """Write the photographs and print their size."""
        from pansplat.export.panoramas import write_panoramas
        from pansplat.inputs.folders import load_panoramas
        from pansplat.system.atomic import replacing_folder

        require_new_folder("--out", export.out)
        if is_scene_file(export.path):
            raise InputError(
                f"{export.path}: needed a tour or a folder of panoramas, got a scene file; give the folder"
            )
        panoramas = load_panoramas(export.path)
        with replacing_folder(export.out) as folder:
            size = write_panoramas(folder, panoramas)
        print(f"{export.out}: {describe_count(len(panoramas), 'photograph')}, {size / 1e6:.1f} MB")


@dataclass(frozen=True)
class Export(Computation):
    """Write a scene file in the format of another suffix (docs/formats.md), or a scene, pair or tour as a web page
    (.html, or a name without suffix for a folder that any web server shows; docs/web.md), as a floor plan with straight
    walls and areas (.svg, .png), or as a folder to train further from (--training-set): cube faces, poses and points
    for COLMAP, nerfstudio, gsplat and brush."""

    path: Positional[Path]
    """A scene file, one panorama, a folder of panoramas, with or without poses, or a web tour."""
    out: Out
    """The file to write: of a scene file .ply, .compressed.ply, .spz, .splat, .sog or .glb; .html for a web page;
    .svg or .png for a floor plan. A folder, without a suffix, for a web page with photographs of their own
    resolution, which are loaded as they are needed; a new one with --training-set for cube faces with poses, and with
    --photos for the photographs of a tour."""
    degree: Annotated[int, Meta(ge=0, le=4)] | None = None
    """Highest degree of spherical harmonics to write, 0 to 4; by default all that the format holds."""
    crop: tuple[Real, Real, Real, Real, Real, Real] | None = None
    """Keep what is in a box: x, y and z of two opposite corners, metres, in the axes of the poses. Cameras outside are
    left out."""
    remove_floaters: bool = False
    """Leave out isolated Gaussians in free space."""
    layers: bool = False
    """Keep all Gaussians of each view of a scene file or training set, for deferred blending. By default each surface
    is kept once, for programs that draw all Gaussians together (docs/formats.md)."""
    scene: _SceneFile = field(default_factory=_SceneFile)
    page: Page = field(default_factory=Page)
    plan: _FloorPlan = field(default_factory=_FloorPlan)
    training: _TrainingSet = field(default_factory=_TrainingSet)
    panoramas: _Photographs = field(default_factory=_Photographs)
    prediction: ScenePrediction = field(default_factory=ScenePrediction)

    def run(self) -> int:
        """Write the file and print its size."""
        kinds = self.scene, self.page, self.plan, self.training, self.panoramas
        table = {suffix: kind for kind in kinds for suffix in kind.suffixes}
        suffix = self.out.suffix.lower()
        if self.training.training_set or self.panoramas.photos:
            kind = self.training if self.training.training_set else self.panoramas
        else:
            if suffix:
                require_output_file("--out", self.out, tuple(filter(None, table)), overwrite=self.overwrite)
            kind = table[suffix]
        for other in kinds:
            for option in dataclasses.fields(other):
                if other is not kind and getattr(other, option.name) != option.default:
                    name = option.name.replace("_", "-")
                    raise InputError(f"--{name} is for {other.files}, got {self.out}; leave it out")
        kind.write(self)
        return 0

    @progress_bar()
    def open(
        self, choose_count: Callable[[Sequence[int]], int] | None = None, *, joint: bool = False
    ) -> tuple[Scene, list[PanoramaSet]]:
        """The scene of the file, pair or tour as it is to be written, and its photographs.

        Args:
            choose_count: see `ScenePrediction.open`.
            joint: whether each surface of a scene file is kept once.
        """
        from pansplat.export.photographs import list_photographs
        from pansplat.refinement import fuse_views

        with stage(0.9):
            scene, source = self.prediction.open(self.path, choose_count)
        if source is not None:
            edited = self._edit(scene)
            known, views = scene.cam2world.tolist(), range(len(scene.cam2world))
            if len(edited.cam2world) < len(known):  # a crop leaves views out
                views = [known.index(pose) for pose in edited.cam2world.tolist()]
            return edited, list_photographs(source, views)
        if not joint or scene.joint or len(scene.cam2world) < 2:
            return self._edit(scene), []
        print(
            f"note: {self.path}: each surface is kept once (--layers keeps all); pansplat predict of the folder of the "
            "photographs fits the Gaussians to them, too",
            file=sys.stderr,
        )
        return self._edit(fuse_views(scene)), []

    def _edit(self, scene: Scene) -> Scene:
        """The scene with the Gaussians and harmonics that are wanted; what is left out is printed."""
        import torch

        from pansplat.export.floaters import remove_floaters
        from pansplat.gaussians.crop import crop
        from pansplat.gaussians.scene import prune

        steps: dict[str, Callable[[Scene], Scene]] = {}
        if self.crop is not None:
            corners = torch.tensor(self.crop, dtype=torch.float64).reshape(2, 3)
            box = tuple(scene.frame.localize_places(corners).flatten().tolist())
            steps["crop"] = lambda scene: crop(scene, box)
        if self.remove_floaters:
            steps["floaters"] = remove_floaters
        for name, step in steps.items():
            report_progress(name, 0.9)
            count, cameras = len(scene.gaussians), len(scene.cam2world)
            try:
                scene = step(scene)
            except InputError as error:
                raise InputError(f"{self.path}: {error}") from error
            left, cameras_left = count - len(scene.gaussians), cameras - len(scene.cam2world)
            cameras_out = f", and {cameras_left} of {describe_count(cameras, 'camera')}" if cameras_left else ""
            print(f"{name}: {left:,} of {count:,} Gaussians left out{cameras_out}")
        return dataclasses.replace(scene, gaussians=prune(scene.gaussians, degree=self.degree))
