"""`pansplat render`: pictures and films of a scene."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from pansplat import pipeline
from pansplat.cli.commands import Render
from pansplat.cli.scenes import blend_mode, open_scene, progress_bar
from pansplat.data.images import write_image
from pansplat.data.poses import parse_convention, read_json, read_trajectory, rigid_matrix, to_cam2world
from pansplat.data.video import write_video
from pansplat.errors import InputError
from pansplat.geometry.path import fly_path

if TYPE_CHECKING:
    from pansplat.gaussians.scene import Scene
    from pansplat.predictor import Progress

_PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".exr")
_FILM_HEIGHT = 360


def run_render(command: Render) -> int:
    """Render one picture, or a flight when the file is a film."""
    film = command.out.suffix.lower() == ".mp4"
    _check(command, film)
    poses = None if command.pose is None else read_poses(command.pose)
    if poses is not None and len(poses) > 1 and not film:
        raise InputError(f"{command.pose} holds {len(poses)} poses; write an .mp4, or keep one pose in the file")
    scene = open_scene(command)
    layout = command.layout or ("perspective" if film else "equirect")
    options = _options(command, layout, command.height or (_FILM_HEIGHT if film else scene.height))
    if film:
        poses = _flight(scene, command) if poses is None else poses
        with progress_bar() as progress:
            count = write_video(command.out, _frames(scene, poses, options, progress), command.fps)
        print(f"{command.out}: {count} pictures of {options['size'][1]}x{options['size'][0]}, {layout}")
        return 0
    pose = scene.pose_between(0.5 if command.at is None else command.at) if poses is None else poses[0]
    with torch.no_grad():
        picture = pipeline.render(scene, pose, **options)
    depth = picture.depth if command.out.suffix.lower() == ".exr" else None
    write_image(command.out, picture.color, depth=depth, panorama=layout != "perspective")
    print(f"{command.out}: {options['size'][1]}x{options['size'][0]}, {layout}")
    return 0


def read_poses(path: Path) -> list[Tensor]:
    """Poses of a file (a JSON matrix, 16 numbers, a KITTI or TUM trajectory): cam2world, OpenCV axes."""
    if path.suffix.lower() == ".json":
        content = read_json(path)
        convention = "cam2world opencv"
        if isinstance(content, dict):
            convention = parse_convention(content.get("convention", convention), path)
            content = content.get("cam2world", content.get("pose"))
        return [to_cam2world(rigid_matrix(content, str(path)), convention)]
    try:
        words = path.read_text(encoding="utf-8-sig").replace(",", " ").split()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: needed a readable file of numbers, got '{error}'") from error
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []  # comments or names: left to the trajectory's reader
    if len(numbers) == 16:
        return [rigid_matrix([numbers[i : i + 4] for i in (0, 4, 8, 12)], str(path))]
    return list(read_trajectory(path).poses)


def _check(command: Render, film: bool) -> None:
    """Refuse what cannot be drawn before the prediction takes its time."""
    if not film and command.out.suffix.lower() not in _PICTURES:
        raise InputError(f"--out must end in {', '.join(_PICTURES)} or .mp4, got {command.out}")
    if not command.out.resolve().parent.is_dir():
        raise InputError(f"--out {command.out}: the folder does not exist; create it first")
    if command.at is not None and command.pose is not None:
        raise InputError("--at and --pose both tell where to stand; give one of them")
    if command.at is not None and film:
        raise InputError("--at is one place, an .mp4 flies through all; write a .png, or leave out --at")
    if command.at is not None and not np.isfinite(command.at):
        raise InputError(f"--at must be a number such as 0.5, got {command.at}")
    if command.height is not None and command.height < 2:
        raise InputError(f"--height must be at least 2 pixels, got {command.height}")
    if not 1 <= command.fov <= 170:
        raise InputError(f"--fov must be 1 to 170 degrees, got {command.fov}")
    if film and not (0 < command.seconds < 3600 and 0 < command.fps <= 240):
        raise InputError(f"--seconds and --fps must be positive, got {command.seconds} and {command.fps}")
    blend_mode(command.blend)


def _options(command: Render, layout: str, height: int) -> dict[str, Any]:
    options: dict[str, Any] = {"blend": blend_mode(command.blend)}
    if layout == "perspective":
        return options | {
            "layout": "pinhole",
            "size": (height, 2 * round(height * 8 / 9)),
            "vertical_fov_degrees": command.fov,
        }
    return options | {"layout": layout, "size": (height, 2 * height)}


def _flight(scene: Scene, command: Render) -> list[Tensor]:
    if not len(scene.cam2world):
        raise InputError(f"{command.path} has no input cameras to fly between; give a trajectory with --pose")
    count = max(2, round(command.seconds * command.fps))
    return list(fly_path(scene.cam2world, [i / (count - 1) for i in range(count)]))


def _frames(scene: Scene, poses: list[Tensor], options: dict[str, Any], progress: Progress) -> Iterator[np.ndarray]:
    for index, pose in enumerate(poses):
        progress(f"picture {index + 1} of {len(poses)}", index / len(poses))
        with torch.no_grad():
            color = pipeline.render(scene, pose, **options).color
        yield (color.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
