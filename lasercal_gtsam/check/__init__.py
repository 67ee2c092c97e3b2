"""Judging a capture before it is calibrated: its geometry, and whether it was read rightly.

- `poses`: what the hand poses alone say;
- `picture`: where the spots lie;
- `readings`, `doctor`: the capture's numbers read in the usual wrong ways, and which way fits;
- `weakness`, `remedies`: what the spots determine weakly, why, and which motion would cure it.
"""
