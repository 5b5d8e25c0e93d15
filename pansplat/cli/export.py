"""`pansplat export`: a scene or tour in the formats of other programs, as a web page, mesh, plan or training set."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta
from tyro.conf import Positional

from pansplat.cli.inputs import Out, ScenePrediction, Writer
from pansplat.errors import InputError
from pansplat.system.console import progress_bar
from pansplat.system.files import (
    SCENE_SUFFIXES,
    find_scene_suffix,
    is_scene_file,
    require_new_folder,
    require_output_file,
    require_output_folder,
    require_replaceable,
)
from pansplat.system.options import Count, Fraction, Real

if TYPE_CHECKING:
    from torch import Tensor

    from pansplat.export.cleanup import Change
    from pansplat.export.page import PageFiles
    from pansplat.gaussians.scene import Scene
    from pansplat.inputs.pairs import Pair
    from pansplat.tours import TourGraph

_PAGE_SUFFIX, _PICTURE_SUFFIX, _DRAWING_SUFFIXES, _MESH_SUFFIX = ".html", ".png", (".svg", ".dxf"), ".obj"
_SUFFIXES = (*SCENE_SUFFIXES, _PAGE_SUFFIX, _PICTURE_SUFFIX, *_DRAWING_SUFFIXES, _MESH_SUFFIX)
_INDEX = "index.html"  # of a folder
_TEXTURE_HEIGHT = 2048  # of the photographs on a mesh, at most
_FEW_GAUSSIANS, _GOOD_GAUSSIANS = 12_000, 20_000  # of a panorama in a page
_MOST_GAUSSIANS = 2_000_000  # of a page in one file
_BYTES = 22  # of a Gaussian in a page
_MIN_POINT_OPACITY, _MOST_POINTS = 0.1, 200_000  # of the points to train from


@dataclass(frozen=True)
class Export(Writer):
    """Write a scene, or the prediction of a pair or tour, in the format of the file's suffix (docs/formats.md), as a
    web page (.html, or a name without suffix for a folder that any web server shows; docs/web.md), as a floor plan
    with straight walls and areas (.svg, .png, .dxf), as textured triangles (.obj, .glb with --mesh), or as a folder
    to train further from (--training-set): cube faces, poses and points for COLMAP, nerfstudio, gsplat and brush."""

    path: Positional[Path]
    """A scene file, one panorama, a folder of panoramas, with or without poses, or a web tour."""
    out: Out
    """The file to write: .ply, .compressed.ply, .spz, .splat, .sog or .glb; .html for a web page; .svg, .dxf or .png
    for a floor plan; .obj for a mesh. A folder, without a suffix, for a web page with photographs of their own
    resolution, which are loaded as they are needed; with --training-set a new one for cube faces with poses."""
    training_set: bool = False
    """Write a folder to train further from: cube faces with poses, and points."""
    mesh: bool = False
    """Write a .glb of triangles with the photographs as textures. An .obj always has them."""
    triangles: Count | None = None
    """For a mesh: largest number of triangles, 2,000,000 by default."""
    points: bool = False
    """Write a .ply of plain points with colours, for programs without Gaussians."""
    degree: Annotated[int, Meta(ge=0, le=4)] | None = None
    """Highest degree of spherical harmonics to write, 0 to 4; by default all that the format holds."""
    min_opacity: Fraction = 0.0
    """Leave out Gaussians of lower opacity; those below 0.004 are invisible."""
    crop: tuple[Real, Real, Real, Real, Real, Real] | None = None
    """Keep what is in a box: x, y and z of two opposite corners, metres, in the axes of the poses. Cameras outside are
    left out."""
    rooms: tuple[str, ...] = ()
    """Keep these rooms of the floor plan, by their names or by those of panoramas in them."""
    floaters: bool = True
    """Keep isolated Gaussians in free space; --no-floaters leaves them out."""
    up: Literal["y", "z"] | None = None
    """Axis of a given file that points up, if its program did not keep to the axes of the format."""
    layers: bool = False
    """Keep all Gaussians of each view, for deferred blending. By default each surface is kept once, for programs that
    draw all Gaussians together (docs/formats.md)."""
    gaussians: Count | None = None
    """For a page: largest number of Gaussians, 600,000 by default, beside photographs in one file 450,000; similar
    neighbours are merged."""
    photo_height: Annotated[int, Meta(ge=0, le=4096)] | None = None
    """For a page: largest height of the photographs that it shows at panoramas; 0 for none. By default what fits into
    15 MB, at least 1024, in a folder and with --split that of the files, at most 4096."""
    split: bool = False
    """For .html: write the data to a folder beside the page, for scenes that are large for one file."""
    serve: bool = False
    """For .html: then show the page to headsets and phones in the local network, by https, until Ctrl+C."""
    embed: tuple[str, ...] = ()
    """For .html: origins, such as https://example.com, of pages that may move the camera of this one in a frame; with
    --serve only they may show it in a frame."""
    title: str | None = None
    """For .html: title of the page; by default the name of the scene."""
    prediction: ScenePrediction = field(default_factory=ScenePrediction)

    def run(self) -> int:
        """Write the file and print its size."""
        from pansplat.export.page import parse_origins
        from pansplat.gaussians.formats import save_scene
        from pansplat.gaussians.ply import save_points

        is_dataset, is_folder = self.training_set, not self.out.suffix
        if is_dataset:
            require_new_folder("--out", self.out)
        elif is_folder:
            require_output_folder("--out", self.out)
            require_replaceable("--out", [self.out / _INDEX], self.overwrite)
        else:
            require_output_file("--out", self.out, _SUFFIXES, overwrite=self.overwrite)
        suffix = self.out.suffix.lower()
        is_page = (is_folder and not is_dataset) or suffix == _PAGE_SUFFIX
        is_picture, is_drawing = suffix == _PICTURE_SUFFIX, suffix in _DRAWING_SUFFIXES
        is_mesh = self.mesh or suffix == _MESH_SUFFIX
        if self.mesh and suffix not in (_MESH_SUFFIX, ".glb"):
            raise InputError(f"--mesh writes a .glb or .obj, got {self.out}; leave it out, or choose another name")
        if self.triangles is not None and not is_mesh:
            raise InputError(f"--triangles is for a mesh (.obj, or .glb with --mesh), got {self.out}; leave it out")
        is_scene = not (is_page or is_picture or is_drawing or is_dataset or is_mesh)
        if self.points and not (is_scene and find_scene_suffix(self.out) == ".ply"):
            raise InputError(f"--points writes a .ply, got {self.out}; leave it out, or choose another name")
        of_page = (self.gaussians is not None, self.split, self.serve, self.embed, self.title is not None)
        if not is_page and any((*of_page, self.photo_height is not None)):
            names = "--gaussians, --photo-height, --split, --serve, --embed and --title"
            raise InputError(f"{names} are for an .html page, got {self.out}; leave them out")
        parse_origins(self.embed)
        if self.up is not None and not is_scene_file(self.path):
            raise InputError(f"--up is for a scene file, and {self.path} is a folder of panoramas; leave it out")
        if is_dataset and (self.crop or self.rooms or not self.floaters):
            names = "--crop, --rooms and --no-floaters"
            raise InputError(f"{names} are not for a folder to train from, got {self.out}; leave them out")
        if is_dataset:
            self._write_dataset()
            return 0
        if is_mesh:
            self._write_mesh()
            return 0
        scene, layers, source = self._open(not is_scene, is_page)
        scene, changes = self._edit(scene, layers)
        if is_page:
            page = self._write_page(scene, source)
            _print_changes(changes)
            if self.serve:
                from pansplat.export.page_server import serve_page

                serve_page(page)
        elif is_drawing or is_picture:
            from pansplat.export.plan_files import describe_plan, write_picture, write_plan

            plan = write_plan(scene, self.out) if is_drawing else write_picture(scene, self.out)
            floors = [f"the floors of {len(scene.cam2world)} panoramas"]
            print(f"{self.out}: {'; '.join(floors if plan is None else describe_plan(plan))}")
        else:
            if self.points:
                save_points(scene, self.out)
            else:
                save_scene(scene, self.out)
            size, count = self.out.stat().st_size, len(scene.gaussians)
            kind = "points" if self.points else "Gaussians"
            print(f"{self.out}: {count:,} {kind}, {size:,} bytes ({size / max(count, 1):.1f} each)")
        if not is_page:
            _print_changes(changes)
        return 0

    def _open(self, in_layers: bool, is_page: bool) -> tuple[Scene, Scene | None, Pair | TourGraph | None]:
        """The scene of the file, pair or tour; of a file for other programs with each surface once.

        Also the scene with all that each panorama shows, if the rooms of one with each surface once are looked for; and
        the pair or tour.
        """
        from pansplat.refinement import fuse_views

        joint = not in_layers and not self.layers
        count = self._count_of_page() if is_page else None
        if not is_scene_file(self.path):
            scene, source = self.prediction.open_panoramas(self.path, count, joint=joint)
            return scene, self.prediction.predict_layers(source) if self.rooms and scene.joint else None, source
        scene = self.prediction.open(self.path)
        if not joint or scene.joint or len(scene.cam2world) < 2:
            return scene, None, None
        print(
            f"note: {self.path}: each surface is kept once (--layers keeps all); an export of the folder of the "
            "photographs fits the Gaussians to them, too",
            file=sys.stderr,
        )
        return fuse_views(scene), scene, None

    def _edit(self, scene: Scene, layers: Scene | None = None) -> tuple[Scene, list[Change]]:
        """The scene with its axis up, and the Gaussians and harmonics that are wanted, and what is left out.

        `layers` is the scene with all that each panorama shows, if `scene` is not.
        """
        import torch

        from pansplat.export.cleanup import Cleaning, clean_up
        from pansplat.gaussians.scene import prune

        if self.up is not None:
            turn = _rotation_from(self.up)
            scene, layers = scene.rotated(turn), None if layers is None else layers.rotated(turn)
        box = self.crop
        if box is not None:
            corners = torch.tensor(box, dtype=torch.float64).reshape(2, 3)
            box = tuple(scene.frame.localize_places(corners).flatten().tolist())
        cleaning = Cleaning(self.rooms, box, self.floaters, self.min_opacity)
        try:
            with progress_bar() as progress:
                scene, changes = clean_up(scene, cleaning, layers, progress)
        except InputError as error:
            raise InputError(f"{self.path}: {error}") from error
        return dataclasses.replace(scene, gaussians=prune(scene.gaussians, degree=self.degree)), changes

    def _write_mesh(self) -> None:
        """Write triangles with textures: of the photographs, or for a scene file of its Gaussians."""
        from pansplat.export.mesh import DEFAULT_TRIANGLES, make_mesh
        from pansplat.export.mesh_files import name_mesh_files, save_mesh
        from pansplat.export.page_photographs import list_photographs

        require_replaceable("--out", name_mesh_files(self.out, 1), self.overwrite)  # before the prediction
        load: Callable[[int], Tensor] | None = None
        if is_scene_file(self.path):
            edited, changes = self._edit(self.prediction.open(self.path))
        else:
            scene, source = self.prediction.open_panoramas(self.path)
            edited, changes = self._edit(scene)
            known = scene.cam2world.tolist()
            views = [known.index(pose) for pose in edited.cam2world.tolist()]  # a crop leaves others out

            photographs = list_photographs(source, views)

            def load(number: int) -> Tensor:
                pair = photographs[number]
                return pair.load_context(min(pair.image_height, _TEXTURE_HEIGHT)).images[0]

        mesh = make_mesh(edited, triangles=self.triangles or DEFAULT_TRIANGLES, textures=load)
        files = save_mesh(mesh, self.out, overwrite=self.overwrite)
        size = sum(file.stat().st_size for file in files)
        beside = f" and {len(files) - 1} files beside it" if len(files) > 1 else ""
        count = len(mesh.parts)
        print(
            f"{self.out}{beside}: {mesh.num_triangles:,} triangles of {count} panorama{'s' if count > 1 else ''}, "
            f"{size / 1e6:.1f} MB"
        )
        _print_changes(changes)

    def _write_dataset(self) -> None:
        """Write cube faces, poses and points to a new folder."""
        import torch

        from pansplat.export.training_set import POINTS, PosedPanorama, write_dataset
        from pansplat.gaussians.ply import make_colors, save_points
        from pansplat.gaussians.scene import prune
        from pansplat.inputs.pairs import Pair
        from pansplat.inputs.reconstructions.nerfstudio import Z_UP
        from pansplat.system.atomic import replacing_folder

        if is_scene_file(self.path):
            raise InputError(
                f"{self.path}: needed the folder of the panoramas to write their cube faces, got a scene file; give "
                "the folder"
            )
        scene, source = self.prediction.open_panoramas(self.path, joint=not self.layers)
        gaussians = prune(scene.gaussians, degree=0, min_opacity=max(self.min_opacity, _MIN_POINT_OPACITY))
        gaussians = gaussians.select(torch.isfinite(gaussians.means).all(dim=1))
        if len(gaussians) > _MOST_POINTS:
            chosen = torch.randperm(len(gaussians), generator=torch.Generator().manual_seed(0))[:_MOST_POINTS]
            gaussians = gaussians.select(chosen.sort().values)
        panoramas = source.context if isinstance(source, Pair) else source.panoramas
        views = [
            PosedPanorama(panorama, pose, source.siblings)
            for panorama, pose in zip(panoramas, scene.frame.globalize(scene.cam2world), strict=True)
        ]
        means = scene.frame.globalize_places(gaussians.means).cpu().numpy()
        colors = make_colors(gaussians).cpu().numpy()
        with replacing_folder(self.out) as folder, progress_bar() as progress:
            count = write_dataset(folder, views, means, colors, progress)
            save_points(dataclasses.replace(scene, gaussians=gaussians).rotated(Z_UP[:3, :3]), folder / POINTS)
        print(
            f"{self.out}: {count} cube faces of {len(views)} panoramas, {len(gaussians):,} points; sparse/0 is a model "
            "of COLMAP, transforms.json is for nerfstudio"
        )

    def _count_of_page(self) -> int:
        """The largest number of Gaussians of a page."""
        from pansplat.export.page import DEFAULT_GAUSSIANS, PHOTO_GAUSSIANS

        is_one_file = self.out.suffix and not self.split
        default = PHOTO_GAUSSIANS if is_one_file and self._has_photographs() else DEFAULT_GAUSSIANS
        return default if self.gaussians is None else self.gaussians

    def _has_photographs(self) -> bool:
        """Whether the page shows photographs: they would show what a crop leaves out."""
        return not (is_scene_file(self.path) or self.crop or self.rooms or self.photo_height == 0)

    def _write_page(self, scene: Scene, source: Pair | TourGraph | None) -> PageFiles:
        """Write the web page and print its size."""
        from pansplat.export.page import write_page
        from pansplat.export.page_photographs import list_photographs
        from pansplat.inputs.web_tours import is_web_tour_file

        out, split = (self.out, self.split) if self.out.suffix else (self.out / _INDEX, True)
        out.parent.mkdir(parents=True, exist_ok=True)
        is_whole = source is not None and not (self.crop or self.rooms)
        photographs = list_photographs(source, range(len(scene.cam2world))) if is_whole else []
        named = self.path.resolve()
        if photographs and is_web_tour_file(named):
            named = named.parent
        tour = photographs[0].context[0].tour if photographs else ""
        title = self.title or tour or named.stem.replace("_", " ")
        with progress_bar() as progress:
            page = write_page(
                scene,
                out,
                gaussians=self._count_of_page(),
                split=split,
                title=title,
                embed=self.embed,
                photographs=photographs,
                photo_height=self.photo_height,
                progress=progress,
            )
        beside = f" and {len(page.files) - 1} files in {page.files[1].parent.name}/" if split else ""
        pictures = f" {len(photographs)} photographs of {page.photo_height} rows," if page.photo_height else ""
        print(
            f"{out}{beside}: {page.num_gaussians:,} Gaussians,{pictures} {page.num_bytes / 1e6:.1f} MB; open it in a "
            "browser"
        )
        if page.num_fades:
            counts = f"{page.num_flights} ways between panoramas are flights, {page.num_fades} are fades"
            print(f"note: {out}: {counts}, because the surfaces of their panoramas disagree", file=sys.stderr)
        if (self.crop or self.rooms) and source is not None:
            print(f"note: {out}: without photographs, which would show what is left out", file=sys.stderr)
        panoramas = max(len(scene.cam2world), 1)
        each = self._count_of_page() // panoramas
        if self.gaussians is None and each < _FEW_GAUSSIANS:
            more = min(_GOOD_GAUSSIANS * panoramas, _MOST_GAUSSIANS)
            size = (page.num_bytes + _BYTES * (more - page.num_gaussians)) / 1e6
            print(
                f"note: {out}: {each:,} Gaussians for each of {panoramas} panoramas; "
                f"--gaussians {more} shows more detail in about {size:.0f} MB",
                file=sys.stderr,
            )
        return page


def _print_changes(changes: Sequence[Change]) -> None:
    """Print what was left out, and what that changes."""
    for change in changes:
        print(change)


def _rotation_from(up: Literal["y", "z"]) -> Tensor:
    """Rotation (3, 3) from a world with an axis up to one with y down."""
    import torch

    rows = {"y": ((1.0, 0, 0), (0, -1, 0), (0, 0, -1)), "z": ((1.0, 0, 0), (0, 0, -1), (0, 1, 0))}[up]
    return torch.tensor(rows, dtype=torch.float64)
