"""Styles and scripts of web pages, which `pansplat.export.page` joins to one file or a folder. docs/web.md."""
