"""Text and marks over the image, without controls: picked points, hotspots, messages and colour maps."""

from __future__ import annotations

import math

from imgui_bundle import imgui

from pansplat_viewer.core.hotspots import Hotspot
from pansplat_viewer.core.picking import project_point
from pansplat_viewer.core.settings import SCALAR_MAPS
from pansplat_viewer.core.state import ViewerState
from pansplat_viewer.draw.color_maps import get_table

PANEL_WIDTH = 290.0  # width of the main panel before a user drags it, pixels at a DPI scale of 1
MARGIN = 10.0  # distance of overlays from the border of the window, pixels
FIXED = (  # flags of a window that is placed anew in each frame
    imgui.WindowFlags_.no_move.value | imgui.WindowFlags_.no_resize.value | imgui.WindowFlags_.no_saved_settings.value
)
_LABEL = (
    FIXED
    | imgui.WindowFlags_.no_title_bar.value
    | imgui.WindowFlags_.always_auto_resize.value
    | imgui.WindowFlags_.no_inputs.value
    | imgui.WindowFlags_.no_focus_on_appearing.value
    | imgui.WindowFlags_.no_nav.value
)
_LEGEND_WIDTH = 180.0  # pixels at a DPI scale of 1
ZOOM_COLOR = (1.0, 0.75, 0.3)  # RGB of the marks of panoramas in other parts of a tour
UNITS = {"depth": " m"}  # units of the displays whose range can be changed


def draw_points(state: ViewerState) -> None:
    """Draw markers at the picked points: with one its distance from the camera, with two that between both."""
    size = imgui.get_io().display_size
    color = imgui.color_convert_float4_to_u32((1.0, 0.85, 0.2, 1.0))
    canvas = imgui.get_background_draw_list()
    places = [point.position for point in state.points]
    pixels = [project_point(state.camera, place, (int(size.x), int(size.y))) for place in places]
    shown = [pixel for pixel in pixels if pixel is not None]
    for pixel in shown:
        canvas.add_circle(pixel, 5.0 * imgui.get_style().font_scale_dpi, color, 0, 2.0)
    if len(shown) < len(places):
        return
    if len(shown) == 2:
        canvas.add_line(*shown, color, 2.0)
    middle = sum(x for x, _ in shown) / len(shown) + 8, sum(y for _, y in shown) / len(shown) - 22
    distance = math.dist(places[0], places[1] if len(places) == 2 else state.camera.position)
    _draw_outlined(canvas, middle, color, f"{distance:.2f} m" + ("" if len(places) == 2 else " away"))


def draw_hotspots(hotspots: list[Hotspot]) -> None:
    """Draw a ring on the floor for each panorama, or an arrow, with its label; amber if the image fades to it."""
    canvas, right = imgui.get_background_draw_list(), imgui.get_io().display_size.x - MARGIN
    black, white, amber = (imgui.color_convert_float4_to_u32((*rgb, 0.8)) for rgb in ((0,) * 3, (1,) * 3, ZOOM_COLOR))
    for hotspot in hotspots:
        ring = [imgui.ImVec2(*corner) for corner in hotspot.ring]
        for color, thickness in ((black, 4.0), (amber if hotspot.is_zoom else white, 2.0)):
            canvas.add_polyline(ring, color, thickness=thickness, flags=imgui.ImDrawFlags_.closed.value)
            if hotspot.is_arrow:
                canvas.add_convex_poly_filled(ring, color)
            else:
                canvas.add_circle_filled(hotspot.center, 1.0 + thickness, color)
        width = imgui.calc_text_size(hotspot.label).x
        place = min(hotspot.center[0] - width / 2, right - width), hotspot.center[1] + hotspot.radius
        _draw_outlined(canvas, place, white, hotspot.label)


def draw_message(message: str) -> None:
    """Draw a text at the bottom."""
    size = imgui.get_io().display_size
    imgui.set_next_window_pos((size.x / 2, size.y - 2 * MARGIN), 0, (0.5, 1.0))
    imgui.set_next_window_bg_alpha(0.75)
    imgui.begin("##message", None, _LABEL)
    imgui.text_unformatted(message)
    imgui.end()


def _draw_outlined(canvas: imgui.ImDrawList, place: tuple[float, float], color: int, text: str) -> None:
    """Draw a text that is readable over any image."""
    black = imgui.color_convert_float4_to_u32((0.0, 0.0, 0.0, 1.0))
    for x, y in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        canvas.add_text((place[0] + x, place[1] + y), black, text)
    canvas.add_text(place, color, text)


def draw_legend(state: ViewerState) -> None:
    """Draw the colour map of the display with its name and range at the bottom left, if it has one."""
    settings, size, scale = state.settings, imgui.get_io().display_size, imgui.get_style().font_scale_dpi
    if settings.display not in SCALAR_MAPS:
        return
    left, top = PANEL_WIDTH * scale + MARGIN if state.overlay else MARGIN, size.y - 3 * MARGIN
    canvas, table = imgui.get_background_draw_list(), get_table(SCALAR_MAPS[settings.display])
    step, height = _LEGEND_WIDTH * scale / 64, 10 * scale
    for index in range(64):
        red, green, blue = (table[4 * index + 2] / 255).tolist()
        x = left + index * step
        color = imgui.color_convert_float4_to_u32((red, green, blue, 1.0))
        canvas.add_rect_filled((x, top), (x + step, top + height), color)
    white, above = imgui.color_convert_float4_to_u32((1.0, 1.0, 1.0, 1.0)), top - 18 * scale
    largest = f"{settings.display_max:.3g}{UNITS.get(settings.display, '')}"
    _draw_outlined(canvas, (left, above), white, f"{settings.display}: 0")
    _draw_outlined(canvas, (left + 64 * step - imgui.calc_text_size(largest).x, above), white, largest)
