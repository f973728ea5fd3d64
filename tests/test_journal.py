"""The journal: totals against hand counts, whole or not at all, and what is wrong with a file in one sentence."""

import math
import sqlite3
from datetime import datetime, time, timedelta

import cv2
import pytest

from torchpose.activity.diary import Entry
from torchpose.journal import (
    Journal,
    Period,
    main,
    read_activities_csv,
    totals_table,
    write_activities_csv,
)
from torchpose.timeline import Stretch, plot_timeline, within_hours

MORNING = datetime(2026, 11, 23, 8, 30)


def minutes(*parts):
    """Entries one after the other: minutes and activity each."""
    entries, at = [], 0.0
    for length, activity in parts:
        odds = math.nan if activity == "unseen" else 1.25
        entries.append(Entry(60 * at, 60 * (at + length), activity, odds))
        at += length
    return entries


@pytest.fixture
def journal(tmp_path):
    """8:30 sits to 9:15, walks to 9:20, sits to 10:10, unseen to 10:30; 11:50 to 12:20 sits; walks over midnight."""
    made = Journal(tmp_path / "deep" / "diary.sqlite")
    made.add(
        "anna", "one", MORNING, minutes((45, "sitting"), (5, "walking"), (50, "sitting"), (20, "unseen"))
    )
    made.add("anna", "two", datetime(2026, 11, 23, 11, 50), minutes((30, "sitting")))
    made.add("anna", "three", datetime(2026, 11, 23, 23, 30), minutes((90, "walking")))
    made.add("bert", "one", MORNING, minutes((10, "sitting")))
    return Journal(tmp_path / "deep" / "diary.sqlite")  # opened again


def test_how_long_she_sat_before_noon(journal):
    assert journal.total("sitting", "anna", before=time(12)) == timedelta(minutes=45 + 50 + 10)
    assert journal.total("sitting", "anna") == timedelta(minutes=45 + 50 + 30)
    assert journal.total("sitting", "anna", after=time(9), before=time(10)) == timedelta(minutes=15 + 40)
    assert journal.total("sitting", before=time(12)) == timedelta(minutes=45 + 50 + 10 + 10)
    noon = datetime(2026, 11, 23, 12)
    assert journal.total("sitting", "anna", start=noon) == timedelta(minutes=20)
    assert journal.total("walking", "anna", end=noon) == timedelta(minutes=5)
    assert journal.total("boxing", "anna") == timedelta()
    assert journal.people() == ["anna", "bert"]


def test_totals_by_hour_and_by_day(journal):
    hours = journal.totals(Period.hour, "anna")
    assert {
        period.hour: {k: v.total_seconds() / 60 for k, v in row.items()} for period, row in hours.items()
    } == {
        8: {"sitting": 30},
        9: {"sitting": 15 + 40, "walking": 5},
        10: {"sitting": 10, "unseen": 20},
        11: {"sitting": 10},
        12: {"sitting": 20},
        23: {"walking": 30},
        0: {"walking": 60},
    }
    days = journal.totals(Period.day, "anna")
    assert days == {
        datetime(2026, 11, 23): {
            "sitting": timedelta(minutes=125),
            "walking": timedelta(minutes=35),
            "unseen": timedelta(minutes=20),
        },
        datetime(2026, 11, 24): {"walking": timedelta(minutes=60)},
    }
    assert totals_table(days, Period.day).splitlines()[1].split() == [
        "2026-11-23",
        "2:05:00",
        "0:20:00",
        "0:35:00",
    ]


def test_what_followed_what(journal):
    assert journal.transitions("anna") == {
        ("sitting", "unseen"): 1,
        ("sitting", "walking"): 1,
        ("walking", "sitting"): 1,
    }
    assert journal.transitions("anna", end=datetime(2026, 11, 23, 9, 18)) == {("sitting", "walking"): 1}


def test_a_recording_that_is_added_again_takes_its_own_place(journal):
    journal.add("anna", "two", datetime(2026, 11, 23, 11, 50), minutes((10, "walking"), (5, "sitting")))
    assert journal.total("sitting", "anna") == timedelta(minutes=45 + 50 + 5)


def test_what_cannot_be_added_leaves_the_journal_as_it_was(journal):
    before = journal.stretches()
    with pytest.raises(
        ValueError, match="anna must not be in two places at once, got four at 2026-11-23T12:10"
    ):
        journal.add("anna", "four", datetime(2026, 11, 23, 12, 10), minutes((30, "sitting")))

    with pytest.raises(ValueError, match="in two places at once, got two at"):  # what "two" was comes back
        journal.add("anna", "two", MORNING, minutes((30, "walking")))

    def broken():
        yield from minutes((1, "sitting"))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        journal.add("anna", "two", MORNING, broken())
    with pytest.raises(ValueError, match="local and have no zone"):
        journal.add("anna", "five", datetime.fromisoformat("2026-11-25T08:00+01:00"), minutes((1, "sitting")))
    assert [(s.start, s.activity) for s in journal.stretches()] == [(s.start, s.activity) for s in before]


def test_another_file_is_told_in_a_sentence(tmp_path, journal):
    with sqlite3.connect(journal.path) as base:
        base.execute("pragma user_version = 2")
    with pytest.raises(ValueError, match="must be a journal of version 1, got one of version 2"):
        Journal(journal.path)
    with sqlite3.connect(tmp_path / "other.sqlite") as base:
        base.execute("create table t (x)")
    with pytest.raises(ValueError, match="got one of another program"):
        Journal(tmp_path / "other.sqlite")
    (tmp_path / "text.sqlite").write_text("no database, but longer than the header of one " * 50)
    with pytest.raises(ValueError, match="must be a journal that can be read"):
        Journal(tmp_path / "text.sqlite")


def test_hours_of_a_day_cut_stretches_over_midnight():
    stretch = Stretch("anna", datetime(2026, 11, 23, 22), datetime(2026, 11, 25, 9), "sitting")
    parts = list(within_hours([stretch], time(8), time(23)))
    assert [(p.start.day, p.start.hour, p.end.day, p.end.hour) for p in parts] == [
        (23, 22, 23, 23),
        (24, 8, 24, 23),
        (25, 8, 25, 9),
    ]
    with pytest.raises(ValueError, match="the hours must end after they begin"):
        list(within_hours([stretch], time(12), time(8)))


def test_activities_come_back_from_their_table(tmp_path):
    entries = minutes((1, "sitting"), (0.505, "unseen"), (2, "left_hand"))
    write_activities_csv(tmp_path / "activities.csv", entries)
    found = read_activities_csv(tmp_path / "activities.csv")
    assert [(e.start_s, e.end_s, e.activity) for e in found] == [
        (pytest.approx(e.start_s, abs=5e-4), pytest.approx(e.end_s, abs=5e-4), e.activity) for e in entries
    ]
    assert [math.isnan(e.log_odds) for e in found] == [False, True, False]
    header, first, *_ = (tmp_path / "activities.csv").read_text().splitlines()
    assert (header, first) == ("start_s,end_s,activity,log_odds", "0.000,60.000,sitting,1.2500")
    write_activities_csv(tmp_path / "none.csv", [])
    assert read_activities_csv(tmp_path / "none.csv") == []


def test_a_table_that_is_none_is_told_in_a_sentence(tmp_path):
    path = tmp_path / "activities.csv"
    path.write_text("frame,time_s\n")
    with pytest.raises(ValueError, match="must have the columns start_s, end_s, activity, log_odds"):
        read_activities_csv(path)
    path.write_text("start_s,end_s,activity,log_odds\n3,2,sitting,\n")
    with pytest.raises(ValueError, match=r"an entry must end after its start, got 3\.0 to 2\.0 s"):
        read_activities_csv(path)


def test_questions_from_the_command_line(journal, capsys, tmp_path):
    file = str(journal.path)
    assert main([file, "--person", "anna", "--activity", "sitting", "--before", "12:00"]) == 0
    assert capsys.readouterr().out == "1:45:00\n"
    assert main([file, "--person", "anna", "--by", "hour", "--day", "2026-11-24"]) == 0
    assert capsys.readouterr().out.splitlines()[1].split() == ["2026-11-24", "00:00", "1:00:00"]
    assert main([file, "--transitions"]) == 0
    assert capsys.readouterr().out.splitlines()[0].split() == ["1", "sitting", "->", "unseen"]
    assert main([str(tmp_path / "none.sqlite")]) == 2
    assert "there must be a journal at" in capsys.readouterr().err
    assert not (tmp_path / "none.sqlite").exists()
    assert main([file, "--day", "2020-01-01", "--timeline", str(tmp_path / "t.png")]) == 2
    assert "a timeline needs entries, got none" in capsys.readouterr().err


def test_the_timeline_shows_each_stretch_in_its_place(journal, tmp_path):
    plot_timeline(tmp_path / "timeline.png", journal.stretches("anna"))
    image = cv2.imread(str(tmp_path / "timeline.png"))
    blue, orange = (image == (178, 114, 0)).all(2), (image == (0, 159, 230)).all(2)  # sitting, walking; BGR
    legend = image.shape[0] // 4
    rows = [mask[legend:].nonzero()[0] for mask in (blue, orange)]
    assert rows[0].max() < rows[1].max()  # the second day she only walked
    columns = [mask[legend:].nonzero()[1] for mask in (blue, orange)]
    assert columns[1].min() < columns[0].min()  # just after midnight
    assert columns[1].max() > columns[0].max()  # until midnight
