"""Jobs for tests, at module level so that workers can import them."""

import os
import time
from pathlib import Path

import numpy as np


def draw(seed, sleep=0.0):
    time.sleep(sleep)
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(60, 60))
    return {"seed": seed, "value": float(np.linalg.inv(a)[0, 0]), "nothing": None}


def dies_once(seed, marker):
    path = Path(marker)
    if seed == 3 and not path.exists():
        path.touch()
        os._exit(1)
    return {"seed": seed}


def fails(seed):
    raise ValueError("this is a mistake, not a lost worker")
