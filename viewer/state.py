"""What the viewer shows, apart from any window: values that keys and panels change and a frame reads."""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float

from pansplat.gaussians.scene import Scene
from pansplat.geometry.path import fly_pose, level_pose, look_pose, path_poses, up_direction
from pansplat_viewer.camera import Camera, place
from pansplat_viewer.settings import DrawSettings

FLY_SECONDS = 6.0
_STEPS = 24  # of a flight, for the `,` and `.` keys


@dataclass
class ViewerState:
    """Everything a person can change, and what the scene says about itself.

    Attributes:
        camera: the camera now; `home` is where R goes back to.
        orbiting: V toggles between flying (False) and orbiting (True).
        settings: what to draw; the field of view is the camera's.
        flight: fraction of the flight between the panoramas in [0, 1]; `playing` while Space plays it.
        overlay, help: shown or not.
        photo: show the nearest input photograph, right of `split` (fraction of the width; 0: all over).
        adaptive: lower the resolution while moving.
        context: poses of the input cameras; empty for a file without any.
        levels: the pyramid levels that the scene has, ascending.
        message: a line to show until `message_until` (seconds of the viewer's clock).
        quit: the person asked to leave.
    """

    camera: Camera = field(default_factory=Camera)
    home: Camera = field(default_factory=Camera)
    orbiting: bool = False
    settings: DrawSettings = field(default_factory=DrawSettings)
    flight: float = 0.0
    playing: bool = False
    overlay: bool = True
    help: bool = False
    photo: bool = False
    split: float = 0.5
    adaptive: bool = True
    speed: float = 1.0
    context: Float[np.ndarray, "view 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    levels: tuple[int, ...] = ()
    message: str = ""
    message_until: float = 0.0
    quit: bool = False

    @property
    def draw_settings(self) -> DrawSettings:
        """The settings of the next frame."""
        return replace(self.settings, vertical_fov_degrees=self.camera.vertical_fov_degrees)

    def say(self, message: str, now: float, seconds: float = 4.0) -> None:
        """Show a line for some seconds."""
        self.message, self.message_until = message, now + seconds


def enter(state: ViewerState, scene: Scene, *, at: float = 0.0) -> None:
    """Start in a scene at a fraction of its flight; settings stay where the scene allows them."""
    state.context = scene.cam2world.double().numpy()
    state.levels = tuple(sorted(int(level) for level in torch.unique(scene.gaussians.levels)))
    views = max(len(state.context), 1)
    settings = replace(state.settings, levels=None, view=min(state.settings.view, views - 1))
    if views < 2 and settings.mode in ("deferred", "difference"):
        settings = replace(settings, mode="joint")
    state.settings = settings
    state.playing, state.flight = False, min(max(at, 0.0), 1.0)
    base = level_frame(scene)
    camera = replace(state.camera, level=tuple(tuple(float(x) for x in row) for row in base))
    camera = place(camera, start_pose(scene, state.flight))
    state.camera = state.home = replace(camera, distance=_typical_distance(scene))


def level_frame(scene: Scene) -> Float[np.ndarray, "3 3"]:
    """Right, down, forward of a level camera that looks along the way (columns, world axes)."""
    up = up_direction(scene.cam2world)
    if len(scene.cam2world):
        return path_poses(scene.cam2world)[0, :3, :3].numpy()
    ahead = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
    return look_pose(torch.zeros(3), ahead, up)[:3, :3].numpy()


def start_pose(scene: Scene, fraction: float) -> Float[np.ndarray, "4 4"]:
    """Where to stand at a fraction of the flight; in a scene without cameras, back from its middle."""
    if len(scene.cam2world):
        return fly_pose(scene.cam2world, fraction).numpy()
    matrix = np.eye(4)
    matrix[:3, :3] = level_frame(scene)
    means = scene.gaussians.means.double().numpy()
    if len(means):
        middle = np.median(means, axis=0)
        matrix[:3, 3] = middle - 2 * _spread(means, middle) * matrix[:3, 2]
    return matrix


def jump(state: ViewerState, view: int) -> bool:
    """Go to an input camera's place and heading, level; False when the scene has no such camera."""
    if view >= len(state.context):
        return False
    up = up_direction(torch.from_numpy(state.context))
    target = level_pose(torch.from_numpy(state.context[view]), up).numpy()
    state.playing = False
    state.camera = place(state.camera, target)
    state.flight = view / max(len(state.context) - 1, 1)
    return True


def fly_to(state: ViewerState, fraction: float) -> None:
    """Put the camera on the flight at a fraction of its time."""
    state.flight = min(max(fraction, 0.0), 1.0)
    if len(state.context):
        target = fly_pose(torch.from_numpy(state.context), state.flight).numpy()
        state.camera = place(state.camera, target)


def toggle_play(state: ViewerState) -> None:
    """Start or stop the flight; from its end it starts again at the beginning."""
    if not len(state.context):
        return
    state.playing = not state.playing
    if state.playing and state.flight >= 1:
        state.flight = 0.0


def step_flight(state: ViewerState, steps: int) -> None:
    """Move along the flight by whole steps, stopping play."""
    state.playing = False
    fly_to(state, (round(state.flight * _STEPS) + steps) / _STEPS)


def advance(state: ViewerState, seconds: float) -> None:
    """Let time pass: plays the flight and stops it at its end."""
    if state.playing:
        fly_to(state, state.flight + seconds / FLY_SECONDS)
        state.playing = state.flight < 1


def _typical_distance(scene: Scene) -> float:
    """Median distance of the Gaussians from the first camera (else their middle), metres; 2 if none."""
    means = scene.gaussians.means.double().numpy()
    if not len(means):
        return 2.0
    if len(scene.cam2world):
        return float(np.median(np.linalg.norm(means - scene.cam2world[0, :3, 3].double().numpy(), axis=1)))
    return 2 * _spread(means, np.median(means, axis=0))


def _spread(means: Float[np.ndarray, "n 3"], middle: Float[np.ndarray, "3"]) -> float:
    return float(np.median(np.linalg.norm(means - middle, axis=1))) or 1.0
