"""An open alarm, looked into with every spot that comes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.graph import pixel_covariances
from lasercal_gtsam.incremental.beginning import determined
from lasercal_gtsam.incremental.belief import Named
from lasercal_gtsam.incremental.diagnosis import Diagnosis, diagnose
from lasercal_gtsam.incremental.filter import Filter
from lasercal_gtsam.incremental.settings import Settings
from lasercal_gtsam.incremental.store import SpotStore
from lasercal_gtsam.incremental.update import Alarm, Cause

# spots behind an alarm that must be there before a cause is acted on, up to which it is looked
# into at each spot, then at every fifth, and up to which at all
_FEWEST, _AT_EACH, _DIAGNOSED = 6, 20, 40
_ADVICE = (
    "state that noise (hand_sigma_m, hand_sigma_rad) and calibrate anew, or find out what is loose"
)


def looked_into(
    alarm: Alarm,
    since: int,
    store: SpotStore,
    filter: Filter,
    unknown: Iterable[Named],
    settings: Settings,
    outlier_rate: float,
) -> tuple[Alarm, Cause | None]:
    """The alarm with what is known of its causes by now, and the cause if it is beyond doubt.

    Parameters
    ----------
    alarm, since : and the number of the first spot that is affected
    store, filter : the spots, and the estimate without those since then
    unknown : parts that are not determined
    settings : for the noise
    outlier_rate : running share of outliers
    """
    count = store.end - since
    if alarm.causes and (count > _DIAGNOSED or (count > _AT_EACH and count % 5)):
        return replace(alarm, spots=count), None
    end = min(store.end, since + _DIAGNOSED)
    found = _diagnosis(since, end, store, filter, unknown, settings, outlier_rate)
    if isinstance(found, str):
        words = f"since spot {alarm.since}: something has changed; {found}"
        return replace(alarm, spots=count, causes=(), words=words), None
    cause = found.causes[0] if found.settled and count >= _FEWEST else None
    words = f"since spot {alarm.since}: {found.words}"
    if cause is not None and cause.kind == "robot":
        words += f"; {_ADVICE}"
    return replace(alarm, spots=count, causes=found.causes, words=words), cause


def _diagnosis(
    begin: int,
    end: int,
    store: SpotStore,
    filter: Filter,
    unknown: Iterable[Named],
    settings: Settings,
    outlier_rate: float,
) -> Diagnosis | str:
    """What explains these spots, or why that cannot be told."""
    spots = store.observations(begin, end)
    good = determined(spots, filter.template, unknown)
    if not good.any():
        return "its spots are of parts that are not known yet"
    cov_uv = filter.scale**2 * pixel_covariances(spots, settings.sigma_px)
    try:
        return diagnose(
            filter.estimate.belief(),
            spots[good],
            cov_uv[good],
            outlier_rate=outlier_rate,
            hand_noise=settings.hand,
        )
    except DegenerateError as error:
        return f"what it is cannot be told: {error}"
