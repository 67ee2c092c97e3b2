"""What the calibration is worth: summary, verdict, levels, weak directions, model errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from lasercal_gtsam.check.weakness import weaknesses
from lasercal_gtsam.errors import LasercalError
from lasercal_gtsam.figures.error_map import ErrorMap
from lasercal_gtsam.opinions.levels import Level
from lasercal_gtsam.opinions.suspects import Finding
from lasercal_gtsam.report.material import Material
from lasercal_gtsam.report.plainly import number
from lasercal_gtsam.report.words import chance_words, noise_sentence, sentence

_MOST_ROWS = 12
_MOST_GROUPS = 40
_GRADES = {
    "good": "Good: nothing speaks against this calibration.",
    "weak": "Weak: usable with care. The reasons say where.",
    "bad": "Bad: do not use this calibration.",
}
_LEVELS = {
    "picture": "free point",
    "ray": "ray",
    "hand": "free hand",
    "full": "full chain",
}


def summary(material: Material, maps: tuple[ErrorMap, ...]) -> dict[str, Any]:
    """What it is of, and the numbers that are asked for first."""
    calibration = material.calibration
    fit, cell = calibration.fit, calibration.cell
    return {
        "cameras": list(cell.cameras),
        "lasers": list(cell.lasers),
        "planes": list(cell.planes),
        "image_sizes": {name: list(camera.image_size) for name, camera in cell.cameras.items()},
        "n_spots": fit.n_spots,
        "n_rejected": fit.n_rejected,
        "rms_px": number(fit.rms_px),
        "sigma0": number(fit.sigma0),
        "dof": number(fit.dof),
        "iterations": fit.iterations,
        "converged": fit.converged,
        "status": fit.status,
        "noise": noise_sentence(calibration),
        "expected_error_mm": [
            {
                "plane": one.plane,
                "camera": one.camera,
                "median": number(one.median_mm),
                "largest": number(one.largest_mm),
            }
            for one in maps
            if one.total
        ],
    }


def verdict_section(material: Material) -> dict[str, Any]:
    """Grade, reasons, next action."""
    verdict = material.verdict
    return {
        "heading": "Verdict",
        "words": [_GRADES[verdict.grade]],
        "missing": None,
        "grade": verdict.grade,
        "next_action": verdict.next_action,
        "reasons": [
            {
                "code": reason.code,
                "severity": reason.severity,
                "words": reason.words,
                "action": reason.action,
            }
            for reason in verdict.reasons
        ],
    }


def levels_section(material: Material) -> dict[str, Any]:
    """Residuals with parts of the chain let off, and the other second opinions."""
    opinions = material.verdict.opinions
    levels = opinions.levels
    groups = _by_part(levels, "group")
    groups.sort(key=lambda row: -_excess(row))
    known = sorted(opinions.left_out, key=lambda g: g.chance if np.isfinite(g.chance) else 2.0)
    left = [
        {
            "first": g.first,
            "plane": g.plane,
            "spots": g.spots,
            "rms_px": number(g.rms_px, 4),
            "expected_px": number(g.expected_px, 4),
            "rms_mm": number(g.rms_mm, 4),
            "expected_mm": number(g.expected_mm, 4),
            "chance": number(g.chance, 4),
        }
        for g in known[:_MOST_GROUPS]
    ]
    plane_of = {g.first: g.plane for g in opinions.left_out}
    return {
        "heading": "Residuals by plane and by hand orientation",
        "words": [
            "Each level lets a part of the chain off and so stops testing it. Where a residual "
            "falls far below the full chain's, the fault lies in what was let off: free point, any "
            "affine map from hand to plane in each group; ray, the spot may lie anywhere along its "
            "beam, so that planes do not count; free hand, the pose at each orientation is free; "
            "full chain, nothing is let off.",
            "Expected: what the noise gives there, given what the fit takes of it.",
            *_sampled(material),
        ]
        if levels
        else [],
        "missing": None if levels else _nothing(material),
        "levels": [
            {
                "name": level.name,
                "label": _LEVELS[level.name],
                "frees": level.frees,
                "tests": level.tests,
                "rms_px": number(level.rms_px, 4),
                "expected_px": number(level.expected_px, 4),
                "dof": level.dof,
                "chance": None if level.name == "full" else number(level.chance, 4),
            }
            for level in levels
        ],
        "by_camera": _by_part(levels, "camera"),
        "by_plane": _by_part(levels, "plane"),
        "by_orientation": [
            {
                "first": row["name"],
                "plane": plane_of.get(row["name"], ""),
                "spots": row["spots"],
                "cells": row["cells"],
            }
            for row in groups[:_MOST_GROUPS]
        ],
        "orientations_left_out": max(0, len(groups) - _MOST_GROUPS),
        "left_out": left,
        "left_out_more": len(known) - len(left),
        "faults": [_fault(finding) for finding in opinions.findings[:_MOST_ROWS]],
        "faults_more": max(0, len(opinions.findings) - _MOST_ROWS),
        "tests": [
            {
                "name": test.name,
                "asks": test.asks,
                "value": number(test.value, 4),
                "chance": number(test.corrected, 4),
            }
            for test in opinions.tests
        ],
        "halves": _halves(material),
    }


def _sampled(material: Material) -> list[str]:
    asked = material.verdict.opinions.spots
    used = 0 if material.bench is None else len(material.bench)
    if asked >= used:
        return []
    return [f"Asked of an even sample of {asked} of the {used} spots; the halves are all of them."]


def _nothing(material: Material) -> str:
    if material.bench_trouble:
        return sentence(material.bench_trouble)
    if material.bench is not None and material.bench.exact:
        return "The residuals are rounding: there is no noise to judge by."
    return "No level has degrees of freedom left to test anything."


def _by_part(levels: tuple[Level, ...], kind: str) -> list[dict[str, Any]]:
    """Rows of parts of one kind, with a cell for each level; all levels have the same parts."""
    columns = [[part for part in level.parts if part.kind == kind] for level in levels]
    return [
        {
            "name": parts[0].name,
            "spots": parts[0].spots,
            "cells": [
                {
                    "level": level.name,
                    "rms_px": number(part.rms_px, 4),
                    "expected_px": number(part.expected_px, 4),
                }
                for level, part in zip(levels, parts, strict=True)
            ],
        }
        for parts in zip(*columns, strict=True)
    ]


def _excess(row: dict[str, Any]) -> float:
    last = row["cells"][-1]
    return float(last["rms_px"] or 0.0) / max(float(last["expected_px"] or 0.0), 1e-9)


def _fault(finding: Finding) -> dict[str, Any]:
    return {
        "words": finding.words,
        "chance": number(finding.chance, 4),
        "noise_ratio": number(finding.shrink, 4),
        "unknowns": finding.unknowns,
        "significant": finding.significant,
    }


def _halves(material: Material) -> dict[str, Any] | None:
    split = material.verdict.opinions.split
    if split is None or split.failure is not None:
        return None
    worst = sorted(split.rows, key=lambda row: -abs(row.sigmas))
    return {
        "rows": [
            {
                "name": row.name,
                "unit": row.unit,
                "difference": number(row.difference, 4),
                "sigma": number(row.sigma, 4),
                "sigmas": number(row.sigmas, 3),
            }
            for row in worst[:_MOST_ROWS]
        ],
        "more": max(0, len(worst) - _MOST_ROWS),
        "chance": number(split.chance, 4),
        "words": "Two halves of the spots were calibrated alone: first minus second, the largest "
        f"first. Chance that both are of one cell: {chance_words(split.chance)}.",
    }


def weak_section(material: Material) -> dict[str, Any]:
    """What the spots hardly determine, why, and what would cure it."""
    calibration, missing = material.calibration, None
    found = []
    try:
        for weak in weaknesses(calibration) if len(calibration.inputs.observations) else ():
            cure = weak.cures[0]
            found.append(
                {
                    "strength": number(weak.strength, 3),
                    "what": weak.what,
                    "amounts": weak.amounts,
                    "cause": cure.cause,
                    "cure": cure.words,
                    "enough": cure.strength >= 1.0,
                    "distortion": weak.distortion,
                }
            )
    except LasercalError as error:
        missing = sentence(f"the geometry could not be examined: {error}")
    if not len(calibration.inputs.observations):
        missing = "The calibration does not hold its spots, so their geometry is not known."
    words = (
        [
            "Changes like these, made together, hardly show in the residuals. Strength is the "
            "information along them in units of what is plausible anyhow: below 1 the spots say "
            "less than common sense.",
        ]
        if found
        else []
        if missing
        else ["The spots determine everything that was estimated."]
    )
    return {
        "heading": "What is weakly determined",
        "words": words,
        "missing": missing,
        "directions": found,
        "held": list(calibration.observability.held),
        "notes": list(calibration.observability.notes),
    }


_MODEL = (
    (
        "bent plane",
        "A working plane is taken for exactly flat. A plate that bends by h moves a located point "
        "by about h divided by the tangent of the angle at which the camera looks onto it.",
        "Residuals on one plane that go with the place on it; the level 'ray' falls below the full "
        "chain.",
        (("plane", "bent"),),
    ),
    (
        "plane moved",
        "A plane is taken to stay where it is through the whole capture.",
        "Groups of one plane that the others predict badly, from some moment on.",
        (("plane", "moved"),),
    ),
    (
        "lens beyond the model",
        "The lens is two radial and two tangential terms about one principal point. What is "
        "beyond that, and every place in the picture without spots, is not in any sigma.",
        "Neighbouring spots of different groups err alike.",
        (("camera", "lens"),),
    ),
    (
        "camera or laser moved in its mount",
        "Camera and laser are taken to stay as they were mounted, through warming up too.",
        "Residuals that begin at some moment.",
        (("camera", "moved"), ("laser", "moved")),
    ),
    (
        "beam that is not a line, spot that is not its middle",
        "The beam is one straight line in the hand, and the found pixel is where it meets the "
        "plane. Speckle, a slanting or clipped spot and a gloss pull the pixel to one side; this "
        "looks like another beam and other planes.",
        "Errors that go with the distance of the hand or the slant of the beam; often nothing.",
        (),
    ),
    (
        "robot's kinematics",
        "Hand poses are taken from the controller, with noise at most. Errors that go with the "
        "configuration of the arm - lengths, zero positions, gear errors, sag - come back at every "
        "visit and average out in no number of spots.",
        "Orientations whose spots err as a whole; the level 'free hand' falls below the full "
        "chain.",
        (("robot", "orientation"), ("robot", "scale")),
    ),
    (
        "scale",
        "All lengths are in units of the robot's. If its metre is not a metre, neither is the "
        "result's, and nothing here can show it.",
        "Not at all. Measure a known length on a plane.",
        (),
    ),
    (
        "noise that is not independent",
        "Sigmas take the spots for independent. Spots of one visit that share an error count as "
        "many and are few.",
        "Spots taken one after the other, or groups, err alike.",
        (),
    ),
)


def model_error_section(material: Material) -> dict[str, Any]:
    """Errors of the model: no sigma covers them; whether each was looked for, and found."""
    findings = material.verdict.opinions.findings
    items = []
    for name, words, sign, kinds in _MODEL:
        mine = [f for f in findings if (f.part, f.fault) in kinds]
        items.append(
            {
                "name": name,
                "words": words,
                "sign": sign,
                "sought": _sought(min(mine, key=lambda f: f.chance)) if mine else None,
            }
        )
    return {
        "heading": "What no sigma covers",
        "words": [
            "Sigmas, intervals, ellipsoids and the maps of expected error say how noise in the "
            "spots moves the answer, if the model is right. Where the model is wrong they are too "
            "small. This is what the model leaves out, and what was seen of it.",
            "Not seen does not mean not there: only what differs between the shots shows.",
        ],
        "missing": None,
        "items": items,
    }


def _sought(finding: Finding) -> dict[str, Any]:
    chance = chance_words(finding.chance)
    words = (
        f"Found: {finding.words} (chance {chance} without it)."
        if finding.significant
        else f"Looked for; the residuals do not need it (chance {chance})."
    )
    return {"found": finding.significant, "chance": number(finding.chance, 4), "words": words}
