"""Web pages that show a scene, each of them one file or a folder. docs/web.md describes them."""

from pansplat.web.page import DEFAULT_GAUSSIANS, PHOTO_GAUSSIANS, PageFiles, parse_origins, write_page
from pansplat.web.photographs import list_photographs

__all__ = ["DEFAULT_GAUSSIANS", "PHOTO_GAUSSIANS", "PageFiles", "list_photographs", "parse_origins", "write_page"]
