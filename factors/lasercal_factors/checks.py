"""Check a factor's Jacobians against central differences under GTSAM's own retraction."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from lasercal_factors.errors import FactorError


def check_jacobians(
    factor: gtsam.NonlinearFactor, values: gtsam.Values, step: float = 1e-6, tolerance: float = 1e-6
) -> float:
    """Compare the analytic with the numerical gradient and Gauss-Newton Hessian diagonal.

    Works for any factor, also for those (`LaserSpotBatchFactor`) whose rows are not residuals: the
    gradient of ``factor.error`` is compared, column by column, relative to the column's scale.

    Parameters
    ----------
    factor, values : what to check and where
    step : central-difference step, in units of each coordinate's own scale 1/|J column|
    tolerance : allowed relative error

    Returns
    -------
    float
        Largest relative error found.

    Raises
    ------
    FactorError
        An error above ``tolerance``; names variable and coordinate.
    """
    linear = factor.linearize(values)
    A, b = linear.jacobian()
    keys = list(factor.keys())
    gradient = -A.T @ b
    norms = np.linalg.norm(A, axis=0)
    worst, where, column = 0.0, "", 0
    for key in keys:
        for i in range(_dim(values, key)):
            if norms[column] > 0:
                h = step / norms[column]
                numeric = (
                    factor.error(_moved(values, key, i, h))
                    - factor.error(_moved(values, key, i, -h))
                ) / (2 * h)
                scale = norms[column] * max(float(np.linalg.norm(b)), 1.0)
                relative = abs(numeric - gradient[column]) / scale
                if relative > worst:
                    worst = relative
                    where = f"{gtsam.DefaultKeyFormatter(key)}[{i}]"
            column += 1
    if worst > tolerance:
        raise FactorError(
            f"Jacobian and central difference differ at {where}: relative error {worst:.2g}, "
            f"allowed {tolerance:.2g}"
        )
    return worst


def _dim(values: gtsam.Values, key: int) -> int:
    one = gtsam.Values()
    _insert(one, key, values)
    return int(one.dim())


def _moved(values: gtsam.Values, key: int, i: int, h: float) -> gtsam.Values:
    step = gtsam.VectorValues()
    for other in values.keys():  # noqa: SIM118 - not a dict
        delta: npt.NDArray[np.float64] = np.zeros(_dim(values, other))
        if other == key:
            delta[i] = h
        step.insert(other, delta)
    return values.retract(step)


def _insert(target: gtsam.Values, key: int, source: gtsam.Values) -> None:
    readers: tuple[Any, ...] = (
        source.atPose3,
        source.atCal3DS2,
        source.atOrientedPlane3,
        source.atVector,
    )
    for read in readers:
        try:
            target.insert(key, read(key))
        except RuntimeError:
            continue
        return
    raise FactorError(f"variable {gtsam.DefaultKeyFormatter(key)} has a type not handled here")
