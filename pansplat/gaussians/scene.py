"""A scene: Gaussians together with the cameras they were predicted from."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.gaussians import Gaussians
from pansplat.geometry.pose import interpolate_poses


@dataclass(frozen=True, eq=False)
class Scene:
    """What `predict` returns, `render` and the viewer draw, and `save`/`load` keep.

    Attributes:
        gaussians: all context views' Gaussians.
        cam2world: poses of the context views, float64, in the order of `gaussians.views`; may hold no view
            when the file came from elsewhere.
        near, far: depth range of the prediction, metres.
        names: one name a context view (its image file's name).
        model: what made it, e.g. "sweep".
        height: height of the panoramas it was predicted from, pixels.
    """

    gaussians: Gaussians
    cam2world: Float[Tensor, "view 4 4"]
    near: float
    far: float
    names: tuple[str, ...] = ()
    model: str = ""
    height: int = 512

    def pose_between(self, fraction: float) -> Float[Tensor, "4 4"]:
        """The pose at a fraction of the way from the first context camera (0) to the last (1).

        Raises:
            InputError: when the scene has no cameras, as after loading a file that came from elsewhere.
        """
        if not len(self.cam2world):
            raise InputError("the scene has no input cameras to stand between; give a pose instead")
        return interpolate_poses(self.cam2world[0], self.cam2world[-1], fraction)
