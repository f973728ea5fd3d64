"""Settings: frozen dataclasses filled from YAML files and from `key=value`, and described for people.

Defaults stand once, beside the class; the files hold only differences. Whatever is wrong is a ValueError of
one sentence: what was expected, what came, what to do.
"""

import dataclasses
import difflib
import inspect
import io
import textwrap
import tokenize
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar, cast

import yaml
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

Config = TypeVar("Config")
_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}


def compose_config(
    config_type: type[Config], folder: Path, name: str, overrides: Sequence[str] = ()
) -> Config:
    """The dataclass `config_type`, filled from `folder/name.yaml`, the groups it names, and `overrides`.

    An override is `key=value`, with dots between the levels, or `group=NAME`, which takes
    `folder/group/NAME.yaml`. Raises ValueError for an unknown key, with the nearest name, or a wrong value.
    """
    groups = config_groups(folder, name)
    choices: list[str] = []
    values: dict[str, str] = {}
    for override in overrides:
        key, equals, value = override.partition("=")
        if not key or not equals:
            raise ValueError(f"settings must be given as key=value, got {override!r}; --help-all lists them")
        if key not in groups:
            values[key] = value
        elif value in groups[key]:
            choices.append(override)
        else:
            raise ValueError(f"unknown {key} {value!r}; {_suggestion(value, groups[key])}")
    config = _unlock(OmegaConf.structured(config_type))
    for key, value in _leaves(_compose(folder, name, choices)):
        _update(config, key, value, _field_type(config_type, groups, key))
    for key, text in values.items():
        field_type = _field_type(config_type, groups, key)
        _update(config, key, _parse(text, key, field_type), field_type)
    return cast(Config, _build(config_type, cast(dict, OmegaConf.to_container(config))))


def config_groups(folder: Path, name: str) -> dict[str, list[str]]:
    """The groups in the defaults list of `folder/name.yaml`, and the names to choose from in each."""
    content = yaml.safe_load((folder / f"{name}.yaml").read_text(encoding="utf-8")) or {}
    entries = (entry for entry in content.get("defaults", ()) if isinstance(entry, dict))
    groups = [
        next(iter(entry)).split()[-1] for entry in entries
    ]  # `optional experiment: null` is a group, too
    return {group: sorted(path.stem for path in (folder / group).glob("*.yaml")) for group in groups}


def setting_rows(config: object, prefix: str = "") -> list[tuple[str, str]]:
    """Every setting of a dataclass as `key=value` with its meaning, the comment beside it; nested ones come last."""
    return list(_rows(config, prefix))


def _compose(folder: Path, name: str, choices: list[str]) -> DictConfig:
    try:
        with initialize_config_dir(str(folder.resolve()), version_base=None):
            return compose(name, choices)
    except (HydraException, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"the files in {folder} must go together, got: {reason}; correct them") from None


def _unlock(config: DictConfig) -> DictConfig:
    """`config` itself, made writable: OmegaConf takes over that its dataclasses are frozen."""
    OmegaConf.set_readonly(config, None)
    for value in config.values():
        if isinstance(value, DictConfig):
            _unlock(value)
    return config


def _leaves(config: DictConfig, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in config.items():
        key = f"{prefix}{name!s}"
        if isinstance(value, DictConfig):
            yield from _leaves(value, f"{key}.")
        else:
            yield key, value


def _field_types(config_type: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(config_type)
    return {field.name: hints[field.name] for field in dataclasses.fields(config_type)}


def _field_type(config_type: type, groups: Mapping[str, Sequence[str]], key: str) -> Any:
    """The type of the setting `key`; ValueError, with the nearest name, where there is none."""
    current: Any = config_type
    known: list[str] = list(groups)
    for part in key.split("."):
        fields = _field_types(current) if dataclasses.is_dataclass(current) else {}
        if part not in fields:
            raise ValueError(
                f"unknown config key {key!r}; {_suggestion(part, list(dict.fromkeys([*fields, *known])))}"
            )
        current, known = fields[part], []
    if dataclasses.is_dataclass(current):
        first = next(iter(_field_types(current)))
        raise ValueError(f"{key} must be given one setting at a time, such as {key}.{first}=...")
    return current


def _suggestion(name: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, known, 1)
    if near:
        return f"did you mean {near[0]!r}?"
    return f"there are {', '.join(known)}" if known else "there is nothing below it"


def _without_none(field_type: Any) -> tuple[Any, bool]:
    """The type without its `| None`, and whether it had one."""
    if typing.get_origin(field_type) not in (types.UnionType, typing.Union):
        return field_type, False
    kinds = [kind for kind in typing.get_args(field_type) if kind is not types.NoneType]
    return kinds[0], len(kinds) < len(typing.get_args(field_type))


def _parse(text: str, key: str, field_type: Any) -> Any:
    """The value that was typed: a text is taken as it stands, so that any path will do, all else is YAML."""
    kind, optional = _without_none(field_type)
    if kind is str:
        return None if optional and text == "null" else text
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise _wrong_value(key, text, field_type) from None


def _update(config: DictConfig, key: str, value: Any, field_type: Any) -> None:
    try:
        OmegaConf.update(config, key, value)
    except OmegaConfBaseException:
        raise _wrong_value(key, value, field_type) from None


def _wrong_value(key: str, value: object, field_type: Any) -> ValueError:
    kind, optional = _without_none(field_type)
    if isinstance(kind, type) and issubclass(kind, Enum):
        meaning = f"one of {', '.join(kind.__members__)}"
    elif typing.get_origin(kind) in (tuple, list):
        item = _without_none(typing.get_args(kind)[0])[0]
        meaning = f"a list [...], each item {_WORDS.get(item, item)}"
    else:
        meaning = _WORDS.get(kind, str(kind))
    return ValueError(
        f"{key} must be {meaning}{' or null' if optional else ''}, got {value!r}; correct the value"
    )


def _build(config_type: type, values: Mapping[str, Any], prefix: str = "") -> Any:
    """The dataclass with these values. (OmegaConf's own `to_object` leaves lists where tuples should be.)"""
    arguments = {}
    for name, field_type in _field_types(config_type).items():
        kind, _ = _without_none(field_type)
        value = values[name]
        if value is not None and dataclasses.is_dataclass(kind):
            value = _build(cast(type, kind), value, f"{prefix}{name}.")
        elif value is not None and typing.get_origin(kind) is tuple:
            value = tuple(value)
        arguments[name] = value
    try:
        return config_type(**arguments)
    except ValueError as error:
        remedy = "" if ";" in str(error) else "; correct it, --help-all says what it means"
        raise ValueError(f"{prefix}{error}{remedy}") from None


def _rows(config: Any, prefix: str) -> Iterator[tuple[str, str]]:
    """Each setting with its meaning; the nested ones come last."""
    comments = _comments(type(config))
    nested = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            nested.append((value, f"{prefix}{field.name}."))
        else:
            yield f"{prefix}{field.name}={_as_typed(value)}", comments.get(field.name, "")
    for value, longer in nested:
        yield from _rows(value, longer)


def _as_typed(value: object) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, tuple | list):
        return f"[{','.join(map(_as_typed, value))}]"
    return str(value)


def _comments(config_type: type) -> dict[str, str]:
    """The comment behind each field of a dataclass or, where there is none, the comment above it."""
    comments: dict[str, str] = {}
    for base in reversed(config_type.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        source = io.StringIO(textwrap.dedent(inspect.getsource(base)))
        line: list[tokenize.TokenInfo] = []  # the statement so far, and the comments above it
        for token in tokenize.generate_tokens(source.readline):
            if token.type in (tokenize.NL, tokenize.INDENT, tokenize.DEDENT):
                continue
            if token.type != tokenize.NEWLINE:
                line.append(token)
                continue
            code = [part for part in line if part.type != tokenize.COMMENT]
            notes = [part for part in line if part.type == tokenize.COMMENT]
            is_field = len(code) > 2 and code[1].string == ":" and code[0].start[1] == len("    ")
            if is_field:
                behind = [note for note in notes if note.start > code[0].start]
                text = " ".join(note.string.lstrip("# ") for note in behind or notes)
                comments[code[0].string] = text
            line = []
    return comments
