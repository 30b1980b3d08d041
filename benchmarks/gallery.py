"""Draw docs/gallery.md's pictures: the page of every example, a crash and a MuJoCo model.

    python benchmarks/gallery.py docs            all of them, 3 minutes of CPU
    python benchmarks/gallery.py docs arm crash  some

Each picture shows one page twice: light, 1000 px wide, and dark, 390 px (a phone). Needs the extras
`report`, `png` (for Pillow) and, for the arm, `mujoco`, and Debian's chromium and chromium-driver.
"""

from __future__ import annotations

import base64
import io
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
TALL, WIDTHS, GAP, COLOURS = 1560, (1000, 390), 20, 256  # [px]
SCROLL = """
const part = document.getElementById(arguments[0]), time = document.getElementById("time");
time.value = 0.6 * time.max;
time.dispatchEvent(new Event("input"));
part.scrollIntoView();
"""
DEMOS = ("pendulum", "car-turn", "car-circle", "car-figure8", "flight-figure8")

ARM = """<mujoco model="arm">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="{damping}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="1.0"/>
      <body name="fore" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="{damping}"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.35" size="0.025" mass="{mass}"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="tau1" joint="shoulder"/><motor name="tau2" joint="elbow"/>
  </actuator>
</mujoco>
"""
ARM_MODEL = """from pathlib import Path

from grounded.adapters import mujoco

params = {{"fore.mass": (0.2, 2.0), "shoulder.damping": (0.0, 2.0), "elbow.damping": (0.0, 2.0)}}
model = mujoco.model(Path(__file__).with_name("{file}"), params=params)
{more}"""

QUADROTOR = '''"""A quadrotor seen from the side{about}."""

import numpy as np

from grounded import Model, Param


def dynamics(s, a, p):
    left, right = {thrust}
    fly = {fly}
    return {{
        "x": s.vx * fly, "z": s.vz * fly, "phi": s.w,
        "vx": -(left + right) * np.sin(s.phi) / p.m,
        "vz": (left + right) * np.cos(s.phi) / p.m - p.g,
        "w": (right - left) * p.arm / p.J,{lag}
    }}


model = Model(
    states={{"x": "m", "z": "m", "phi": "rad", "vx": "m/s", "vz": "m/s", "w": "rad/s"{memory}}},
    inputs={{"left": "N", "right": "N"}},
    params={{
        "m": Param({mass}, "kg", 0.5, 2.0), "J": Param(0.02, "kg m^2"), "arm": Param(0.2, "m"),
        "g": Param(9.81, "m/s^2"), "tau": Param(0.05, "s"),
    }},
    roles={{"position": ("x", "z"), "heading": "phi"}},
    derivative=dynamics,
)
'''
CRUDE = {"about": "", "thrust": "a.left, a.right", "fly": "1.0", "lag": "", "memory": ""}
REAL = {
    "about": ": its motors lag, and below z = -0.5 m it lies on the ground, its log at an end",
    "thrust": "s.fl, s.fr",
    "fly": "np.where(s.z < -0.5, np.nan, 1.0)",
    "lag": '\n        "fl": (a.left - s.fl) / p.tau, "fr": (a.right - s.fr) / p.tau,',
    "memory": ', "fl": "N", "fr": "N"',
}

TOML = """[model]
file = "model.py"
[task]
dt = {dt}
horizon = {steps}
target = "target.csv"
start = {start}
feedback = true
[reward]
state = {state}
terminal = {terminal}
input = {input}
input_change = {input}
[limits]
{limits}
[search]
max_trials = 15
[system]
model = "real.py"
seed = 1
noise = {noise}
"""


def smooth(t: np.ndarray, end: float) -> np.ndarray:
    """Go from 0 to `end`, at rest at both ends (minimum jerk)."""
    u = np.clip(t / t[-1], 0.0, 1.0)
    return np.asarray(end * (10 * u**3 - 15 * u**4 + 6 * u**5))


def arm(folder: Path) -> None:
    """Make a two-link MuJoCo arm whose real forearm is heavier and joints are stiffer."""
    (folder / "arm.xml").write_text(ARM.format(mass=0.6, damping=0.1))
    (folder / "real.xml").write_text(ARM.format(mass=0.9, damping=0.4))
    (folder / "model.py").write_text(ARM_MODEL.format(file="arm.xml", more=""))
    (folder / "real.py").write_text(ARM_MODEL.format(file="real.xml", more="substeps = 1\n"))
    t = 0.02 * np.arange(76)
    columns = {"t": t, "shoulder": smooth(t, -1.6), "elbow": smooth(t, -1.2)}
    write(folder, columns, {
        "dt": 0.02, "steps": 75, "start": "{}",
        "state": "{ shoulder = 20.0, elbow = 20.0 }",
        "terminal": "{ }",
        "input": "{ tau1 = 0.0001, tau2 = 0.0001 }",
        "limits": "tau1 = [-15.0, 15.0]\ntau2 = [-8.0, 8.0]",
        "noise": "{ measurement = { shoulder = 0.001, elbow = 0.001, shoulder_vel = 0.01, "
        "elbow_vel = 0.01 } }",
    })  # fmt: skip


def crash(folder: Path) -> None:
    """Make a quadrotor whose model lacks the motors' lag, so that runs end on the ground."""
    (folder / "model.py").write_text(QUADROTOR.format(mass=1.0, **CRUDE))
    (folder / "real.py").write_text(QUADROTOR.format(mass=1.2, **REAL))
    t = 0.05 * np.arange(81)
    columns = {"t": t, "x": smooth(t, 1.5), "z": 0.4 * np.sin(np.pi * t / t[-1]) ** 2, "phi": 0 * t}
    write(folder, columns, {
        "dt": 0.05, "steps": 80, "start": "{ left = 4.905, right = 4.905 }",
        "state": "{ x = 10.0, z = 10.0, phi = 0.1 }",
        "terminal": "{ x = 100.0, z = 100.0 }",
        "input": "{ left = 0.001, right = 0.001 }",
        "limits": "left = [0.0, 12.0]\nright = [0.0, 12.0]",
        "noise": "{ measurement = { x = 0.002, z = 0.002, phi = 0.003, vx = 0.01, vz = 0.01, "
        "w = 0.02 } }",
    })  # fmt: skip


def write(folder: Path, columns: dict[str, np.ndarray], task: dict[str, object]) -> None:
    """Write target.csv and grounded.toml."""
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(f"{v:.6f}" for v in row) for row in rows)]
    (folder / "target.csv").write_text("\n".join(lines) + "\n")
    (folder / "grounded.toml").write_text(TOML.format(**task))
    for name in ("trials", "candidates"):
        (folder / name).mkdir()


MADE = {"arm": arm, "crash": crash}


def page_of(name: str, place: Path) -> Path:
    """Learn, diagnose and write the report."""
    folder = place / name
    if name in DEMOS:
        ours(place, "demo", name, "--dir", name)
    else:
        folder.mkdir()
        MADE[name](folder)
        brief = ["--trials", "t0001,t0002", "--max-effects", "2"] if name == "arm" else []
        for words in (["learn"], ["diagnose", *brief], ["report", "--html"]):
            ours(place, "-C", name, *words)
    return folder / "reports" / "report.html"


def ours(place: Path, *words: str) -> None:
    """Run a grounded command in a folder, so that the page names the workspace without a path."""
    command = [sys.executable, "-m", "grounded_cli.main", *words]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"grounded {' '.join(words)}: {done.stderr}")


def picture(path: Path, section: str) -> bytes:
    """Draw a page, light on a desktop beside dark on a phone, in few colours.

    Args:
        path: of the page.
        section: its id, where the picture begins there; "" for the top.
    """
    from PIL import Image

    sys.path.insert(0, str(HERE.parent / "tests" / "support"))
    from page_browser import browser

    whole = Image.new("RGB", (sum(WIDTHS) + GAP, TALL), "#808080")
    with browser() as window:
        for dark, width in enumerate(WIDTHS):
            window.dark(bool(dark))
            window.resize(width, TALL)
            window.open(path)
            window.draw_all()
            if section:
                window.run(SCROLL, section)
                time.sleep(0.5)
            shot = base64.b64decode(window.devtools("Page.captureScreenshot", {})["data"])
            whole.paste(Image.open(io.BytesIO(shot)), (dark * (WIDTHS[0] + GAP), 0))
    made = io.BytesIO()
    whole.quantize(COLOURS, kmeans=1).save(made, "png", optimize=True)
    return made.getvalue()


def main() -> None:
    """Draw the pictures that were asked for."""
    place, *names = sys.argv[1:] or ["docs"]
    with tempfile.TemporaryDirectory() as folder:
        for name in names or [*DEMOS, *MADE]:
            path = page_of(name, Path(folder))
            Path(place, f"gallery-{name}.png").write_bytes(
                picture(path, "s0" if name in MADE else "")
            )
            print(f"gallery-{name}.png", flush=True)


if __name__ == "__main__":
    main()
