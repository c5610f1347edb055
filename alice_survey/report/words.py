"""Numbers as people read them: two or three digits, and a unit that fits."""

import math


def length(metres: float | None, unit: str = "m") -> str:
    """`0.364 mm`, `2.4 cm`, `41 m`; in units of the model where it has no scale."""
    if metres is None or not math.isfinite(metres):
        return "unknown"
    if unit != "m":
        return f"{metres:.3g} {unit}"
    size = abs(metres)
    if size < 0.01:
        return f"{digits(1e3 * metres)} mm"
    if size < 1.0:
        return f"{digits(1e2 * metres)} cm"
    return f"{digits(metres)} m" if size < 1e4 else f"{digits(metres / 1e3)} km"


def millimetres(value: float | None) -> str:
    """As `length`, of millimetres."""
    return length(None if value is None else 1e-3 * value)


def digits(value: float, wanted: int = 3) -> str:
    """With so many digits and never an exponent."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    rounded = float(f"{value:.{wanted - 1}e}")  # 99.96 has one digit more than it seems
    places = max(0, wanted - 1 - math.floor(math.log10(abs(rounded))))
    return f"{value:.{places}f}"


def share(value: float | None) -> str:
    """`99.8 %`; never 100 % of what is not whole."""
    if value is None or not math.isfinite(value):
        return "unknown"
    text = f"{100 * value:.1f}"
    if text == "100.0":
        text = "100" if value >= 1.0 else "more than 99.9"
    return f"{text} %"


def parts(value: float | None) -> str:
    """Of a scale: `+98 ppm`, `0.51 %`."""
    if value is None or not math.isfinite(value):
        return "unknown"
    return f"{1e6 * value:+.0f} ppm" if abs(value) < 1e-3 else f"{100 * value:+.2f} %"


def duration(seconds: float) -> str:
    """`51 s`, `14 min`, `2.3 h`."""
    if seconds < 120:
        return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.1f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def count(number: int, one: str, many: str = "") -> str:
    """`1 picture`, `1,876,280 points`."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"
