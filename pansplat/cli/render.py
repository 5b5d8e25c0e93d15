"""`pansplat render`: images and videos of a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta
from tyro.conf import Positional, arg

from pansplat.cli.inputs import Computation, Out, ScenePrediction, parse_blend
from pansplat.errors import InputError
from pansplat.system.console import progress_bar
from pansplat.system.descriptions import describe_count
from pansplat.system.files import expand_home, require_output_file
from pansplat.system.options import EYE_DISTANCE, EyeDistance, ImageHeight
from pansplat.system.progress import stage

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from pansplat.export.film import Film, Shot
    from pansplat.gaussians.scene import Scene
    from pansplat.inputs.panorama_sets import PanoramaSet
    from pansplat.rendering import Rendering
    from pansplat.tours.camera_path import CameraPath
    from pansplat.tours.graph import TourGraph

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".exr")
_VIDEO_HEIGHT, _PANORAMA_VIDEO_HEIGHT = 1080, 1440  # rows of a video: perspective, and panoramic


@dataclass(frozen=True)
class Render(Computation):
    """Render a scene, or the prediction of a pair or tour, to an image (.png, .jpg, .webp, .exr) or a video (.mp4) that
    shows the photograph while the camera stands at a panorama."""

    path: Positional[Path]
    """A scene file, one panorama, a folder of panoramas, or a web tour."""
    out: Out
    """The file to write; its suffix chooses the format."""
    at: Annotated[float, Meta(ge=0, le=1)] | None = None
    """Camera position between the first (0) and the last (1) input camera, or on the flight through a tour of several
    parts; 0.5 by default."""
    pose: Path | None = None
    """File with the camera pose of an image: a JSON matrix (cam2world, OpenCV axes, metres)."""
    path_file: Annotated[Path | None, arg(name="path")] = None
    """File of a camera path (docs/viewer.md), which the film follows."""
    layout: Literal["equirect", "cubemap", "perspective"] | None = None
    """Panorama with one exact ray per pixel, panorama stitched from six cube faces, or perspective image.
    By default equirect, for a video perspective."""
    stereo: bool = False
    """Stereo panorama for headsets: each pixel column has its own two eyes. The left eye is above the right one."""
    ipd: EyeDistance = EYE_DISTANCE
    """Distance of the eyes for --stereo, metres."""
    height: ImageHeight | None = None
    """Height of the image, pixels; by default that of the input panoramas, for a video 1080 (1920x1080), for one of
    panoramas 1440 (2880x1440)."""
    depth: bool = False
    """Write the depth as a 16-bit .png in millimetres, 0 where there is none; an .exr holds it without this option."""
    blend: str | None = None
    """deferred (images of single views, weighted by nearness), joint (all Gaussians at once), or view0, view1, ...;
    by default what the scene is made for."""
    fov: Annotated[float, Meta(ge=1, le=170)] = 90.0
    """Vertical field of view of `perspective`, degrees."""
    seconds: Annotated[float, Meta(gt=0, le=3600)] | None = None
    """Length of a video; by default that of the ways through all panoramas."""
    fps: Annotated[float, Meta(gt=0, le=240)] = 24.0
    """Frames per second of a video."""
    prediction: ScenePrediction = field(default_factory=ScenePrediction)

    @progress_bar()
    def run(self) -> int:
        """Render one image, or a video along a path of cameras."""
        import torch

        from pansplat import pipeline
        from pansplat.export.film import write_film
        from pansplat.images.image_files import write_depth, write_image
        from pansplat.tours.camera_path import read_path

        self._refuse_invalid_arguments()
        pose = None if self.pose is None else read_pose(self.pose)
        path = None if self.path_file is None else read_path(expand_home(self.path_file))
        with stage(0.5 if self._is_film else 1.0):
            scene, source = self.prediction.open(self.path)
        layout = self.layout or ("perspective" if self._is_film and not self.stereo else "equirect")
        options = self._render_options(layout, self.height or self._choose_height(layout, scene))
        size = f"{options['size'][1]}x{options['size'][0] * (2 if self.stereo else 1)}"
        if self._is_film:
            shots = self._list_shots(scene, path)
            film = self._make_film(scene, source, options, len(shots))
            marks = {
                "panorama": layout != "perspective",
                "stereo": "top-bottom" if self.stereo else "mono",
            }
            write_film(self.out, film, shots, self.fps, **marks)
            print(f"{self.out}: {describe_count(len(shots), 'frame')} of {size}, {layout}")
            return 0
        pose = self._pose_between_cameras(scene) if pose is None else scene.frame.localize(pose)
        with torch.no_grad():
            image = pipeline.make_renderer(scene, "image", 1, **options)(pose)
        panorama = layout != "perspective" and not self.stereo  # GPano has no property for stereo
        depth = image.depth * scene.frame.unit
        if self.depth:
            write_depth(self.out, depth, panorama=panorama)
        else:
            depth = depth if self.out.suffix.lower() == ".exr" else None
            write_image(self.out, image.color, depth=depth, panorama=panorama)
        print(f"{self.out}: {size}, {layout}")
        return 0

    @property
    def _is_film(self) -> bool:
        return self.out.suffix.lower() == ".mp4"

    def _choose_height(self, layout: str, scene: Scene) -> int:
        if not self._is_film:
            return scene.height
        return _VIDEO_HEIGHT if layout == "perspective" else _PANORAMA_VIDEO_HEIGHT

    def _refuse_invalid_arguments(self) -> None:
        """Raise an error before the prediction, which takes seconds."""
        suffixes = (*(() if self.path_file else _IMAGE_SUFFIXES), ".mp4")
        require_output_file("--out", self.out, suffixes, overwrite=self.overwrite)
        if self.depth and self.out.suffix.lower() != ".png":
            raise InputError(f"--depth writes a .png, got {self.out}; an .exr holds the depth without it")
        cameras = {"--at": self.at, "--pose": self.pose, "--path": self.path_file}
        given = [name for name, value in cameras.items() if value is not None]
        if len(given) > 1:
            raise InputError(f"{' and '.join(given)} set the camera; give one of them")
        for name in ("--at", "--pose"):
            if name in given and self._is_film:
                raise InputError(f"{name} is one position, a video moves; write a .png, or leave out {name}")
        if self.stereo and self.layout not in (None, "equirect"):
            raise InputError(f"--stereo is for panoramas of --layout equirect, got {self.layout}; leave out --layout")
        self._parse_blend()

    def _parse_blend(self) -> str | int | None:
        return None if self.blend is None else parse_blend(self.blend)

    def _render_options(self, layout: str, height: int) -> dict[str, Any]:
        """Keyword arguments of `pipeline.render`."""
        options: dict[str, Any] = {"blend": self._parse_blend()}
        if layout == "perspective":
            return options | {
                "layout": "pinhole",
                "size": (height, 2 * round(height * 8 / 9)),
                "vertical_fov_degrees": self.fov,
            }
        stereo = {"eye_distance": self.ipd} if self.stereo else {}
        return options | stereo | {"layout": layout, "size": (height, 2 * height)}

    def _require_cameras(self, scene: Scene, advice: str) -> None:
        if not len(scene.cam2world):
            raise InputError(f"{self.path}: needed input cameras to stand between, got none; {advice}.")

    def _pose_between_cameras(self, scene: Scene) -> Tensor:
        import torch

        from pansplat.export.film import plan_visits
        from pansplat.tours.facts import TourFacts

        self._require_cameras(scene, "give a camera pose with --pose")
        fraction = 0.5 if self.at is None else self.at
        return (
            torch.from_numpy(plan_visits(TourFacts(scene)).pose(fraction))
            if scene.tour
            else scene.pose_between(fraction)
        )

    def _list_shots(self, scene: Scene, path: CameraPath | None) -> list[Shot]:
        """The frames of a film: of a path, or of the flight through all input cameras."""
        from pansplat.export.film import follow_path, list_frames, plan_visits
        from pansplat.tours.facts import TourFacts
        from pansplat.tours.scene_graph import make_graph

        if path is not None:
            return follow_path(path, self.fps, scene, make_graph(scene) if scene.tour else None)
        self._require_cameras(scene, "give a camera path with --path")
        return list_frames(plan_visits(TourFacts(scene)), self.fps, self.fov, self.seconds)

    def _make_film(
        self, scene: Scene, source: PanoramaSet | TourGraph | None, options: dict[str, Any], count: int
    ) -> Film:
        """Draws the scene, and photographs that no option replaces; `count` is the number of frames."""
        import functools

        import torch

        from pansplat import pipeline
        from pansplat.constants import NEAR
        from pansplat.export.film import Film, FilmPhotographs, choose_scenes
        from pansplat.tours.route import NEAR_OF_FAR

        is_perspective = options["layout"] == "pinhole"
        near = NEAR_OF_FAR * scene.far if scene.tour else NEAR

        @functools.lru_cache(maxsize=2)
        def renderer(shown: Scene) -> Callable[..., Rendering]:
            work = 0 if self.stereo else count  # stereo has no kernels for a card
            return pipeline.make_renderer(shown, "film", work, near=near, **options)

        @torch.no_grad()
        def draw(slot: int, shown: Scene, shot: Shot) -> np.ndarray:
            fov: dict[str, Any] = {"vertical_fov_degrees": shot.vertical_fov_degrees} if is_perspective else {}
            return renderer(shown)(shot.pose, **fov).color.permute(1, 2, 0).numpy()

        is_plain = self.blend is None and not self.stereo
        photographs = FilmPhotographs.open(source, scene) if source is not None and is_plain else None
        choose = (lambda shot: (scene, 0)) if isinstance(options["blend"], int) else choose_scenes(scene)
        return Film(choose, draw, "pinhole" if is_perspective else "equirect", options["size"], photographs)


def read_pose(path: Path) -> Tensor:
    """The pose of a JSON file: cam2world, OpenCV axes."""
    from pansplat.inputs.poses import rigid_matrix
    from pansplat.system.strict_json import read_json

    return rigid_matrix(read_json(path), str(path))
