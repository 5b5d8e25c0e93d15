"""The photographs in films: they replace the image while the camera stands at a panorama."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.export.photographs import load_photograph
from pansplat.geometry.equirect import sample_equirect, uv_from_directions
from pansplat.inputs.pairs import Pair
from pansplat.rendering.image_planes import ImagePlane
from pansplat.tours.route import STOP_REACH, STOP_SECONDS

_HEIGHTS = (512, 1024, 2048, 4096)  # of photographs in memory, pixels; the least that is as dense as the frame

Image = Float[np.ndarray, "height width 3"]
DrawnPose = tuple[Float[np.ndarray, "4 4"], float, Callable[[], Image]]  # a pose, its weight, and what draws it


class FilmPhotographs:
    """Photographs over the frames of a film within `STOP_REACH` of their panoramas; they fade for `STOP_SECONDS`.

    What masks hide is not shown: the image of the Gaussians stays there.
    """

    def __init__(
        self,
        photographs: Sequence[Pair],
        cam2world: Float[Tensor, "photograph 4 4"],
        gains: Sequence[tuple[float, float, float]] = (),
    ) -> None:
        """Read nothing yet.

        Args:
            photographs: pairs of one panorama each (`list_photographs`); none shows the Gaussians everywhere.
            cam2world: their poses in the world of the film.
            gains: exposures of the photographs over that of the Gaussians, if it is one for all (`Scene.gains`).
        """
        self._poses = cam2world[: len(photographs)].double().cpu()
        self._gains = torch.tensor(gains)[:, :, None, None] if gains else None
        self._weights: dict[int, float] = {}  # of the photographs near the poses of the last frame
        self._seconds = 0.0  # of the last frame

        @functools.lru_cache(maxsize=2)
        def load(index: int, height: int) -> Float[Tensor, "4 height width"]:
            image, shown = load_photograph(photographs[index], height)
            image = image if self._gains is None else image / self._gains[index]
            return torch.cat((image.clamp(0, 1), shown[None]))

        self._load = load

    def mix(self, frame: Sequence[DrawnPose], plane: ImagePlane, seconds: float) -> Image:
        """The image of a frame, with the photographs of the panoramas at which its poses stand.

        A photograph is shown at once in the first frame that is near its panorama after a cut.

        Args:
            frame: what is mixed.
            plane: size and field of view.
            seconds: time of the frame in the film.
        """
        step, self._seconds = abs(seconds - self._seconds) / STOP_SECONDS, seconds
        last, self._weights = self._weights, {}
        mixed: Any = 0.0
        for pose, share, draw in frame:
            distances = np.linalg.norm(self._poses[:, :3, 3].numpy() - pose[:3, 3], axis=1)
            index, nearest = int(distances.argmin()) if len(distances) else -1, distances.min(initial=np.inf)
            weight = float(nearest <= STOP_REACH)
            if index in last:
                weight = last[index] + min(max(weight - last[index], -step), step)
            self._weights[index] = weight
            if weight > 0:
                photograph, shown = self._draw(index, pose, plane)
                shown = weight * shown
                is_whole = shown.min() > 0.999  # samples are rounded
                image = photograph if is_whole else draw() * (1 - shown) + photograph * shown
            else:
                image = draw()
            mixed += share * image
        return mixed

    def _draw(
        self, index: int, pose: Float[np.ndarray, "4 4"], plane: ImagePlane
    ) -> tuple[Image, Float[np.ndarray, "height width 1"]]:
        """A photograph as a camera at its panorama sees it, and where it is shown (0 to 1)."""
        height = next((height for height in _HEIGHTS if height * plane.pixel_angle >= np.pi), _HEIGHTS[-1])
        rotation = self._poses[index, :3, :3].T @ torch.as_tensor(pose[:3, :3], dtype=torch.float64)
        uv = uv_from_directions(plane.directions() @ rotation.T)
        drawn = sample_equirect(self._load(index, height), uv.float()).permute(1, 2, 0).numpy()
        return drawn[..., :3], drawn[..., 3:]
