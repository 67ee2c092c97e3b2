"""Second opinions on a calibration, and a verdict.

- `bench`: the calibration laid out: whitened residuals, derivatives, projector;
- `levels`: residuals with parts of the chain let off;
- `suspects`: which fault explains the residuals: camera, laser, plane or robot;
- `groups`: how well the rest predicts each group of shots;
- `split`: two halves against each other;
- `residual_tests`: are the residuals noise;
- `verdict`: `judge`, which puts these together.
"""

from lasercal_gtsam.opinions.verdict import Reason, Verdict, judge

__all__ = ["Reason", "Verdict", "judge"]
