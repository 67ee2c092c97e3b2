"""The conclusion of a comparison, in a sentence, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lasercal_gtsam.calibration import Calibration, measured
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.comparison.parts import SURE
from lasercal_gtsam.comparison.result import (
    InputsChange,
    Motion,
    PartChange,
    PixelMap,
    PlaneMap,
    RowChange,
)
from lasercal_gtsam.comparison.together import Together

Verdict = Literal["same", "different", "identical", "unknown"]

# logarithm of a ratio of sigmas that is not worth a word
_ALIKE = 0.1
_ACTIONS = {
    "camera": "use B for this camera from now on, and look for what moved it: a loose mount, a "
    "bump, a tool change",
    "lens": "use B from now on; if nobody turned focus, zoom or aperture, look at the coverage of "
    "both ('lasercal report'): a lens is extrapolated where there are no spots",
    "laser": "use B from now on, and look at the pointer's clamp",
    "plane": "use B for this plane from now on, if it is the same plane",
}


@dataclass(frozen=True, eq=False)
class Findings:
    """What the conclusion is drawn from."""

    parts: tuple[PartChange, ...]
    rows: tuple[RowChange, ...]
    chance: float
    plane_maps: tuple[PlaneMap, ...]
    pixel_maps: tuple[PixelMap, ...]
    errors: Together
    inputs: InputsChange
    equal: bool
    common: bool


def conclude(found: Findings) -> tuple[Verdict, str, str]:
    """Verdict, conclusion and next action."""
    if not found.common:
        return (
            "unknown",
            "The two have no camera, laser or plane in common.",
            "Give calibrations of one cell, with the same names for the same parts.",
        )
    if found.equal:
        return (
            "identical",
            "All common parts are the same to the last digit.",
            "Use either of them.",
        )
    if not found.errors.known:
        return (
            "unknown",
            f"Whether noise explains the difference cannot be said: one of the two has no "
            f"sigmas{_on_planes(found)}.",
            "Add spots to the one without degrees of freedom, and compare again.",
        )
    held = [part for part in found.parts if part.held]
    changed = [part for part in found.parts if part.corrected < SURE]
    if changed:
        changed.sort(key=lambda part: -part.distance / max(np.sqrt(part.unknowns), 1.0))
        words = "; ".join(_change_words(part, found) for part in changed)
        return "different", f"{_capital(words)}{_on_planes(found)}.", _next(changed, found)
    if found.chance < SURE:
        return (
            "different",
            f"They differ by more than noise explains (chance {_chance(found.chance)}), but no "
            f"single part stands out{_on_planes(found)}.",
            "Look at the largest rows and at 'lasercal judge' of both: a model error of either "
            "shows in all parts at once.",
        )
    if held:
        return (
            "different",
            f"{_capital(_held_words(held))}; the rest is the same within noise{_on_planes(found)}.",
            "Decide which of the held values are right; noise does not speak of them.",
        )
    chance = "" if np.isnan(found.chance) else f" (chance {_chance(found.chance)})"
    return "same", f"The same within noise{chance}{_on_planes(found)}.", _either(found)


def _change_words(part: PartChange, found: Findings) -> str:
    sizes = _sizes(part.alone) + " if nothing else changed" if part.alone else _sizes(part)
    z = f"{part.distance:.3g} sigma in {part.unknowns} unknowns"
    if part.kind == "camera":
        return f"camera {part.name!r} moved {sizes} ({z})"
    if part.kind == "laser":
        return f"laser {part.name!r} moved in the hand {sizes} ({z})"
    if part.kind == "plane":
        return f"plane {part.name!r} moved {sizes} ({z})"
    several = any(p.kind == "lens" and p.name != part.name for p in found.parts)
    prefix = f"{part.name}." if several else ""
    names = ("fu", "fv", "alpha_c", "u0", "v0", "k1", "k2", "p1", "p2")
    mine = [row for row in found.rows if row.name in {prefix + name for name in names}]
    worst = max(mine, key=lambda row: np.nan_to_num(abs(row.sigmas)))
    return (
        f"the lens of camera {part.name!r} changed ({z}; most of all {worst.name} by "
        f"{measured(worst.difference, worst.sigma)} {worst.unit})"
    )


def _sizes(moved: Motion | PartChange) -> str:
    return (
        f"by {measured(moved.shift_mm, moved.shift_sigma_mm)} mm and "
        f"{measured(moved.turn_deg, moved.turn_sigma_deg)} deg"
    )


def _held_words(held: list[PartChange]) -> str:
    return "; ".join(
        f"camera {part.name!r} is held at other values of {', '.join(part.held)}" for part in held
    )


def _on_planes(found: Findings) -> str:
    """What it amounts to on the planes."""
    if not found.plane_maps:
        return ""
    worst = max(found.plane_maps, key=lambda one: one.median_mm)
    expected = (
        f", where noise gives {worst.expected_median_mm:.2g} mm"
        if np.isfinite(worst.expected_median_mm)
        else ""
    )
    return (
        f"; on plane {worst.plane!r} they locate the same pixel {worst.median_mm:.2g} mm apart in "
        f"the median and {worst.largest_mm:.2g} mm at most{expected}"
    )


def _next(changed: list[PartChange], found: Findings) -> str:
    if found.errors.shared_spots and not found.inputs.only_a:
        if not found.inputs.only_b:
            return (
                "The spots are the same, so that options or judgement of outliers make the "
                "difference: see which options differ, and let 'lasercal judge' look at both."
            )
        return (
            "B holds A's spots and others that do not agree with them: if something moved in "
            "between, calibrate the newer spots alone; 'lasercal judge' of B says where they "
            "disagree."
        )
    kinds = dict.fromkeys(part.kind for part in changed)
    return _capital("; ".join(_ACTIONS[kind] for kind in kinds)) + "."


def _either(found: Findings) -> str:
    sigmas = [np.linalg.norm(root, axis=1) for root in (found.errors.root_a, found.errors.root_b)]
    free = (sigmas[0] > 0) & (sigmas[1] > 0)
    ratio = float(np.median(sigmas[1][free] / sigmas[0][free])) if free.any() else 1.0
    if abs(np.log(ratio)) < _ALIKE:
        better = "Use either of them; their sigmas are alike"
    else:
        name, other = ("B", "A") if ratio < 1 else ("A", "B")
        better = (
            f"Use {name}: its sigmas are {min(ratio, 1 / ratio):.2g} times those of {other} in the "
            "median"
        )
    if found.errors.shared_spots:
        return f"{better}."
    return f"{better}. The spots of both together would do better still ('lasercal update')."


def basis_words(errors: Together, inputs: InputsChange) -> str:
    """What the sigmas of the differences rest on."""
    if not errors.known:
        return "There are no sigmas of the differences: one of the two has none."
    if errors.trouble:
        return (
            f"The sigmas are those of independent data, which cannot be verified: {errors.trouble}."
        )
    if not errors.shared_spots:
        words = "The two share no spot: the variance of a difference is the sum of both."
        if errors.shared_priors:
            words = (
                f"The two share no spot, but {errors.shared_priors} priors, whose error makes no "
                "difference between them."
            )
        return words
    nested = not inputs.only_a or not inputs.only_b
    how = (
        "one holds all spots of the other, so that a difference has about the variance of the "
        "smaller set less that of the larger"
        if nested
        else "what they share makes no difference between them"
    )
    return f"The two are not independent: {errors.shared_spots} spots are used in both; {how}."


def remarks(
    a: Calibration,
    b: Calibration,
    common: Cell,
    inputs: InputsChange,
    parts: tuple[PartChange, ...],
) -> tuple[str, ...]:
    """What to know besides."""
    found = [
        f"camera {name!r} has pictures of {_size(part.image_size)} px in A and of "
        f"{_size(b.cell.cameras[name].image_size)} px in B: its pixels are not compared"
        for name, part in common.cameras.items()
        if part.image_size != b.cell.cameras[name].image_size
    ]
    if inputs.same_pose:
        found.append(
            f"{inputs.same_pose} spots that only B has have the hand pose of one that only A has, "
            "but other pixels; if they are the same pictures looked at anew, the two are not "
            "independent and differ by less than the sigmas say"
        )
    for one, name in ((a, "A"), (b, "B")):
        if not one.fit.converged:
            found.append(f"{name} did not converge: {one.fit.status}")
    if any(part.held for part in parts):
        found.append(_held_words([part for part in parts if part.held]))
    return tuple(found)


def _size(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _capital(words: str) -> str:
    return words[:1].upper() + words[1:]


def _chance(value: float) -> str:
    return f"{value:.2g}" if value >= 1e-4 else "< 0.0001"
