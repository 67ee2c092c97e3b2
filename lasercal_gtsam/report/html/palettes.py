"""Colours of figures: a sequential scale, and colours and dashes that tell parts apart.

The sequential scale runs from pale to dark with even steps of lightness, so that it reads in grey
print and with any colour vision. The categorical colours are those of Okabe and Ito (2008), which
were chosen to be told apart with any colour vision; `report.css` holds them, lighter for dark mode.
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.frozen import Array

CATEGORIES = 7
"""Colours that tell parts apart, classes ``part-0``, ``part-1`` ...; more parts begin again."""

_STOPS = ("#fbf3d0", "#dbe3a6", "#a4cf9c", "#63b3a0", "#3692a4", "#2f6d9b", "#324784", "#2a1f4f")


def sequential(shares: Array) -> list[str]:
    """Colours for shares from 0 (pale) to 1 (dark)."""
    stops = np.array([[int(s[i : i + 2], 16) for i in (1, 3, 5)] for s in _STOPS], dtype=float)
    at = np.linspace(0.0, 1.0, len(stops))
    shares = np.clip(np.asarray(shares, dtype=np.float64), 0.0, 1.0)
    rgb = np.column_stack([np.interp(shares, at, stops[:, c]) for c in range(3)])
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in np.rint(rgb).astype(int)]


def category(index: int) -> str:
    """Class of the part with that index."""
    return f"part-{index % CATEGORIES}"
