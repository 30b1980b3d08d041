"""Diagnose logs of real machines whose authors published what a crude model lacks.

    python benchmarks/real_data.py [NAME ...] [--json FILE]

Prints for each the published cause, what is named, and held-out open-loop errors in units (crude,
calibrated, as diagnosed, noise floor) beside those of the best model made by hand (SOURCE.md of
each folder of ../shared/data, with a slightly different split and resampling). Models and logs are
those of benchmarks/real_systems.py. The diagnosis was developed on EMPS, SERVO and DART_*; BAM_*
(input: volts; in BAM_KP goal, gain and torque_enable) and the double pendulum (ACROBOT, SYSID) were
held out, except that the w of BAM_QW was found to be a mean on it.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

import real_systems

from grounded.diagnosis.diagnose import diagnose

# system: published cause; families that are it; (seconds, or 0 for the whole run; channel, best)
PUBLISHED = {
    "EMPS": (
        "Coulomb and viscous friction",
        ("coulomb_friction", "viscous_friction", "joint_friction"),
        [(0.5, "q", 1.59e-3), (1.0, "q", 4.22e-3)],
    ),
    "SERVO": (
        "delay 40 ms, slew limit, lag",
        ("slew_limit", "delay", "first_order_lag", "rate_limit"),
        [(0, "position", 0.030)],
    ),
    "DART_THROTTLE": (
        "dead zone, rolling friction",
        ("dead_zone", "coulomb_friction", "stall", "stiction", "joint_friction"),
        [(1.0, "v", 0.221), (0, "v", 0.203)],
    ),
    "DART_STEERING": (
        "lag 0.13 s, bent steering",  # of 0.350 rad/s least squares take 0.021 and 0.073
        ("first_order_lag", "delay", "input_curve", "saturation"),
        [(0, "w", 0.232)],
    ),
    "DART_STEPS": (
        "saturating, unequal steering",
        ("input_curve", "saturation", "grip_limit", "understeer"),
        [(0, "w", 0.151)],
    ),
    "BAM_Q": (
        "gear friction, load dependent",
        ("coulomb_friction", "viscous_friction", "joint_friction", "load_friction"),
        [(0.1, "q", 0.026), (0.5, "q", 0.095), (0, "q", 0.098)],
    ),
    "ACROBOT": (
        "joint friction",
        ("coulomb_friction", "viscous_friction", "joint_friction", "load_friction"),
        [(0.1, "q1", 0.065), (0.5, "q1", 0.400)],
    ),
    "SYSID": (
        "joint friction",
        ("coulomb_friction", "viscous_friction", "joint_friction", "load_friction"),
        [(0.1, "q1", 0.069), (0.5, "q1", 0.675)],
    ),
}
PUBLISHED["BAM_QW"] = PUBLISHED["BAM_KP"] = PUBLISHED["BAM_Q"]


def placed(found, families):
    """Return the place of a published cause among the named ones, or in a tied group."""
    named = [c.of for c in found.credit if c.of != "calibration"]
    for place, effect in enumerate(named, 1):
        if effect.partition(":")[0] in families:
            return f"named, {place} of {len(named)}"
    groups = (*found.indistinguishable, *found.equivalent)
    tied = {e.partition(":")[0] for group in groups for e in group}
    return "in the named group" if tied & set(families) else "not named"


def told(name, found, seconds):
    """Return the lines about one system."""
    cause, families, best = PUBLISHED[name]
    print(f"\n{name}: published: {cause}; {placed(found, families)}; {seconds:.0f} s")
    print(f"  {found.kind}: {found.sentence}")
    by_hand = {(s, channel): value for s, channel, value in best}
    for row in found.prediction_error:
        for channel, unit in row.unit_by_channel.items():
            if not row.crude[channel] >= 0:
                continue  # never measured
            columns = (row.crude, row.calibrated, row.with_effects, row.noise_floor)
            figures = "  ".join(f"{c.get(channel, float('nan')):9.4g}" for c in columns)
            key = (0 if row.whole_trial else round(row.horizon_s, 2), channel)
            hand = f"   by hand {by_hand[key]:.4g}" if key in by_hand else ""
            ahead = "whole trial" if row.whole_trial else f"{row.horizon_s:.2f} s"
            print(f"  {ahead:>11}  {channel:>8} [{unit}]  {figures}{hand}")


def main():
    """Run the named systems, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(PUBLISHED))
    parser.add_argument("--json", type=Path, help="write all documents there")
    options, documents = parser.parse_args(), {}
    print("errors: crude, calibrated, as diagnosed, noise floor")
    for name in options.names or PUBLISHED:
        system, start = getattr(real_systems, name), time.process_time()
        found = diagnose(system.model, system.read())
        told(name, found, time.process_time() - start)
        documents[name] = found.to_json()
        if options.json:
            options.json.write_text(json.dumps(documents, indent=1))


if __name__ == "__main__":
    main()
