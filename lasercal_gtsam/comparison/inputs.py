"""What differs in what two calibrations were made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.comparison.result import Change, InputsChange
from lasercal_gtsam.figures.spots import rejected_spots
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.origin import Origin
from lasercal_gtsam.io.plain import option_text
from lasercal_gtsam.observations import Observations

# of pixels and metres: far below what anybody measures, far above what arithmetic changes
_DECIMALS = 9


def measurements(seen: Observations) -> list[bytes]:
    """What tells one measurement from another: pixel, hand pose, camera, laser and plane.

    Rounded, since a pose may have been made orthonormal again on its way.
    """
    return [
        b"\0".join([_rounded(uv), _rounded(T), *(str(n).encode() for n in (camera, laser, plane))])
        for uv, T, camera, laser, plane in zip(
            seen.uv, seen.T_base_hand, seen.camera, seen.laser, seen.plane, strict=True
        )
    ]


def _rounded(values: Array) -> bytes:
    return bytes((np.round(values, _DECIMALS) + 0.0).tobytes())


def inputs_change(a: Calibration, b: Calibration, origins: tuple[Origin, Origin]) -> InputsChange:
    """Spots, options, files and versions of A beside those of B."""
    seen_a, seen_b = a.inputs.observations, b.inputs.observations
    keys_a, keys_b = measurements(seen_a), measurements(seen_b)
    in_a, in_b = set(keys_a), set(keys_b)
    alone_a = np.array([key not in in_b for key in keys_a], dtype=np.bool_)
    alone_b = np.array([key not in in_a for key in keys_b], dtype=np.bool_)
    only_a, only_b = seen_a.id[alone_a].tolist(), seen_b.id[alone_b].tolist()
    ids_b = set(only_b)
    poses_a = {_rounded(T) for T in seen_a.T_base_hand[alone_a]}
    out = dict(zip(keys_b, rejected_spots(b).tolist(), strict=True))
    disputed = [
        str(name)
        for name, key, left in zip(seen_a.id, keys_a, rejected_spots(a), strict=True)
        if key in out and out[key] != bool(left)
    ]
    return InputsChange(
        spots_a=len(seen_a),
        spots_b=len(seen_b),
        shared=int((~alone_b).sum()),
        only_a=tuple(only_a),
        only_b=tuple(only_b),
        altered=tuple(name for name in only_a if name in ids_b),
        same_pose=sum(_rounded(T) in poses_a for T in seen_b.T_base_hand[alone_b]),
        rejected=tuple(disputed),
        options=tuple(
            Change(f.name, option_text(x), option_text(y))
            for f in fields(a.inputs.options)
            if (x := getattr(a.inputs.options, f.name)) != (y := getattr(b.inputs.options, f.name))
        ),
        files=tuple(_different(origins[0].files, origins[1].files)),
        made=tuple(
            _different(
                {"made with version": origins[0].version, "made": origins[0].created},
                {"made with version": origins[1].version, "made": origins[1].created},
            )
        ),
    )


def _different(a: Mapping[str, str], b: Mapping[str, str]) -> list[Change]:
    names = dict.fromkeys((*a, *b))
    return [
        Change(name, a.get(name, ""), b.get(name, ""))
        for name in names
        if a.get(name, "") != b.get(name, "")
    ]
