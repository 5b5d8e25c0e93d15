"""Parts of short texts, such as those that stand for objects (`repr`): names, counts, ranges and times."""

from collections.abc import Sequence


def describe_count(count: int, noun: str) -> str:
    """A number and its noun, such as "1 panorama" or "1,200 panoramas"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def list_first(names: Sequence[str], most: int = 4) -> str:
    """The names; of more than `most` and one the first ones and the number of the others."""
    if len(names) <= most + 1:
        return ", ".join(names)
    return f"{', '.join(names[:most])} and {len(names) - most} more"


def describe_range(low: float, high: float, unit: str = "") -> str:
    """Two numbers of three digits, such as "0.45 to 10 m"; one if they are equal."""
    low_text, high_text = f"{low:.3g}", f"{high:.3g}"
    unit = f" {unit}" if unit else ""
    return f"{low_text}{unit}" if low_text == high_text else f"{low_text} to {high_text}{unit}"


def describe_time_left(seconds: float) -> str:
    """An estimate of remaining seconds, such as "about 30 s left" or "about 2 min left"."""
    return f"about {seconds / 60:.0f} min left" if seconds > 90 else f"about {5 * round(seconds / 5) or 5} s left"
