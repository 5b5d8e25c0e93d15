"""imgui's widgets, with the rectangle of each one by its label."""

from __future__ import annotations

from collections.abc import Callable

from imgui_bundle import imgui

Rectangle = tuple[float, float, float, float]  # left, top, right, bottom, pixels


class Widgets:
    """Draws widgets into the current imgui window.

    Attributes:
        items: rectangle of each widget of the last frame, by its label; for tests that click.
    """

    def __init__(self) -> None:
        self.items: dict[str, Rectangle] = {}

    def record(self, label: str) -> None:
        """Keep the rectangle of imgui's last item."""
        low, high = imgui.get_item_rect_min(), imgui.get_item_rect_max()
        self.items[label] = (low.x, low.y, high.x, high.y)

    def radio(self, label: str, active: bool) -> bool:
        """A radio button; returns whether it was chosen."""
        chosen = imgui.radio_button(label, active)
        self.record(label)
        return chosen

    def check(self, label: str, value: bool) -> bool:
        """A check box; returns its new value."""
        _, value = imgui.checkbox(label, value)
        self.record(label)
        return value

    def button(self, label: str) -> bool:
        """A button; returns whether it was pressed."""
        pressed = imgui.button(label)
        self.record(label)
        return pressed

    def slider(
        self, label: str, value: float, low: float, high: float, form: str, *, logarithmic: bool = False
    ) -> float:
        """A slider; returns its new value."""
        flags = imgui.SliderFlags_.always_clamp.value
        flags |= imgui.SliderFlags_.logarithmic.value if logarithmic else 0
        changed, chosen = imgui.slider_float(label, value, low, high, form, flags)
        self.record(label)
        return chosen if changed else value  # imgui returns an unchanged value rounded to float32

    def text_field(self, label: str, text: str) -> str:
        """A field for a text, which shows its label while it is empty; returns its new text."""
        _, text = imgui.input_text_with_hint(f"##{label}", label, text)
        self.record(label)
        return text

    def section(self, label: str, draw: Callable[[], None], *, opened: bool = True) -> bool:
        """A header that opens and closes what `draw` draws; returns whether it is open."""
        flags = imgui.TreeNodeFlags_.default_open if opened else imgui.TreeNodeFlags_.none
        shown = imgui.collapsing_header(label, flags.value)
        self.record(label)
        if shown:
            imgui.push_id(label)
            draw()
            imgui.pop_id()
        return shown


def draw_wrapped(text: str, *, is_disabled: bool = False) -> None:
    """Draw a text in lines that fit the window."""
    imgui.push_text_wrap_pos(0.0)
    (imgui.text_disabled if is_disabled else imgui.text_unformatted)(text)
    imgui.pop_text_wrap_pos()
