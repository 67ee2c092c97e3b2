"""Two calibrations beside each other: what differs, by how much, and whether noise explains it.

`compare` is the public function; `result` has what it returns. The differences are B minus A.

- `together`: the errors of both as one random vector, spots and priors that they share in common;
- `parts`: how each camera, lens, beam and plane differs, in coordinates that mean something;
- `maps`: the same in pixels over the picture and in millimetres on each plane;
- `inputs`: what differs in what they were made from;
- `words`: the conclusion.
"""

from lasercal_gtsam.comparison.comparing import compare
from lasercal_gtsam.comparison.result import Comparison

__all__ = ["Comparison", "compare"]
