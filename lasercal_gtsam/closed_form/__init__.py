"""Closed-form start: the whole cell from spots and hand poses, without a guess.

`closed_form_candidates` is the automatic start. The stages are small pure functions; where to find
the equations of the paper (numbers in brackets; "corrected" in a docstring means that the printed
equation is wrong):

===========================================  ==========================  =========================
stage                                        module                      equations
===========================================  ==========================  =========================
beam, plane, camera, pixel                   `projection` (one up)       (1)-(14)
groups of non-rotating motions               `groups`                    the pairs (p, m)
laser direction: kernel, pooling, polish     `direction`                 (16), (17), (20)-(23)
several planes, the paper's chain            `planes_many`               (16)-(35)
several planes, any translations             `general`                   in place of (18)-(35)
one plane                                    `one_plane`                 (36)-(54)
spots before the camera (the default)        `triangulation`             in place of (18)-(54)
beam from the spots of all planes            `beam_fit`                  -
hand poses in no groups                      `search`                    -
camera from points and planes                `camera`                    -
parts that no pair gives alone               `complete`                  (9), (12), (14)
what the data must hold                      `requirements`              ranks of (27), (30), (53)
rank and weight of the whole                 `information`               residual (55)
shots that agree, among outliers             `agreement`, `samples`,     (16), (17), (23)
                                             `lost_planes`
order of the stages, outliers, ranking       `pair`, `outliers`,         -
                                             `candidates`
===========================================  ==========================  =========================

Lengths are metres, angles radians; ``xy`` are pixels scaled by `spots.pixel_scaling`.
"""

from __future__ import annotations

from lasercal_gtsam.closed_form.candidates import Candidate, closed_form_candidates

__all__ = ["Candidate", "closed_form_candidates"]
