"""Figures as pictures, by Pillow with the font that it brings: the same on every machine.

Twice the page's pixels, drawn at twice that again and scaled down, which smooths the lines. The
font has Latin letters only; what it lacks is spelled out.
"""

from __future__ import annotations

import io
import unicodedata
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.errors import needs
from grounded.frozen import Array
from grounded_trials.report.figures.draw import Box, Drawing, Spot, Stroke, Words, draw
from grounded_trials.report.figures.figure import COLOURS, DASHES, Figure, Key, rgb

if TYPE_CHECKING:
    from PIL import Image

SCALE, SMOOTH = 2, 2  # pixels of the picture for one of the page; drawn so much larger
HEAD, GAP = 64, 16
LINE = 14  # of the legend
SIZES = {"text": 12.0, "title": 13.0, "faint": 11.5}
GREY = {"text": (26, 26, 26), "title": (0, 0, 0), "faint": (92, 92, 92)}
GREEK = {"α": "alpha", "θ": "theta", "ψ": "psi", "φ": "phi", "ω": "omega", "δ": "delta"}
SPELLED = str.maketrans(GREEK | {"−": "-", "’": "'", "∞": "inf", "…": "..."})


def png(figure: Figure) -> bytes:
    """The PNG file of a figure: its title, its legend, its panels.

    Raises:
        GroundedError: if Pillow is not installed.
    """
    needs("PIL", "png")
    from PIL import Image, ImageDraw

    drawings = [draw(panel) for panel in figure.panels]
    columns = min(3 if len(drawings) > 4 else 2, len(drawings))
    rows = [drawings[i : i + columns] for i in range(0, len(drawings), columns)]
    heights = [max(d.height for d in row) for row in rows]
    wide = round(columns * (drawings[0].width + GAP) + GAP) * SCALE
    places = _legend_places(figure.key, wide)
    head = HEAD + (LINE * places[-1][1] if places else 0)
    high = round(head + sum(heights) + GAP * len(rows)) * SCALE
    sheet = Image.new("RGB", (wide, high), "white")
    pen = ImageDraw.Draw(sheet)
    text = plain(figure.title)
    pen.text((GAP * SCALE, 10 * SCALE), text, font=_font(16.0 * SCALE), fill=(0, 0, 0))
    _legend(pen, figure.key, places)
    top = float(head)
    for row, height in zip(rows, heights, strict=True):
        for column, drawing in enumerate(row):
            left = GAP + column * (drawing.width + GAP)
            sheet.paste(_panel(drawing), (round(left * SCALE), round(top * SCALE)))
        top += height + GAP
    stream = io.BytesIO()
    sheet.save(stream, format="PNG", optimize=True)
    return stream.getvalue()


def plain(text: str) -> str:
    """The text in letters that the font has."""
    text = unicodedata.normalize("NFKD", text.translate(SPELLED))
    letters = [c for c in text if not unicodedata.combining(c)]  # accents are dropped
    return "".join(c if ord(c) < 128 or c == "±" else "?" for c in letters)


def _panel(drawing: Drawing) -> Image.Image:
    from PIL import Image, ImageDraw

    factor = SCALE * SMOOTH
    size = (round(drawing.width * factor), round(drawing.height * factor))
    image = Image.new("RGB", size, "white")
    pen = ImageDraw.Draw(image)
    for shape in drawing.shapes:
        if isinstance(shape, Words):
            _words(image, pen, shape, factor)
        elif isinstance(shape, Box):
            corners = (shape.x, shape.y, shape.x + shape.width, shape.y + shape.height)
            colour = _mixed(shape.role, shape.opacity)
            pen.rectangle([round(c * factor) for c in corners], fill=colour)
    inside = image.copy()
    brush = ImageDraw.Draw(inside)
    for shape in drawing.shapes:
        if isinstance(shape, Stroke):
            _stroke(brush, shape, factor)
    for shape in drawing.shapes:
        if isinstance(shape, Spot):
            _spot(brush, shape, factor)
    x, y, width, height = (round(v * factor) for v in drawing.box)
    if width:
        area = (x, y, x + width + 1, y + height + 1)
        image.paste(inside.crop(area), area[:2])
    final = (round(drawing.width * SCALE), round(drawing.height * SCALE))
    return image.resize(final, Image.Resampling.LANCZOS)


def _words(image: Any, pen: Any, words: Words, factor: int) -> None:
    from PIL import Image, ImageDraw

    font, text = _font(SIZES[words.role] * factor), plain(words.text)
    length = font.getlength(text)
    shift = {"start": 0.0, "middle": length / 2, "end": length}[words.anchor]
    colour = GREY[words.role]
    x, y = words.x * factor, words.y * factor
    if not words.turned:
        pen.text((x - shift, y), text, font=font, fill=colour, anchor="ls")
        return
    high = round(SIZES[words.role] * factor * 1.4)
    strip = Image.new("RGB", (round(length) + 2, high), "white")
    ImageDraw.Draw(strip).text((0, high * 0.75), text, font=font, fill=colour, anchor="ls")
    turned = strip.rotate(90, expand=True)
    image.paste(turned, (round(x - high * 0.75), round(y - shift)))


def _stroke(pen: Any, stroke: Stroke, factor: int) -> None:
    points = stroke.points * factor
    colour = (221, 221, 221) if stroke.role == "grid" else _rgb(stroke.role)
    width = max(1, round((0.6 if stroke.role == "grid" else stroke.width) * factor))
    lengths = DASHES.get(stroke.role)
    parts = [points] if lengths is None else dashed(points, np.array(lengths) * factor)
    for part in parts:
        if len(part) > 1:
            pen.line([tuple(p) for p in part.tolist()], fill=colour, width=width, joint="curve")


def dashed(points: Array, lengths: Array) -> list[Array]:
    """The drawn pieces of a dashed line: lengths drawn and left out in turn."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    along = np.r_[0.0, np.cumsum(steps)]
    if along[-1] <= 0:
        return []
    rounds = int(np.ceil(along[-1] / lengths.sum()))
    ends = np.minimum(np.cumsum(np.tile(lengths, rounds)), along[-1])
    starts = np.r_[0.0, ends[:-1]]
    pieces = []
    for start, end in zip(starts[::2], ends[::2], strict=True):
        if end > start:
            inner = along[(along > start) & (along < end)]
            at = np.r_[start, inner, end]
            pieces.append(np.column_stack([np.interp(at, along, points[:, k]) for k in (0, 1)]))
    return pieces


def _spot(pen: Any, spot: Spot, factor: int) -> None:
    colour, r = _rgb(spot.role), 4.5 * factor
    x, y = spot.x * factor, spot.y * factor
    around = [x - r, y - r, x + r, y + r]
    if spot.shape == "disc":
        pen.ellipse(around, fill=colour)
    elif spot.shape == "ring":
        pen.ellipse(around, fill="white", outline=colour, width=factor * 3 // 2)
    elif spot.shape == "cross":
        for sign in (-1, 1):
            pen.line([(x - r, y - sign * r), (x + r, y + sign * r)], fill=colour, width=2 * factor)
    else:
        pen.line([(x - 6 * factor, y), (x + 6 * factor, y)], fill=colour, width=2 * factor)


def _legend_places(keys: tuple[Key, ...], wide: int) -> list[tuple[float, int]]:
    """Where each entry begins, in pixels, and in which line."""
    font = _font(12.0 * SCALE)
    places, x, line = [], float(GAP * SCALE), 0
    for key in keys:
        length = 34 * SCALE + font.getlength(plain(key.name)) + 18 * SCALE
        if x + length > wide and x > GAP * SCALE:
            x, line = float(GAP * SCALE), line + 1
        places.append((x, line))
        x += length
    return places


def _legend(pen: Any, keys: tuple[Key, ...], places: list[tuple[float, int]]) -> None:
    """The legend in lines below the title."""
    font = _font(12.0 * SCALE)
    for key, (x, line) in zip(keys, places, strict=True):
        y = (38.0 + LINE * line) * SCALE
        middle = y + 7 * SCALE
        if key.shape in ("disc", "ring", "cross", "dash"):
            spot = Spot(x / SCALE + 13, middle / SCALE, key.role, key.shape, "")
            _spot(pen, spot, SCALE)
        elif key.shape == "band":
            pen.rectangle([x, y, x + 26 * SCALE, y + 13 * SCALE], fill=_mixed(key.role, 0.3))
        else:
            ends = np.array([[x, middle], [x + 26 * SCALE, middle]]) / SCALE
            _stroke(pen, Stroke(ends, key.role, 2.0), SCALE)
        pen.text((x + 34 * SCALE, y), plain(key.name), font=font, fill=GREY["text"])


def _rgb(role: str) -> tuple[int, int, int]:
    return rgb(COLOURS[role][0])


def _mixed(role: str, opacity: float) -> tuple[int, int, int]:
    """The colour on white at an opacity."""
    r, g, b = (round(255 + opacity * (c - 255)) for c in _rgb(role))
    return r, g, b


@lru_cache(maxsize=32)
def _font(size: float) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size)
