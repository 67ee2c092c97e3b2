"""Robot noise: the hand is not quite where the robot says.

Every hand pose is an unknown with a prior, eliminated in closed form (`elimination`), one for each
spot or for each stop at which several spots were seen. The rounds with the solver are in `refine`;
how large the noise is, if nobody knows, in `components`; the poses themselves, from the same
elimination, in `poses`, and as variables of a graph of one's own in `explicit`.
"""

from lasercal_gtsam.hand_noise.elimination import (
    HandNoise,
    corrected_batch,
    corrections,
    linearized,
    moved_hands,
)

__all__ = ["HandNoise", "corrected_batch", "corrections", "linearized", "moved_hands"]
