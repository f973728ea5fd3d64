"""Who did what when, and a picture of it, a row for each day of each person. Times are local and have no zone."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, time, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose.activity.diary import OTHER, PAUSE, UNSEEN
from torchpose.atomic import replacing

if TYPE_CHECKING:
    from matplotlib.ticker import MultipleLocator

# Told apart by the colour-blind, too (Okabe and Ito, and Tol's muted set for more).
_COLOURS = (
    *("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442"),
    *("#332288", "#AA4499", "#44AA99", "#999933", "#661100"),
)
_GREYS = {PAUSE: "0.80", OTHER: "0.55"}
_UNSEEN: dict[str, Any] = {"facecolor": "0.97", "edgecolor": "0.75", "hatch": "////", "linewidth": 0}
_HOUR = 3600.0


@dataclass(frozen=True)
class Stretch:
    """Somebody did something from a moment to another."""

    person: str
    start: datetime
    end: datetime
    activity: str
    log_odds: float = math.nan


def within_hours(
    stretches: Iterable[Stretch], after: time | None = None, before: time | None = None
) -> Iterator[Stretch]:
    """The parts of the stretches that lie in each day's hours from `after` to `before` (none: midnight)."""
    after = after or time.min
    if before is not None and before <= after:
        raise ValueError(f"the hours must end after they begin, got {after} to {before}; ask for two parts")
    for stretch in stretches:
        day = stretch.start.date()
        while datetime.combine(day, time.min) < stretch.end:
            midnight = datetime.combine(day + timedelta(days=1), time.min)
            start = max(stretch.start, datetime.combine(day, after))
            end = min(stretch.end, midnight if before is None else datetime.combine(day, before))
            if start < end:
                yield Stretch(stretch.person, start, end, stretch.activity, stretch.log_odds)
            day += timedelta(days=1)


def plot_timeline(path: Path, stretches: Sequence[Stretch]) -> None:
    """Draw stretches to a PNG: a row a day and person, the time of day across, how long each took in the legend."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    if not stretches:
        raise ValueError("a timeline needs entries, got none; ask for another day, hours or person")
    days = list(within_hours(stretches))  # none goes over midnight
    rows = sorted({(part.person, part.start.date()) for part in days})
    names = sorted({part.activity for part in days}, key=lambda name: (name in (PAUSE, OTHER, UNSEEN), name))
    own = [name for name in names if name not in (*_GREYS, UNSEEN)]
    styles: dict[str, dict[str, Any]] = {
        name: {"facecolor": _COLOURS[i % len(_COLOURS)], "linewidth": 0} for i, name in enumerate(own)
    }
    styles |= {name: {"facecolor": grey, "linewidth": 0} for name, grey in _GREYS.items()}
    styles[UNSEEN] = _UNSEEN

    figure = Figure(figsize=(11, 1.5 + 0.45 * len(rows)), layout="constrained")
    axes = figure.subplots()
    low, high = min(map(_start, days)), max(map(_end, days))
    handles = []
    for name in names:
        parts = [part for part in days if part.activity == name]
        for number, row in enumerate(rows):
            spans = [(_start(p), _end(p) - _start(p)) for p in parts if (p.person, p.start.date()) == row]
            axes.broken_barh(spans, (number - 0.4, 0.8), **styles[name])
        hours = sum(_end(part) - _start(part) for part in parts)
        handles.append(Patch(**styles[name], label=f"{name.replace('_', ' ')}  {_length(hours)}"))
    several = len({person for person, _ in rows}) > 1
    axes.set_yticks(
        range(len(rows)),
        [f"{person}  {day:%a %d %b}" if several else f"{day:%a %d %b %Y}" for person, day in rows],
    )
    axes.set_ylim(len(rows) - 0.5, -0.5)
    margin = 0.005 * (high - low)
    axes.set_xlim(low - margin, high + margin)
    axes.xaxis.set_major_formatter(lambda hour, _: _clock(hour))
    axes.xaxis.set_major_locator(_locator(high - low))
    axes.set_xlabel("time of day")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    figure.legend(
        handles=handles, loc="outside upper center", ncols=min(6, len(handles)), frameon=False, fontsize=9
    )
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110)


def _hour(moment: datetime) -> float:
    return (moment - datetime.combine(moment.date(), time.min)).total_seconds() / _HOUR


def _start(part: Stretch) -> float:
    return _hour(part.start)


def _end(part: Stretch) -> float:
    return _hour(part.end) if part.end.date() == part.start.date() else 24.0


def _length(hours: float) -> str:
    minutes = hours * 60
    return (
        f"{hours:.1f} h" if hours >= 1 else f"{minutes:.0f} min" if minutes >= 1 else f"{60 * minutes:.0f} s"
    )


def _clock(hour: float) -> str:
    seconds = round(hour * _HOUR)
    text = f"{seconds // 3600:02}:{seconds // 60 % 60:02}"
    return text if seconds % 60 == 0 else f"{text}:{seconds % 60:02}"


def _locator(hours: float) -> "MultipleLocator":
    """Ticks at round times of day."""
    from matplotlib.ticker import MultipleLocator

    steps = (5, 10, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800)  # s
    step = next((s for s in steps if hours * _HOUR / s <= 10), 14400)
    return MultipleLocator(step / _HOUR)
