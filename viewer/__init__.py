"""The viewer: GLSL splats in a window or offscreen. Installed as `pansplat_viewer`."""

if __name__ != "pansplat_viewer":
    raise ImportError(
        f"the folder `viewer/` is the package `pansplat_viewer`, but was imported as `{__name__}`; "
        "install the project (`pip install -e .`) and `import pansplat_viewer`"
    )
