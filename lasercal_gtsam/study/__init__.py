"""The paper's experiments: its comparison methods, Fig. 6, Fig. 7 and Table 2.

``lc.study.fig6(trials=50)`` returns a `Study`; `StudyCell` says which cell is simulated. The
comparison methods are in `lasercal_gtsam.study.methods`.
"""

from __future__ import annotations

from lasercal_gtsam.study.cells import StudyCell
from lasercal_gtsam.study.studies import Study, fig6, fig7, table2

__all__ = ["Study", "StudyCell", "fig6", "fig7", "table2"]
