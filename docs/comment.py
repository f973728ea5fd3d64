"""The comment behind a field, or above it, as the field's description: an extension of Griffe, see mkdocs.yml.

So the reference says what `python infer.py --help` says: meaning and unit of every setting and of every array.
"""

import tokenize
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import griffe


def comment_of(lines: Sequence[str], first: int, last: int) -> str:
    """The comments within lines `first` to `last` of a file, counted from 1, or else right above them."""
    source = iter([line + "\n" for line in lines[first - 1 : last]])
    try:
        tokens = list(tokenize.generate_tokens(lambda: next(source, "")))
    except (tokenize.TokenError, IndentationError):  # a statement cut out of its block
        tokens = []
    notes = [token.string for token in tokens if token.type == tokenize.COMMENT]
    above = first - 2
    while not notes and above >= 0 and lines[above].strip().startswith("#"):
        above -= 1
    notes = notes or [line.strip() for line in lines[above + 1 : first - 1]]
    return " ".join(note.lstrip("# ") for note in notes if "noqa" not in note)


class FieldComments(griffe.Extension):
    """Describes fields by their comments, and leaves out what `__init__` keeps without a word."""

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        assert isinstance(cls.filepath, Path)
        lines = cls.lines_collection[cls.filepath]
        for name, member in list(cls.members.items()):
            if not isinstance(member, griffe.Attribute) or member.docstring or member.lineno is None:
                continue
            text = comment_of(lines, member.lineno, member.endlineno or member.lineno)
            if text:
                member.docstring = griffe.Docstring(text, parent=member)
            elif "class-attribute" not in member.labels and member.annotation is None:
                del cls.members[name]
