"""The only place that constructs a `gtsam.CustomFactor`, with the checks GTSAM leaves out.

GTSAM trusts the callback: a Jacobian of the wrong shape or left unset crashes the process or stops
the optimiser without a word. Every custom factor of this project is built here, so that a mistake
becomes a `FactorError` with the factor's name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lasercal_factors.errors import FactorError

if TYPE_CHECKING:
    import gtsam

Array = npt.NDArray[np.float64]
Error = Callable[[Any], Array]
Linearize = Callable[[Any], tuple[Array, Sequence[Array]]]


def custom_factor(
    name: str,
    noise: gtsam.noiseModel.Base,
    keys: Sequence[int],
    dims: Sequence[int],
    error: Error,
    linearize: Linearize,
) -> gtsam.CustomFactor:
    """Build a checked `gtsam.CustomFactor`.

    Parameters
    ----------
    name : what the factor is called in error messages
    noise : noise model; its dimension is the number of rows
    keys, dims : variables and the dimensions of their tangent spaces
    error : ``error(values) -> (rows,)``; may be infinite (LM then rejects the step)
    linearize : ``linearize(values) -> ((rows,), [J_key (rows, dim), ...])``, all finite

    ``error`` and ``linearize`` should close over plain data, not over an object that owns the
    graph: such a cycle runs through C++ and is never collected.

    Raises
    ------
    FactorError
        Wrong numbers of keys here; later, from inside GTSAM's call, wrong shapes or non-finite
        derivatives.
    """
    import gtsam

    row_count = int(noise.dim())
    if len(keys) != len(dims) or len(set(keys)) != len(keys):
        raise FactorError(f"{name}: {len(keys)} keys (all different?) for {len(dims)} dimensions")
    shapes = [(row_count, dim) for dim in dims]

    def callback(_: Any, values: Any, H: list[Array] | None) -> Array:
        if H is None:
            e = error(values)
        else:
            e, jacobians = linearize(values)
            found = [J.shape for J in jacobians]
            if found != shapes:
                raise FactorError(f"{name}: Jacobians of shape {found}, expected {shapes}")
            if not math.isfinite(e @ e):
                raise FactorError(f"{name}: residual is not finite where it is linearised")
            for i, J in enumerate(jacobians):
                H[i] = J
        if e.shape != (row_count,):
            raise FactorError(f"{name}: error of shape {e.shape}, expected ({row_count},)")
        return e

    return gtsam.CustomFactor(noise, list(keys), callback)
