"""What a check of the sigmas found: one row for every estimated parameter, and the whole vector."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Coverage:
    """How often an interval held the truth.

    Attributes
    ----------
    nominal : share that it promises
    share : share of the trials in which it did
    low, high : binomial 68 % interval of ``share`` (Wilson's, so never without width)
    p_value : probability of a share at least as far off if the promise holds (two-sided, exact)
    """

    nominal: float
    share: float
    low: float
    high: float
    p_value: float


@dataclass(frozen=True)
class RowCheck:
    """One estimated row of the table.

    Attributes
    ----------
    name, unit : as in the table
    sigma : stated by the calibration
    expected_sigma : what the calibration's spots give with its options when they are solved at once
    scatter : standard deviation of the estimates over the trials
    ratio : ``scatter / sigma``
    ratio_low, ratio_high : 95 % interval of the ratio (chi-square)
    ratio_p : probability of a ratio at least as far from 1 by chance
    bias : mean error of the trials, in stated sigmas; it scatters by ``ratio / sqrt(trials)``
    bias_p : probability of a bias at least as large by chance
    coverage_68, coverage_95 : of the intervals of 1 and 1.96 stated sigmas
    own_sigma : median of the sigmas that the trials themselves state
    own_coverage_95 : of the intervals of 1.96 of each trial's own sigmas
    """

    name: str
    unit: str
    sigma: float
    expected_sigma: float
    scatter: float
    ratio: float
    ratio_low: float
    ratio_high: float
    ratio_p: float
    bias: float
    bias_p: float
    coverage_68: Coverage
    coverage_95: Coverage
    own_sigma: float
    own_coverage_95: Coverage


@dataclass(frozen=True)
class NeesCheck:
    """Squared error of the whole vector, normalised by the joint covariance that is stated.

    Attributes
    ----------
    mean : over the trials; should be ``dimension``
    dimension : number of coordinates that are free
    low, high : 99 % band of the mean (chi-square with trials x dimension degrees of freedom)
    largest : of all trials
    """

    mean: float
    dimension: int
    low: float
    high: float
    largest: float


@dataclass(frozen=True)
class SigmaCheck:
    """Whether the sigmas of a calibration hold, and why.

    Attributes
    ----------
    holds : the verdict
    problems : one sentence for each thing that does not hold
    verdict : the same in one sentence
    rows : estimated rows of the table, in its order
    nees : of the whole vector
    trials, solved : how many were made, and how many gave an answer
    failures : number of the trial -> why it gave none
    seed, from_data : as asked for
    spots : spots in each trial
    left_out : spots of the calibration that are not simulated, since it had rejected them
    rejected : simulated spots that the trials rejected, in all
    redrawn : simulated spots that were drawn again since no spot could be there, in all
    noise_px : typical pixel sigma that was simulated (median over the spots)
    resolution : factor on a single sigma up to which that many trials cannot tell it from chance
    notes : how the trials are to be read
    """

    holds: bool
    problems: tuple[str, ...]
    verdict: str
    rows: tuple[RowCheck, ...]
    nees: NeesCheck
    trials: int
    solved: int
    failures: dict[int, str]
    seed: int
    from_data: bool
    spots: int
    left_out: int
    rejected: int
    redrawn: int
    noise_px: float
    resolution: float
    notes: tuple[str, ...]

    def __getitem__(self, name: str) -> RowCheck:
        """Return the row of that name; KeyError lists the names."""
        for row in self.rows:
            if row.name == name:
                return row
        raise KeyError(f"{name!r}; there are {', '.join(row.name for row in self.rows)}")
