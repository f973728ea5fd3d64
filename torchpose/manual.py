"""What the commands say of themselves: `--help` on a screen or two, `--help-all` with every setting by stage."""

import dataclasses
import inspect
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence

from torchpose.settings import setting_rows

COLUMNS = 100
_SETTING = 34  # columns; the meaning of a longer setting goes below it

EXAMPLES: dict[str, str] = {
    "infer": """
python infer.py                                      a recording that the package makes itself
python infer.py recording=DIR output=DIR             yours: left/, right/, calibration.yaml
python infer.py recording=camera:0 calibration=FILE  a camera, live, with a page to look at
""",
    "train": """
python train.py                                      a small database that the package makes
python train.py experiment=thesis                    the whole of it, as in the thesis: hours
python train.py experiment=skeleton data.path=FILE   a skeleton data set
""",
}
FILES: dict[str, str] = {
    "infer": """
report.html    the run on one page, for a browser: start with this
poses.csv      a row a frame: joints in m, angles in degrees with standard deviations, status
poses.npz      the same and more, in full precision
poses.mot      and .trc for OpenSim, .bvh for Blender; export.formats= and export.filter=
overlay.mp4    the model over the images
angles.png     the joint angles over time, with bands of two standard deviations
person.yaml    the person's sizes, for pose.person=FILE of a later run
summary.json   settings, versions, timings, and what was wrong
and poses_2.csv ... for others; activities.csv with recognizer=DIR
""",
    "train": """
results.json   accuracy of each feature set, by class, confusions, settings
confusion.png  the confusions
recognizers/   the trained ones, for infer.py recognizer=DIR
""",
}
FIRST: dict[str, tuple[str, ...]] = {
    "infer": (
        *("recording", "right", "calibration", "background", "output", "max_frames", "max_width"),
        *("record_first", "fresh", "recognizer", "pose.height", "pose.person", "eyes.people", "device"),
    ),
    "train": (
        *("output", "fresh", "features", "split", "workers", "seed", "device"),
        *("data.path", "data.cache", "recognizer.hmm.states", "recognizer.codebook.size"),
    ),
}


def short_help(kind: str, config: object) -> str:
    """What `--help` prints: purpose, three commands, the files that are written, and the settings that matter first."""
    rows = {row[0].partition("=")[0]: row for _, section in sections(config) for row in section}
    return "\n".join(
        [
            inspect.getdoc(type(config)) or "",
            *("", f"usage: python {kind}.py [key=value ...] [--fresh]"),
            *_indented(EXAMPLES[kind]),
            *("", "Files written into the folder output=..."),
            *_indented(FILES[kind]),
            *("", "Settings that matter first, with their defaults"),
            *_settings(rows[name] for name in FIRST[kind] if name in rows),
            "",
            f"An interrupted run goes on when the command is given again; --fresh starts over.\n"
            f"--help-all lists all {len(rows)} settings.",
        ]
    )


def full_help(kind: str, config: object, groups: Mapping[str, Sequence[str]]) -> str:
    """What `--help-all` prints: the short help's head, then every setting under the heading of its stage."""
    lines = [inspect.getdoc(type(config)) or "", "", f"usage: python {kind}.py [key=value ...] [--fresh]"]
    for heading, rows in sections(config):
        lines += ["", heading, *_settings(rows)]
    if groups:
        lines += ["", "Sets of settings, from configs/"]
        lines += [f"  {group}=NAME, one of {', '.join(names)}" for group, names in groups.items()]
    return "\n".join(lines)


def sections(config: object, prefix: str = "") -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """Headings, and the settings with their meanings under each: the configuration's own, then those below it."""
    words = (inspect.getdoc(type(config)) or "").replace("\n", " ").partition(". ")[0].rstrip(".")
    if words.startswith(type(config).__name__):  # what dataclasses make up where there is no docstring
        words = ""
    own = [row for row in setting_rows(config, prefix) if "." not in row[0].partition("=")[0][len(prefix) :]]
    if own:
        yield textwrap.shorten(f"{prefix[:-1]}: {words}", COLUMNS) if prefix else "The command", own
    for field in dataclasses.fields(config):  # type: ignore[arg-type]
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from sections(value, f"{prefix}{field.name}.")


def _settings(rows: Iterable[tuple[str, str]]) -> list[str]:
    lines = []
    for setting, meaning in rows:
        wrapped = textwrap.wrap(meaning, COLUMNS - _SETTING - 4) or [""]
        if len(setting) > _SETTING:
            head, _, tail = setting.partition("=")  # a list may be longer than a line
            lines += [f"  {setting}"] if len(setting) < COLUMNS - 2 else [f"  {head}=", f"    {tail}"]
            setting = ""
        lines += [
            f"  {setting if i == 0 else '':<{_SETTING}}  {line}".rstrip() for i, line in enumerate(wrapped)
        ]
    return lines


def _indented(text: str) -> list[str]:
    return [f"  {line}" for line in text.strip().splitlines()]
