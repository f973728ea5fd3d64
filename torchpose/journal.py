"""The journal: the diaries of many recordings in one SQLite file, and questions about them.

python -m torchpose.journal FILE                                        # hours of each activity, by day
python -m torchpose.journal FILE --activity sitting --before 12:00      # how long did she sit before noon
python -m torchpose.journal FILE --by hour --day 2026-11-23             # by hour of that day
python -m torchpose.journal FILE --transitions                          # what followed what, how often
python -m torchpose.journal FILE --timeline timeline.png                # a picture, a row a day

Times are local wall-clock times without a zone, as the recording's beginning was given. An interval contains its start
and not its end. `activities.csv` has the entries of one recording, in seconds since its beginning.
"""

import argparse
import csv
import math
import os
import sqlite3
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from datetime import date, datetime, time, timedelta
from enum import Enum
from pathlib import Path

from torchpose.activity.diary import Entry
from torchpose.atomic import replacing
from torchpose.timeline import Stretch, plot_timeline, within_hours

VERSION = 1  # of the tables below
_APPLICATION = 0x746F7270  # "torp": what SQLite's header says the file is of
_COLUMNS = ("start_s", "end_s", "activity", "log_odds")
_BAD_INPUT = 2
_TABLES = """
create table segment (
    person text not null,
    recording text not null,
    start text not null,  -- ISO 8601, microseconds
    end text not null check (end > start),
    activity text not null,
    log_odds real  -- null: not known
);
create index segment_by_time on segment (person, start);
"""


class Period(Enum):
    """What totals are given by."""

    hour = "hour"
    day = "day"


def write_activities_csv(path: Path, entries: Iterable[Entry]) -> None:
    """Write `activities.csv`: a row an entry, to milliseconds; `log_odds` is empty where nobody was seen."""
    with replacing(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for entry in entries:
            odds = "" if math.isnan(entry.log_odds) else format(entry.log_odds, ".4f")
            writer.writerow([f"{entry.start_s:.3f}", f"{entry.end_s:.3f}", entry.activity, odds])


def read_activities_csv(path: Path | str) -> list[Entry]:
    """The entries of an `activities.csv`; ValueError where the file is no such table."""
    path = Path(path)
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    if not rows or tuple(rows[0]) != _COLUMNS:
        raise ValueError(f"{path} must have the columns {', '.join(_COLUMNS)}, got {rows[:1]}; make it anew")
    try:
        return [
            Entry(float(start), float(end), activity, float(odds) if odds else math.nan)
            for start, end, activity, odds in rows[1:]
        ]
    except ValueError as error:
        raise ValueError(
            f"{path} must have a start, an end and an activity in each row, got: {error}; make it anew"
        ) from error


class Journal:
    """The diaries in an SQLite file, which is made if need be.

    What is added is there whole or not at all, and a recording that is added again takes the place of what it was.
    Raises ValueError where the file is of another program or of another version of these tables.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self._opened() as base:
            application, version = (
                base.execute(f"pragma {name}").fetchone()[0] for name in ("application_id", "user_version")
            )
            tables = base.execute("select count(*) from sqlite_master").fetchone()[0]
            if (application, version) == (_APPLICATION, VERSION):
                return
            if tables or application or version:
                what = f"version {version}" if application == _APPLICATION else "another program"
                raise ValueError(
                    f"{self.path} must be a journal of version {VERSION}, got one of {what}; "
                    "give another file, and add its recordings anew"
                )
            with base:
                base.execute("begin immediate")
                for statement in _TABLES.split(";"):
                    base.execute(statement)
                base.execute(f"pragma application_id = {_APPLICATION}")
                base.execute(f"pragma user_version = {VERSION}")

    def add(self, person: str, recording: str, started: datetime, entries: Iterable[Entry]) -> None:
        """Add a recording's entries, whose seconds are counted from `started`.

        Raises ValueError where they overlap what the journal has of that person from another recording.
        """
        stretches = [
            (_text(started + timedelta(seconds=e.start_s)), _text(started + timedelta(seconds=e.end_s)), e)
            for e in entries
        ]
        with self._opened() as base, base:
            base.execute("begin immediate")
            base.execute("delete from segment where person = ? and recording = ?", (person, recording))
            for start, end, _ in stretches:
                other = base.execute(
                    "select recording, start from segment where person = ? and start < ? and end > ?",
                    (person, end, start),
                ).fetchone()
                if other:
                    raise ValueError(
                        f"{person} must not be in two places at once, got {recording} at {start}, when {other[0]} "
                        f"has an entry from {other[1]}; correct when it started, or name another person"
                    )
            base.executemany(
                "insert into segment values (?, ?, ?, ?, ?, ?)",
                [
                    (
                        person,
                        recording,
                        start,
                        end,
                        e.activity,
                        None if math.isnan(e.log_odds) else e.log_odds,
                    )
                    for start, end, e in stretches
                ],
            )

    def people(self) -> list[str]:
        """Whose diaries these are."""
        with self._opened() as base:
            return [name for (name,) in base.execute("select distinct person from segment order by person")]

    def stretches(
        self,
        person: str | None = None,
        start: datetime | None = None,
        end: datetime | None = None,
        activity: str | None = None,
    ) -> list[Stretch]:
        """All entries in the time from `start` to `end`, cut to it, in order."""
        low, high = _text(start or datetime.min), _text(end or datetime.max)
        with self._opened() as base:
            rows = base.execute(
                "select person, max(start, :low), min(end, :high), activity, log_odds from segment "
                "where (:person is null or person = :person) and (:activity is null or activity = :activity) "
                "and start < :high and end > :low order by person, start",
                {"person": person, "activity": activity, "low": low, "high": high},
            ).fetchall()
        return [
            Stretch(
                name,
                datetime.fromisoformat(begin),
                datetime.fromisoformat(stop),
                what,
                math.nan if odds is None else odds,
            )
            for name, begin, stop, what, odds in rows
        ]

    def total(
        self,
        activity: str,
        person: str | None = None,
        start: datetime | None = None,
        end: datetime | None = None,
        after: time | None = None,
        before: time | None = None,
    ) -> timedelta:
        """How long somebody did something from `start` to `end`, of each day only from `after` to `before`."""
        found = self.stretches(person, start, end, activity)
        return sum((part.end - part.start for part in within_hours(found, after, before)), timedelta())

    def totals(
        self,
        by: Period = Period.day,
        person: str | None = None,
        start: datetime | None = None,
        end: datetime | None = None,
        after: time | None = None,
        before: time | None = None,
    ) -> dict[datetime, dict[str, timedelta]]:
        """The beginning of each day or hour that has entries, and how long each activity went on in it."""
        sums: dict[datetime, dict[str, timedelta]] = {}
        for stretch in within_hours(self.stretches(person, start, end), after, before):
            for period, length in _periods(stretch, by):
                of_period = sums.setdefault(period, {})
                of_period[stretch.activity] = of_period.get(stretch.activity, timedelta()) + length
        return dict(sorted(sums.items()))

    def transitions(
        self, person: str | None = None, start: datetime | None = None, end: datetime | None = None
    ) -> dict[tuple[str, str], int]:
        """How often which activity followed which without a gap, of one person; the most frequent first."""
        low, high = _text(start or datetime.min), _text(end or datetime.max)
        with self._opened() as base:
            rows = base.execute(
                "select a.activity, b.activity, count(*) as times from segment a join segment b "
                "on a.person = b.person and a.end = b.start and a.recording = b.recording "
                "where (:person is null or a.person = :person) and a.end > :low and a.end < :high "
                "group by 1, 2 order by times desc, 1, 2",
                {"person": person, "low": low, "high": high},
            ).fetchall()
        return {(first, second): times for first, second, times in rows}

    @contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        try:
            # We begin our transactions ourselves: Python's own do not hold the making of tables.
            with closing(sqlite3.connect(self.path, isolation_level=None)) as base:
                yield base
        except sqlite3.DatabaseError as error:
            raise ValueError(
                f"{self.path} must be a journal that can be read and written, got: {error}; give another file"
            ) from error


def _periods(stretch: Stretch, by: Period) -> Iterator[tuple[datetime, timedelta]]:
    """How much of a stretch lies in each day or hour."""
    start = stretch.start
    while start < stretch.end:
        period = start.replace(minute=0, second=0, microsecond=0)
        step = timedelta(hours=1)
        if by is Period.day:
            period, step = period.replace(hour=0), timedelta(days=1)
        end = min(stretch.end, period + step)
        yield period, end - start
        start = end


def _text(moment: datetime) -> str:
    """A moment as the tables have it, so that the order of texts is the order of moments."""
    if moment.tzinfo is not None:
        raise ValueError(
            f"times of a journal are local and have no zone, got {moment.isoformat()}; leave it out"
        )
    return moment.isoformat(timespec="microseconds")


def _clock(length: timedelta) -> str:
    seconds = round(length.total_seconds())
    return f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02}"


def totals_table(totals: dict[datetime, dict[str, timedelta]], by: Period) -> str:
    """Rows of periods, columns of activities, h:mm:ss."""
    names = sorted({name for row in totals.values() for name in row})
    label = "%Y-%m-%d %H:00" if by is Period.hour else "%Y-%m-%d"
    cells = [["", *names]]
    for period, row in totals.items():
        cells.append([period.strftime(label), *(_clock(row[name]) if name in row else "." for name in names)])
    widths = [max(len(row[column]) for row in cells) for column in range(len(cells[0]))]
    return "\n".join(
        "  ".join(
            text.ljust(w) if i == 0 else text.rjust(w)
            for i, (text, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in cells
    )


def main(argv: Sequence[str] | None = None) -> int:
    """`python -m torchpose.journal`: 0, or 2 with a sentence on stderr where the input is at fault."""
    parser = argparse.ArgumentParser(
        prog="python -m torchpose.journal", description="Questions to the diaries of many recordings."
    )
    parser.add_argument("file", type=Path, help="the SQLite file that infer.py wrote with journal=FILE")
    parser.add_argument("--person", help="whose; all people together if left out")
    parser.add_argument("--activity", help="how long this one went on, instead of a table of all")
    parser.add_argument("--day", type=date.fromisoformat, help="only this day, 2026-11-23")
    parser.add_argument("--after", type=time.fromisoformat, help="only from this hour of each day, 08:00")
    parser.add_argument("--before", type=time.fromisoformat, help="only before this hour of each day, 12:00")
    parser.add_argument("--by", choices=[period.value for period in Period], default="day")
    parser.add_argument("--transitions", action="store_true", help="what followed what, how often")
    parser.add_argument("--timeline", type=Path, help="draw the days to this PNG")
    args = parser.parse_args(argv)
    start = None if args.day is None else datetime.combine(args.day, time.min)
    end = None if start is None else start + timedelta(days=1)
    try:
        if not args.file.is_file():
            raise ValueError(
                f"there must be a journal at {args.file}, got none; write one with infer.py journal=FILE"
            )
        journal = Journal(args.file)
        if args.timeline is not None:
            found = journal.stretches(args.person, start, end, args.activity)
            plot_timeline(args.timeline, list(within_hours(found, args.after, args.before)))
            print(args.timeline)
        elif args.transitions:
            for (first, second), times in journal.transitions(args.person, start, end).items():
                print(f"{times:6}  {first} -> {second}")
        elif args.activity is not None:
            print(_clock(journal.total(args.activity, args.person, start, end, args.after, args.before)))
        else:
            by = Period(args.by)
            print(totals_table(journal.totals(by, args.person, start, end, args.after, args.before), by))
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return _BAD_INPUT
    return 0


if __name__ == "__main__":
    sys.exit(main())
