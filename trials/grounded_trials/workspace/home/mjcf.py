"""Writes numbers into an MJCF file and the files that it includes, or into a URDF file.

A number is written on its own element, also where the file has it from a default class. A vector
keeps the numbers behind the first one. Of an actuator's shortcuts (motor, velocity ...) some have
no attribute for a gain or a lag: such an element becomes the `general` one that it stands for.
A body whose mass follows from its geoms gets an `inertial` element.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from grounded.adapters.mujoco_names import FIELDS
from grounded_trials.plain_file import unreadable
from grounded_trials.workspace.home.held import Number

Element = ElementTree.Element
# what may stand before the root: declaration, comments, document type
_PROLOGUE = re.compile(rb"(?:\s+|<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^>]*>)*", re.DOTALL)
VECTORS = {"gear": "actuator_gear", "friction": "geom_friction"}  # written as a whole if new
# shortcuts that `general` can replace, and what each says in attributes of its own
SHORTCUTS = {
    "motor": (),
    "position": ("kp", "kv", "dampratio", "timeconst", "inheritrange"),
    "velocity": ("kv",),
    "general": (),
}
# the attribute of a shortcut that holds a field
OWN = {
    ("position", "kp"): "kp",
    ("position", "kv"): "kv",
    ("velocity", "kv"): "kv",
    ("position", "tau"): "timeconst",
    ("position", "lag"): "timeconst",
}
POINT = 1e-9  # [kg m^2] inertia of a payload, which MuJoCo wants to be positive
GAINS, BIASES = ("fixed", "affine"), ("none", "affine")  # mjtGain, mjtBias
LAGS = {0: "none", 2: "filter", 3: "filterexact"}  # mjtDyn


class Mjcf:
    """An MJCF file with what it includes, and the elements of its compiled model.

    An element is found by its name, an actuator without one by its place. What the file makes in
    another way (replicate, attach) is not written.
    """

    def __init__(self, path: Path, compiled: Any) -> None:
        self.path, self.compiled = path, compiled
        self.texts = {path: XmlText(path.read_bytes(), str(path))}
        self._includes = dict[Path, Element]()  # the element that names each included file
        self._elements = [*self._inside(self.texts[path].root, "mujoco")]

    def _inside(self, element: Element, tag: str) -> Iterator[tuple[str, Element]]:
        """Yield all elements in one with this tag, each after the tag of what it is in."""
        for one in element:
            if one.tag == "include":
                path = (self.path.parent / one.get("file", "")).resolve()
                if path not in self.texts:
                    self._includes[path] = one
                    self.texts[path] = XmlText(path.read_bytes(), str(path))
                    yield from self._inside(self.texts[path].root, tag)
            else:
                yield tag, one
                yield from self._inside(one, tag if one.tag == "frame" else str(one.tag))

    def _element(self, kind: str, index: int) -> Element | None:
        name, acts = getattr(self.compiled, kind)(index).name, kind == "actuator"
        found = [e for tag, e in self._elements if (tag if acts else e.tag) == kind]
        if name or not acts:
            return next((one for one in found if name and one.get("name") == name), None)
        one = found[index] if index < len(found) else None
        return None if one is None or one.get("name") else one

    def write(self, number: Number) -> None:
        """Write a number into the text, if it has a place there."""
        element = self._element(number.kind, number.index)
        if element is None:
            return
        if number.field == "mass":
            self._mass(element, number)
        elif number.field == "delay":
            samples = math.ceil(number.value / self.compiled.opt.timestep - 1e-9) + 1
            for name, new in (("delay", f"{number.value:.8g}"), ("nsample", f"{samples}")):
                element.set(name, new)
            element.set("interp", "linear")
        elif own := OWN.get((str(element.tag), number.field)):
            element.set(own, f"{number.value:.8g}")
        elif number.kind == "actuator" and number.field != "gear":
            self._general(element, number)
        else:
            self._first(element, number.field, number.value, number.index)

    def files(self, to: Path, comment: str) -> Mapping[Path, bytes]:
        """Return the contents of the file to write, and of changed ones that it includes.

        An included file is never overwritten: a changed one gets a name of its own beside `to`.
        """
        found = dict[Path, bytes]()
        for path, text in reversed(self.texts.items()):  # an included file before what includes it
            if path != self.path and text.changed:
                there = to.with_name(f"{to.stem}-{path.name}")
                found[there] = text.written()
                self._includes[path].set("file", there.name)
        return {to: self.texts[self.path].written(comment), **found}

    def _first(self, element: Element, name: str, value: float, index: int) -> None:
        """Set the first number of an attribute."""
        rest = element.get(name, "").split()[1:]
        if not element.get(name) and name in VECTORS:
            rest = [f"{one:.12g}" for one in getattr(self.compiled, VECTORS[name])[index, 1:]]
        element.set(name, " ".join([f"{value:.8g}", *rest]))

    def _mass(self, element: Element, number: Number) -> None:
        """Scale the mass and the inertia of a body; a payload without a mass is a point."""
        factor = number.value / number.was if number.was else 0.0
        inertial, model, i = element.find("inertial"), self.compiled, number.index
        if inertial is None:
            row = {
                "pos": model.body_ipos[i],
                "quat": model.body_iquat[i],
                "diaginertia": np.maximum(model.body_inertia[i] * factor, POINT),
            }
            inertial = first_child(element, "inertial")
            for name, each in row.items():
                inertial.set(name, " ".join(f"{x:.10g}" for x in each))
        else:
            for name in {"diaginertia", "fullinertia"} & {*inertial.keys()}:
                scaled = np.array(inertial.attrib[name].split(), float) * factor
                inertial.set(name, " ".join(f"{x:.10g}" for x in scaled))
        inertial.set("mass", f"{number.value:.8g}")

    def _general(self, element: Element, number: Number) -> None:
        """Write a gain, a lag or a fed-back gain as the attributes of a `general` actuator."""
        model, i = self.compiled, number.index
        kinds = model.actuator_gaintype[i], model.actuator_biastype[i], model.actuator_dyntype[i]
        if element.tag not in SHORTCUTS or max(kinds[:2]) > 1 or int(kinds[2]) not in LAGS:
            return
        if element.tag != "general":
            for name in SHORTCUTS[element.tag]:
                element.attrib.pop(name, None)
            self._typed(element, i)
            element.tag = "general"
        if number.field == "lag":
            element.set("dyntype", "filterexact")
            element.set("dynprm", f"{number.value:.8g}")
            return
        for array, column, factor in FIELDS[number.field].places:
            name = array.removeprefix("actuator_")
            given = element.get(name, "").split() or _trimmed(getattr(model, array)[i])
            given += ["0"] * (int(column or 0) + 1 - len(given))
            given[int(column or 0)] = f"{factor * number.value:.8g}"
            element.set(name, " ".join(given))

    def _typed(self, element: Element, i: int) -> None:
        """Say in a `general` element what its shortcut said."""
        model = self.compiled
        element.set("gaintype", GAINS[model.actuator_gaintype[i]])
        element.set("gainprm", " ".join(_trimmed(model.actuator_gainprm[i])))
        element.set("biastype", BIASES[model.actuator_biastype[i]])
        element.set("biasprm", " ".join(_trimmed(model.actuator_biasprm[i])))
        if model.actuator_dyntype[i]:
            element.set("dyntype", LAGS[int(model.actuator_dyntype[i])])
            element.set("dynprm", " ".join(_trimmed(model.actuator_dynprm[i])))


def _trimmed(values: Any) -> list[str]:
    """Return numbers without the zeros at their end, at least one."""
    last = int(np.flatnonzero(np.append(True, values[1:] != 0))[-1])
    return [f"{one:.12g}" for one in values[: last + 1]]


DYNAMICS = {"damping": "damping", "frictionloss": "friction"}


class Urdf:
    """A URDF file, whose links are the bodies of MuJoCo."""

    def __init__(self, path: Path) -> None:
        self.text = XmlText(path.read_bytes(), str(path))

    def write(self, number: Number) -> None:
        """Write a number into the text, if it has a place there."""
        name, _, field = number.name.rpartition(".")
        tag = "link" if field == "mass" else "joint"
        element = next((e for e in self.text.root.findall(tag) if e.get("name") == name), None)
        if element is None:
            return
        if attribute := DYNAMICS.get(field):
            dynamics = element.find("dynamics")
            if dynamics is None:
                dynamics = first_child(element, "dynamics")
            dynamics.set(attribute, f"{number.value:.8g}")
        elif (mass := element.find("inertial/mass")) is not None:
            factor = number.value / number.was if number.was else 1.0
            mass.set("value", f"{number.value:.8g}")
            for inertia in element.findall("inertial/inertia"):
                inertia.attrib = {n: f"{float(v) * factor:.10g}" for n, v in inertia.items()}

    def files(self, to: Path, comment: str) -> Mapping[Path, bytes]:
        """Return the contents of the file to write."""
        return {to: self.text.written(comment)}


# an XML file whose comments, order and layout of elements stay


class XmlText:
    """An XML file, with its root."""

    def __init__(self, data: bytes, name: str) -> None:
        """Parse a file."""
        self.data = data
        kept = ElementTree.TreeBuilder(insert_comments=True, insert_pis=True)
        try:
            parser = ElementTree.XMLParser(target=kept)
            self.root = ElementTree.fromstring(data, parser)
        except (ElementTree.ParseError, ValueError) as error:
            raise unreadable(name, f"it is no XML: {error}") from None
        self._before = self._text()

    @property
    def changed(self) -> bool:
        """Whether anything of it was changed."""
        return self._text() != self._before

    def written(self, comment: str = "") -> bytes:
        """Return the file with all changes, and with a comment before its root."""
        found = _PROLOGUE.match(self.data)
        head = self.data[: found.end()] if found else b""
        end = self.data.rfind(b"</" + self.root.tag.encode())
        tail = self.data[self.data.index(b">", end) + 1 :] if end >= 0 else b"\n"
        new = (comment + self._text()).replace("\n", "\r\n" if b"\r\n" in self.data else "\n")
        return head + new.encode() + tail

    def _text(self) -> str:
        return ElementTree.tostring(self.root, encoding="unicode").replace(" />", "/>")


def first_child(element: Element, tag: str) -> Element:
    """Insert an empty element as the first child of another, on a line of its own."""
    new = ElementTree.Element(tag)
    new.tail = element.text
    element.insert(0, new)
    return new


def commented(lines: list[str]) -> str:
    """Return lines as an XML comment, in which two hyphens must not stand together."""
    inside = "\n".join(f"  {line}" for line in lines).replace("--", "- -")
    return f"<!--\n{inside}\n-->\n"
