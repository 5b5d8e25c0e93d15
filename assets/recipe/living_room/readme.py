"""Write the sample's README.md: contents, credits, how it was made, checksums.

blender/bin/python readme.py ../../living_room
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from pathlib import Path

from PIL import Image

_SAMPLES = 14  # paths per pixel of the shipped images

_TEXT = """# The living room

Two posed panoramas of a furnished room, one metre apart, with a third one midway to compare with, and the
exact depth of all three. Nobody lives there: it was generated (see [the recipe](../recipe/living_room/README.md)).

| file | what |
|---|---|
| `left.jpg`, `right.jpg` | the context views, equirectangular, {color_size} |
| `middle.jpg` | the target view, exactly midway, level |
| `*_depth.png` | {depth_size}, 16 bit, millimetres along the ray through the pixel's centre; no pixel is unknown |
| `poses.json` | camera-to-world, OpenCV axes (x right, y down, z forward), metres; near and far |
| `pairs.json` | which views are context and which target |
| `credits.json` | the table below, for programs |

The world is x east, y down (gravity), z north; the floor is at y = 0 and the cameras 1.5 m above it. The
context cameras are turned 36 degrees apart and tilted by one to two degrees, so that a wrong pose convention
shows. What is seen through the windows is a photograph on a dome of 9 m radius, and its depth is the dome's.

## Licence

The images, depths and poses are part of pansplat and under its MIT licence. They show the models below. Those
under CC BY ask that their author be named wherever the images go: keep this file with them. Models were
scaled to their catalogue size, many were given other materials, and all were made matt.

The garden outside is `forest.exr` as shipped with Blender, by Greg Zaal (HDRI Haven), CC0 1.0. Walls,
windows, curtains, cushions, closed books, and the pictures on the walls are our own.

| model | what | author | licence | library (Debian `sweethome3d-furniture` 1.8-1) |
|---|---|---|---|---|
{credits}

Licences: [CC BY 3.0](https://creativecommons.org/licenses/by/3.0/),
[CC BY 3.0 US](https://creativecommons.org/licenses/by/3.0/us/),
[CC0 1.0](https://creativecommons.org/publicdomain/zero/1.0/). A model's own licence page
counts above its library's name.

## How it was made

With bpy 4.2.0, numpy 2.4.6 and Pillow 13.0.0 under Python 3.11, from the repository's root:

```
bash assets/recipe/living_room/fetch.sh sources
python3.11 -m venv blender && blender/bin/pip install bpy==4.2.0 numpy==2.4.6 pillow==13.0.0
blender/bin/python assets/recipe/living_room/living_room.py --sources sources --out assets/living_room \\
    --seed 0 --height {height} --depth-height {depth_height} --samples {samples}
blender/bin/python assets/recipe/living_room/readme.py assets/living_room
```

## Checksums (SHA-256)

```
{checksums}
```
"""


def write(folder: Path) -> None:
    """Write README.md from the other files of `folder`."""
    credits = json.loads((folder / "credits.json").read_text(encoding="utf-8"))
    fields = ("model", "title", "author", "licence", "source")
    rows = ["| " + " | ".join(credit[k] for k in fields) + " |" for credit in credits]
    files = sorted(p for p in folder.iterdir() if p.is_file() and p.name != "README.md" and p.name[0] != ".")
    sums = [f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.name}" for p in files]
    color, depth = (Image.open(folder / name).size for name in ("middle.jpg", "middle_depth.png"))
    part = folder / ".part-README.md"
    text = _TEXT.format(
        credits="\n".join(rows),
        checksums="\n".join(sums),
        color_size=f"{color[0]}x{color[1]}",
        depth_size=f"{depth[0]}x{depth[1]}",
        height=color[1],
        depth_height=depth[1],
        samples=_SAMPLES,
    )
    part.write_text(text, encoding="utf-8")
    os.replace(part, folder / "README.md")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
