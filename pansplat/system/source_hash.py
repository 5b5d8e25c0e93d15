"""Hashes of source code, by which caches of results and of compiled kernels recognise what an older version made."""

import functools
import hashlib
import re
import sys
from pathlib import Path

_FOLDER = Path(__file__).parents[1]
_IMPORT = re.compile(r"^[ \t]*(?:from (pansplat[\w.]*) )?import (\([^)]*\)|.*)", re.MULTILINE)
_COMMENT, _ALIAS = re.compile(r"#.*"), re.compile(r"\bas \w+")


@functools.cache
def hash_sources(module: str, prefixes: tuple[str, ...] = ("pansplat.",)) -> str:
    """Hash of the text of a module and of the modules that it imports, directly or not, also inside functions.

    Args:
        module: name of a module of the package, or of one that is loaded.
        prefixes: imported modules count if their names begin with one of these.
    """
    sources: dict[str, str] = {}
    pending = [module]
    while pending:
        name = pending.pop()
        path = _find(name) or (Path(str(sys.modules[name].__file__)) if name == module else None)
        if path is not None and name not in sources and (name == module or name.startswith(prefixes)):
            sources[name] = path.read_text("utf-8")
            pending += list_imports(sources[name])
    digest = hashlib.blake2b(digest_size=8)
    for name, text in sorted(sources.items()):
        digest.update(f"{name}\0{text}\0".encode())
    return digest.hexdigest()


def list_imports(text: str) -> set[str]:
    """Names of the modules of this package that a source file imports."""
    modules = set()
    for package, imported in _IMPORT.findall(_COMMENT.sub("", text)):
        names = re.findall(r"[\w.]+", _ALIAS.sub("", imported))
        members = {f"{package}.{name}" if package else name for name in names}
        found = {member for member in members if _find(member)}
        modules |= found if found == members or not package else found | {package}
    return modules


def _find(module: str) -> Path | None:
    """The file of a module of this package."""
    root, *names = module.split(".")
    if root != "pansplat" or not names:
        return None
    path = _FOLDER.joinpath(*names)
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)
