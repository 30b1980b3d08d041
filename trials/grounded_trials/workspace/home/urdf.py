"""Writes numbers into a URDF file: masses with inertias, damping and dry friction of joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from grounded_trials.workspace.home.held import Number
from grounded_trials.workspace.home.xml_text import Element, XmlText

DYNAMICS = {"damping": "damping", "frictionloss": "friction"}


class Urdf:
    """A URDF file, whose links are the bodies of MuJoCo."""

    def __init__(self, path: Path) -> None:
        self.text = XmlText(path.read_bytes(), str(path))

    def write(self, numbers: Sequence[Number]) -> list[Number]:
        """Write numbers into the text; return those that have no place in it."""
        return [one for one in numbers if not self._write(one)]

    def files(self, to: Path, comment: str) -> Mapping[Path, bytes]:
        """Return the contents of the file to write."""
        self.text.insert(self.text.root.begin, comment)
        return {to: self.text.written()}

    def _write(self, number: Number) -> bool:
        name, _, field = number.name.rpartition(".")
        if field == "mass":
            return self._mass(self._named("link", name), number)
        joint, attribute = self._named("joint", name), DYNAMICS.get(field)
        if joint is None or attribute is None:
            return False
        dynamics = joint.first("dynamics")
        if dynamics is None:
            dynamics = self.text.child(joint, "dynamics")
        self.text.set(dynamics, attribute, f"{number.value:.8g}")
        return True

    def _named(self, tag: str, name: str) -> Element | None:
        found = (one for one in self.text.root.children if one.tag == tag)
        return next((one for one in found if one.get("name") == name), None)

    def _mass(self, link: Element | None, number: Number) -> bool:
        """Scale the mass and the inertia of a link."""
        inertial = link and link.first("inertial")
        mass = inertial and inertial.first("mass")
        if not (inertial and mass):
            return False
        factor = number.value / number.was if number.was else 1.0
        self.text.set(mass, "value", f"{number.value:.8g}")
        inertia = inertial.first("inertia")
        for name, given in list(inertia.attributes.items()) if inertia else ():
            assert inertia is not None
            self.text.set(inertia, name, f"{float(given) * factor:.10g}")
        return True
