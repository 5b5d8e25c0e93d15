"""A scene as a web page: one file that a browser opens from disk, without a server or a network (docs/web.md)."""

from pansplat.web.page import DEFAULT_GAUSSIANS, PageFiles, parse_origins, write_page

__all__ = ["DEFAULT_GAUSSIANS", "PageFiles", "parse_origins", "write_page"]
