"""Figures for papers, with Matplotlib (extra ``report``): ``calibration.plot`` leads here.

The numbers are those of `lasercal_gtsam.figures`; here they are only drawn. No figure goes through
pyplot, so that no window opens and no setting of the user's is touched. `plots.Plots` draws single
figures on anybody's axes, `files.figure_of` and `files.save_figure` whole ones for files.
"""

from __future__ import annotations

KINDS = ("residuals", "coverage", "error-map", "correlation", "cell")
"""Figures by the names that the command line has for them."""
SUFFIXES = (".png", ".svg", ".pdf")
