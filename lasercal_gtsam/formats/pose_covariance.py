"""The covariance of a pose in other coordinates than those of the solver.

Ours and GTSAM's (`report_map`): the pose ``(R, t)`` moves to ``(R exp([w]x), t + R v)``, rotation
``w`` first, both in the camera's own frame. ROS (`geometry_msgs/PoseWithCovariance`): position
first, then rotations about the fixed axes of the parent frame, ``(exp([w']x) R, t + v')``.
To first order ``v' = R v`` and ``w' = R w``.
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.frozen import Array


def fixed_axes_covariance(tangent: Array, R_base_camera: Array) -> Array:
    """(6, 6) in ROS' order and axes, m^2, m rad, rad^2, from the one in the camera's frame."""
    J = _fixed_by_tangent(R_base_camera)
    return np.asarray(J @ tangent @ J.T)


def tangent_covariance(fixed_axes: Array, R_base_camera: Array) -> Array:
    """Inverse of `fixed_axes_covariance`."""
    J = _fixed_by_tangent(R_base_camera).T
    return np.asarray(J @ fixed_axes @ J.T)


def _fixed_by_tangent(R: Array) -> Array:
    """(6, 6) orthogonal: a step ``(w, v)`` to a step ``(v', w')``."""
    J = np.zeros((6, 6))
    J[:3, 3:] = R
    J[3:, :3] = R
    return J
