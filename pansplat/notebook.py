"""What notebooks show of scenes, renderings and panoramas, and `show`, which opens a scene in a browser elsewhere.

`import pansplat` registers these displays in the kernel of a notebook. Torch is imported when an object is displayed.
"""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import re
import tempfile
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pansplat.errors import InputError
from pansplat.system.console import is_notebook, print_message

if TYPE_CHECKING:
    import numpy as np
    from IPython.core.formatters import DisplayFormatter

    from pansplat.gaussians.scene import Scene
    from pansplat.inputs.panorama_sets import PanoramaSet
    from pansplat.inputs.views import Views
    from pansplat.rendering import Rendering

DISPLAY_GAUSSIANS = 100_000  # Gaussians of a scene that a notebook shows: 2.4 MB of its file
_FRAME_HEIGHT = 480  # rows of the frame that shows a scene
_MERGE_SIZE = 128, 256  # rows and columns of the images that find what Gaussians contribute
_MAX_MERGERS = 8  # Gaussians that become one on average; more take up to half a minute
_MAX_WIDTH = 1024  # columns of the widest picture
_MAX_PICTURES = 4  # panoramas of an object that are shown; its text names the others
_JPEG_QUALITY = 85  # JPEG quality of pictures in a notebook
_POSTER = re.compile(r'src="data:image/jpeg;base64,([^"]+)"')
_BUNDLE = dict[str, str]  # data by MIME type; pictures in base64


def show(scene: Scene | str | Path, *, gaussians: int = DISPLAY_GAUSSIANS, height: int = _FRAME_HEIGHT) -> Path | None:
    """Show a scene in the viewer of web pages: below the cell of a notebook, elsewhere in the browser.

    In larger scenes similar Gaussians are merged, without the fit to the photographs of
    `pansplat.export.page.write_page`.

    Args:
        scene: the scene, or its file.
        gaussians: largest number of Gaussians. In a notebook they are a part of its file, about 24 bytes each.
        height: rows of the frame in a notebook.

    Returns:
        The temporary page, without a notebook.
    """
    if isinstance(scene, (str, Path)):
        from pansplat.gaussians.formats import load_scene

        scene = load_scene(scene)
    if is_notebook():
        from IPython.display import display

        display(_bundle_scene(scene, gaussians, height), raw=True)
        return None
    path = Path(tempfile.mkdtemp(prefix="pansplat-")) / "scene.html"
    path.write_text(_make_page(scene, gaussians), "utf-8")
    if not webbrowser.open(path.as_uri()):
        print_message("note", f"no browser could be started; open {path}")
    return path


def register_displays(formatter: DisplayFormatter) -> None:
    """Make a notebook's kernel show pictures of renderings and panoramas, and the viewer of scenes."""
    for module, name, bundle in _DISPLAYS:
        formatter.mimebundle_formatter.for_type_by_name(module, name, bundle)


def _bundle_scene(scene: Scene, gaussians: int = DISPLAY_GAUSSIANS, height: int = _FRAME_HEIGHT) -> _BUNDLE:
    """The viewer in a frame, and a picture for programs that show no frames; only text of an empty scene."""
    try:
        page = _make_page(scene, gaussians)
    except InputError as error:
        return {"text/plain": f"{scene!r}\n{error}"}
    poster = _POSTER.search(page)
    size = f"{min(gaussians, len(scene.gaussians)):,} of {len(scene.gaussians):,} Gaussians, {len(page) / 1e6:.1f} MB"
    # Scripts of the frame have an origin of their own, and cannot reach the notebook.
    frame = (
        f'<iframe srcdoc="{html.escape(page)}" title="scene" '
        f'sandbox="allow-scripts allow-downloads allow-pointer-lock" '
        f'allow="fullscreen; accelerometer; gyroscope; xr-spatial-tracking" '
        f'style="width: 100%; height: {height}px; border: 0"></iframe>'
        f"<div><small>{size}; drag to look around, W A S D to walk, H for help</small></div>"
    )
    bundle = {"text/html": frame, "text/plain": repr(scene)}
    return bundle if poster is None else {**bundle, "image/jpeg": poster[1]}


def _make_page(scene: Scene, gaussians: int) -> str:
    """The text of a page of at most a number of Gaussians."""
    from pansplat.export.page import write_page

    with tempfile.TemporaryDirectory(prefix="pansplat-") as folder:
        path = Path(folder) / "scene.html"
        write_page(_reduce(scene, gaussians), path, title="scene")
        return path.read_text("utf-8")


def _reduce(scene: Scene, count: int) -> Scene:
    """At most `count` Gaussians of the scene, in seconds: similar neighbours are merged, without a fit.

    Of very many Gaussians, or without input cameras, a random choice remains before.
    """
    import torch

    from pansplat.refinement.budget import merge_to

    if len(scene.gaussians) <= count:
        return scene
    if count < 1:
        raise InputError(f"`gaussians` must be at least 1, got {count}")
    if int(scene.gaussians.views.max()) >= len(scene.cam2world):
        return _choose(scene, count)
    with torch.no_grad():
        return merge_to(_choose(scene, _MAX_MERGERS * count), _MERGE_SIZE, count)


def _choose(scene: Scene, count: int) -> Scene:
    """A random choice of at most `count` Gaussians, wider, so that they cover the same surfaces."""
    import torch

    gaussians = scene.gaussians
    if len(gaussians) <= count:
        return scene
    order = torch.randperm(len(gaussians), generator=torch.Generator().manual_seed(0))
    chosen = gaussians.select(order[:count].sort().values.to(gaussians.means.device))
    wider = chosen.scales * (len(gaussians) / count) ** 0.5
    return dataclasses.replace(scene, gaussians=dataclasses.replace(chosen, scales=wider))


def _bundle_rendering(rendering: Rendering) -> _BUNDLE:
    """The picture of colours; nothing for other channels than RGB."""
    color = rendering.color.detach()
    if color.shape[0] != 3 or not color.numel():
        return {}
    return _bundle_pictures([color.permute(1, 2, 0).float().cpu().numpy()])


def _bundle_views(views: Views) -> _BUNDLE:
    return _bundle_pictures([image.permute(1, 2, 0).cpu().numpy() for image in views.images[:_MAX_PICTURES]])


def _bundle_set(pair: PanoramaSet) -> _BUNDLE:
    """The context photographs; nothing if one cannot be read."""
    from pansplat.images.image_files import read_panorama

    shown = pair.context[:_MAX_PICTURES]
    try:
        images = [read_panorama(panorama.image, _MAX_WIDTH // (2 if len(shown) == 1 else 4))[0] for panorama in shown]
    except InputError:
        return {}
    return _bundle_pictures([image.permute(1, 2, 0).numpy() for image in images])


def _bundle_pictures(pictures: Sequence[np.ndarray]) -> _BUNDLE:
    """One picture of several ones (height, width, 3), RGB in [0, 1], of equal size: two in a row, at most 1024 wide."""
    from PIL import Image

    if not pictures:
        return {}
    columns = min(len(pictures), 2)
    height, width = pictures[0].shape[:2]
    scale = min(1.0, _MAX_WIDTH / (columns * width))
    width, height = max(round(scale * width), 1), max(round(scale * height), 1)
    sheet = Image.new("RGB", (columns * width, -(-len(pictures) // columns) * height), "white")
    for number, picture in enumerate(pictures):
        image = Image.fromarray((picture.clip(0, 1) * 255 + 0.5).astype("uint8"))
        sheet.paste(image.resize((width, height), Image.Resampling.BOX), (number % 2 * width, number // 2 * height))
    with io.BytesIO() as file:
        sheet.save(file, "JPEG", quality=_JPEG_QUALITY)
        return {"image/jpeg": base64.b64encode(file.getvalue()).decode()}


_DISPLAYS: tuple[tuple[str, str, Callable[[Any], _BUNDLE]], ...] = (
    ("pansplat.gaussians.scene", "Scene", _bundle_scene),
    ("pansplat.rendering.rasterize", "Rendering", _bundle_rendering),
    ("pansplat.inputs.views", "Views", _bundle_views),
    ("pansplat.inputs.panorama_sets", "PanoramaSet", _bundle_set),
)
"""Module and name of each class that is displayed, and the function for it."""
