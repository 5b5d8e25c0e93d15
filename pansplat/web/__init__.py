"""Styles and scripts of web pages, which `pansplat.export.page_program` joins to one file or a folder. docs/web.md."""
