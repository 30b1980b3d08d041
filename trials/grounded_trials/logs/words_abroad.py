"""Words of other languages in a log's names, in English: `Nickrate` is a pitch rate.

As for columns of times, which are found as `Zeit` or `temps` too. A word in which several are put
together, `Gierwinkelgeschwindigkeit`, is translated if all of its parts are known.
"""

from __future__ import annotations

import re
from functools import lru_cache

_SAID = {  # the English word for each
    "pitch": "nick tangage cabeceo beccheggio",
    "yaw": "gier lacet guiñada guinada imbardata",
    "roll": "wank roulis alabeo rollio",
    "angle": "winkel angolo ángulo angulo",
    "rate": "winkelgeschwindigkeit drehrate",
    "speed": "geschwindigkeit drehzahl vitesse velocidad velocità velocita",
    "position": "weg lage posición posicion posizione",
    "height": "höhe hoehe hauteur altura altezza",
    "steering": "lenk lenkung",
    "throttle": "gashebel",
    "brake": "bremse frein freno",
    "force": "kraft fuerza forza",
    "torque": "drehmoment couple coppia",
    "voltage": "spannung voltaje tensione",
    "current": "strom courant corriente corrente",
    "pressure": "druck pression presión presion pressione",
    "temperature": "temperatur température temperatura",
    "power": "leistung puissance potencia potenza",
    "left": "links gauche izquierda sinistra",
    "right": "rechts droite derecha destra",
    "target": "soll consigne consigna",
}
_ENGLISH = ("pitch", "yaw", "roll", "rate", "angle", "motor", "pendel", "position")  # in German too
_WORDS = {word: english for english, words in _SAID.items() for word in words.split()}
_PARTS = {**{word: word for word in _ENGLISH}, **_WORDS}
_PART = re.compile("|".join(sorted(map(re.escape, _PARTS), key=len, reverse=True)))
_WHOLE = re.compile(rf"(?:(?:{_PART.pattern})s?)+")
_LETTERS = re.compile(r"[^\W\d_]+")
_TURNING = re.compile(r"(?<![a-z])(pitch|yaw|roll)_(?:angle_)?speed(?![a-z])")
_TURNED = re.compile(r"(?<![a-z])(?:speed|rate)_(?:de_)?(pitch|yaw|roll)(?![a-z])")


@lru_cache(maxsize=4096)
def in_english(name: str) -> str:
    """Return a name in lower case with its foreign words translated, `u_Nick` as `u_pitch`."""
    text = _LETTERS.sub(lambda found: _translated(found[0]), name.lower())
    return _TURNED.sub(r"\1_rate", _TURNING.sub(r"\1_rate", text))


def _translated(word: str) -> str:
    if not _WHOLE.fullmatch(word) or not any(part in _WORDS for part in _PART.findall(word)):
        return word
    return "_".join(_PARTS[part] for part in _PART.findall(word))
