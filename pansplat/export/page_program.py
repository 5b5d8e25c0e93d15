"""The program of a page: the template, the modules, the shaders and the worker as text in one HTML file."""

from __future__ import annotations

import json
import re
from importlib import resources
from typing import Any

from pansplat.export.page_data import BATCH
from pansplat.shaders import load_shader

_SHADERS = {"splat": ("page.vert", "splat.frag"), "accumulate": ("screen.vert", "accumulate.frag")}
_SHADERS |= {"resolve": ("screen.vert", "resolve.frag"), "mark": ("mark.vert", "mark.frag")}
_SHADERS |= {"photograph": ("screen.vert", "photograph.frag"), "house": ("house.vert", "house.frag")}

_WORKER = ("unpack.js", "sorter.js")
_LIBRARIES = ("graph.js", "renderer.js")  # scripts of their own, which know nothing of the page
_IMPORT = re.compile(r'^import \{[^}]*\} from "\./(\w+\.js)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export ", re.MULTILINE)


def fill_template(**values: str) -> str:
    """page.html with its names in double braces replaced; the style and the programs are added."""
    values |= {
        "style": _read("page.css"),
        "shaders": to_script({name: [_load_shader(stage) for stage in stages] for name, stages in _SHADERS.items()}),
        "worker": to_script("".join(map(_read, _WORKER))),
        "programs": bundle_programs(),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], _read("page.html"))


def bundle_programs() -> str:
    """The modules of the page as scripts: a page from disk cannot import files.

    Modules follow those that they import, as in a browser. All share one scope, so their names differ.
    """
    texts: dict[str, str] = {}

    def add(name: str) -> None:
        text = _read(name)
        for other in _IMPORT.findall(text):
            if other not in texts:
                add(other)
        texts[name] = _EXPORT.sub("", _IMPORT.sub("", text))

    add("page.js")
    libraries = "\n".join(f'<script>\n"use strict";\n{texts.pop(name)}</script>' for name in _LIBRARIES)
    return f'{libraries}\n<script>\n(() => {{\n"use strict";\n{"".join(texts.values())}}})();\n</script>'


def to_script(value: Any) -> str:
    """JSON that may stand in a <script> element."""
    return json.dumps(value).replace("<", "\\u003c")


def _read(name: str) -> str:
    return (resources.files("pansplat.web") / name).read_text("utf-8")


def _load_shader(name: str) -> str:
    return load_shader(name, "300 es", LAYER_STORAGE=0, BATCH=BATCH)
