"""Draw docs/gallery.md's pictures: the page of every example.

    python benchmarks/gallery.py docs            all of them, 3 minutes of CPU
    python benchmarks/gallery.py docs pendulum   one

Each picture shows one page twice: light, 1000 px wide, and dark, 390 px (a phone). Needs the extras
`report` and `png` (for Pillow), and Debian's chromium and chromium-driver.
"""

from __future__ import annotations

import base64
import io
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from page_browser import browser

TALL, WIDTHS, GAP, COLOURS = 1560, (1000, 390), 20, 256  # [px]
DEMOS = ("pendulum", "car-turn", "car-circle", "car-figure8", "flight-figure8")


def page_of(name: str, place: Path) -> Path:
    """Make a demo in a folder, so that the page names the workspace without a path."""
    command = [sys.executable, "-m", "grounded_cli.main", "demo", name, "--dir", name]
    subprocess.run(command, cwd=place, check=True, capture_output=True)
    return place / name / "reports" / "report.html"


def picture(path: Path) -> bytes:
    """Draw a page, light on a desktop beside dark on a phone, in few colours."""
    whole = Image.new("RGB", (sum(WIDTHS) + GAP, TALL), "#808080")
    with browser() as window:
        for dark, width in enumerate(WIDTHS):
            window.dark(bool(dark))
            window.resize(width, TALL)
            window.open(path)
            window.draw_all()
            shot = base64.b64decode(window.devtools("Page.captureScreenshot", {})["data"])
            whole.paste(Image.open(io.BytesIO(shot)), (dark * (WIDTHS[0] + GAP), 0))
    made = io.BytesIO()
    whole.quantize(COLOURS, kmeans=1).save(made, "png", optimize=True)
    return made.getvalue()


def main() -> None:
    """Draw the pictures that were asked for."""
    place, *names = sys.argv[1:] or ["docs"]
    with tempfile.TemporaryDirectory() as folder:
        for name in names or DEMOS:
            path = page_of(name, Path(folder))
            Path(place, f"gallery-{name}.png").write_bytes(picture(path))
            print(f"gallery-{name}.png", flush=True)


if __name__ == "__main__":
    main()
