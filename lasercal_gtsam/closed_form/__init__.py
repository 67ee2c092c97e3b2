"""Closed-form start: the whole cell from spots and hand poses, without a guess."""

from __future__ import annotations

from lasercal_gtsam.closed_form.candidates import Candidate, closed_form_candidates

__all__ = ["Candidate", "closed_form_candidates"]
