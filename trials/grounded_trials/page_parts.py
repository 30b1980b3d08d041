"""Pieces of the page. Every text goes through `escape`: names come from strangers' files too."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from html import escape

from grounded_trials.figures import COLOURS, DASHES, Figure, Key
from grounded_trials.figures_draw import draw
from grounded_trials.figures_svg import svg


def table(
    identity: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    strong: Collection[int] = (),
) -> str:
    """A table with a button that copies it; text columns have a header that ends with a blank."""
    kinds = [' class="text"' if name.endswith(" ") else "" for name in header]
    head = "".join(f"<th{k}>{escape(h.strip())}</th>" for h, k in zip(header, kinds, strict=True))
    lines = []
    for number, row in enumerate(rows):
        cells = "".join(f"<td{k}>{escape(c)}</td>" for c, k in zip(row, kinds, strict=True))
        lines.append(f"<tr{' class=strong' if number in strong else ''}>{cells}</tr>")
    return (
        f'<div class="wide"><table id="{identity}"><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
        f'<button type="button" data-copy="{identity}">copy table</button>'
    )


def figure_block(figure: Figure | None, columns: str = "") -> str:
    """A figure's caption, legend and panels; nothing for None."""
    if figure is None:
        return ""
    keys = "".join(f"<li>{_key(key)}{escape(key.name)}</li>" for key in figure.key)
    panels = "".join(
        f"<div>{svg(draw(panel), f'{figure.name}-{number}')}</div>"
        for number, panel in enumerate(figure.panels)
    )
    caption = f'<p class="soft">{escape(figure.caption)}</p>' if figure.caption else ""
    legend = f'<ul class="key">{keys}</ul>' if keys else ""
    return f'{caption}{legend}<div class="panels {columns}">{panels}</div>'


def command(text: str, identity: str) -> str:
    """A command to type, with a button that copies it."""
    button = f'<button type="button" data-copy="{identity}">copy</button>'
    return f'<code id="{identity}">{escape(text)}</code> {button}'


def role_styles() -> str:
    """Colours and dashes of the roles, light and dark; print is light."""
    light = "".join(f".{role}{{--c:{pair[0]}}}" for role, pair in COLOURS.items())
    dark = "".join(f".{role}{{--c:{pair[1]}}}" for role, pair in COLOURS.items())
    dashes = "".join(
        f".{role}.line{{stroke-dasharray:{' '.join(f'{10 * v:g}' for v in lengths)}}}"
        for role, lengths in DASHES.items()
    )
    return f"{light}{dashes}@media screen and (prefers-color-scheme: dark){{{dark}}}"


def _key(key: Key) -> str:
    if key.shape == "line" or key.shape == "dash":
        length = "M0 60h260" if key.shape == "line" else "M60 60h140"
        solid = " whole" if key.shape == "dash" else ""
        mark = f'<path class="{key.role} line{solid}" stroke-width="25" d="{length}"/>'
    elif key.shape == "cross":
        mark = f'<path class="{key.role} line" stroke-width="20" d="M85 15l90 90m0-90l-90 90"/>'
    elif key.shape == "band":
        mark = f'<rect class="{key.role} fill" fill-opacity="0.3" width="260" height="120"/>'
    else:
        kind = "fill" if key.shape == "disc" else "hollow"
        mark = f'<circle class="{key.role} {kind}" cx="130" cy="60" r="45"/>'
    return f'<svg viewBox="0 0 260 120" aria-hidden="true">{mark}</svg>'
