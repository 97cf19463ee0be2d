"""Writes the pages of docs/reference that follow from the program: every command and option, every key of a
configuration and of a scenario, every field of `rass-mav status --json`.

    python -m tools.reference

What they say is said in the program: in the help of the commands, in the docstrings of the settings, and in
docs/schemas/status.json. Mend it there.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import json
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import NoneType
from typing import Any, Literal, get_args, get_origin

import yaml

from rass_mav.app.config import RunConfig
from rass_mav.cli import build_parser
from rass_mav.commands.common import listed
from rass_mav.config.sections import Field, Meta, Section, fields_of
from rass_mav.config.typed import alternatives, plain, shown
from rass_mav.lab.swarm.scenario import Scenario, find, shipped
from tools.pages import ROOT, filled, named, table, write

FOLDER = "docs/reference"
PAGES = tuple(f"{FOLDER}/{name}.md" for name in ("command-line", "configuration", "status", "scenarios"))
#: Units that the ends of keys name.
_UNITS = {
    "_m_s": "m/s", "_bytes_s": "bytes/s", "bytes_s": "bytes/s", "frames_s": "frames/s", "_s": "s", "_steps": "steps",
    "_bytes": "bytes", "bytes": "bytes", "_items": "data", "_us": "us", "_mhz": "MHz", "_khz": "kHz",
    "_dbm": "dBm", "_db": "dB", "_m": "m", "bitrate": "bit/s", "baud": "bit/s", "ttl": "hops", "duty": "share",
}  # fmt: skip


def linked(text: str) -> str:
    """The text with links where it names pages."""

    def link(found: re.Match[str]) -> str:
        folder, name = found[1], found[2]
        return f"[{name}](../{folder}/{name})" if f"docs/{folder}" != FOLDER else f"[{name}]({name})"

    return re.sub(r"docs/([\w-]+)/([\w-]+\.(?:md|json))", link, " ".join(text.split()))


def paragraph(text: str) -> list[str]:
    """The lines of a paragraph, with links."""
    return textwrap.wrap(linked(text), 138, break_long_words=False, break_on_hyphens=False)


# -- command-line.md ---------------------------------------------------------------------------------------------------


def parsers(parser: argparse.ArgumentParser, name: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """The commands below a parser with their names, `keys drone` after `keys`."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for word, below in action.choices.items():
                whole = f"{name} {word}".strip()
                yield whole, below
                yield from parsers(below, whole)


def _argument(action: argparse.Action) -> str:
    shown = action.metavar or action.dest.upper()
    name = " ".join(shown) if isinstance(shown, tuple) else str(shown)
    if not action.option_strings:
        more = {"?": f"[{name}]", "*": f"[{name} ...]", "+": f"{name} [{name} ...]"}
        return f"`{more.get(str(action.nargs), name)}`"
    value = "" if action.nargs == 0 else f" [{name}]" if action.nargs == "?" else f" {name}"
    return ", ".join(f"`{option}{value}`" for option in action.option_strings)


def _help(action: argparse.Action, parser: argparse.ArgumentParser) -> str:
    known = [str(name) for name in listed(action) or action.choices or ()]
    names = "" if all(name in str(action.help) for name in known) else ", ".join(f"`{name}`" for name in known)
    text = str(action.help) % {**vars(action), "prog": parser.prog}
    return linked(f"{text}: {names}" if names else text)


def _options(parser: argparse.ArgumentParser) -> list[tuple[str, str]]:
    """The arguments of a command with their meaning, but those that every command takes; the options last."""
    actions = [
        action
        for action in parser._actions
        if not isinstance(action, argparse._SubParsersAction) and not {"-h", "-v", "--json"} & {*action.option_strings}
    ]
    actions.sort(key=lambda action: bool(action.option_strings))
    return [(_argument(action), _help(action, parser)) for action in actions]


def _shared(found: Mapping[str, argparse.ArgumentParser], group: str) -> list[tuple[str, str]]:
    """The arguments that most of the many commands of a group take."""
    below = [_options(parser) for name, parser in found.items() if name.startswith(f"{group} ")]
    rows = list(dict.fromkeys(row for options in below for row in options))
    shared = [row for row in rows if sum(row in options for options in below) > len(below) // 2]
    return shared if len(shared) > 2 else []


def _described(parser: argparse.ArgumentParser) -> list[str]:
    """What a command does, in paragraphs. Lines with commands are only for `--help`."""
    paragraphs = [one for one in str(parser.description).split("\n\n") if "rass-mav completion" not in one]
    return [line for one in paragraphs for line in ("", *paragraph(one))][1:]


def commands() -> Iterator[str]:
    """Each command with its options and an example."""
    found = dict(parsers(build_parser()))
    head = ("argument", "meaning")
    for name, parser in found.items():
        group, _, word = name.partition(" ")
        yield from ("", f"{'####' if word else '###'} {name}", "", *_described(parser))
        shared, options = _shared(found, group), _options(parser)
        if shared and not word:
            yield from ("", "Most of them take:", "", *table(head, shared))
        elif options:
            whole = set(shared) <= set(options)
            rows = [row for row in options if not (whole and row in shared)]
            lead = f"Besides [what most of them take](#{group}):" if whole else "It takes only:"
            yield from ("", *((lead, "") if shared else ()), *table(head, rows))
        if word or not any(other.startswith(f"{name} ") for other in found):
            yield from ("", "    " + str(parser.epilog).removeprefix("example: "))


# -- keys of sections --------------------------------------------------------------------------------------------------


def docstrings(section: type) -> dict[str, str]:
    """What a class says of its fields, by name: the string below each."""
    found: dict[str, str] = {}
    for one in reversed(section.__mro__):
        if not issubclass(one, Section) or one is Section:
            continue
        [body] = ast.parse(textwrap.dedent(inspect.getsource(one))).body
        assert isinstance(body, ast.ClassDef)
        for field, about in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                text = (
                    about.value.value if isinstance(about, ast.Expr) and isinstance(about.value, ast.Constant) else ""
                )
                if isinstance(text, str) and (text or field.target.id not in found):
                    found[field.target.id] = text
    return found


def _bounds(bounds: Meta | None, what: str) -> str:
    if bounds is None:
        return what
    least, most = bounds.ge, bounds.le
    if least is not None and most is not None:
        return f"{least}..{most}" if what == "whole number" else f"{least:g}..{most:g}"
    limits = ((">=", bounds.ge), (">", bounds.gt), ("<=", bounds.le), ("<", bounds.lt))
    return " ".join([what, " and ".join(f"{sign} {limit}" for sign, limit in limits if limit is not None)]).strip()


def _kind(kind: Any, bounds: Meta | None) -> str:
    origin, members = get_origin(kind), get_args(kind)
    if kind is bool:
        return "`true`, `false`"
    if kind in (int, float):
        return _bounds(bounds, "whole number" if kind is int else "number")
    if origin is Literal:
        return ", ".join(f"`{name}`" for name in members)
    if bounds is not None and bounds.one_of is not None:
        return ", ".join(f"`{name}`" for name in bounds.one_of())
    if kind is str:
        return "text"
    if origin is tuple and members[-1] is not Ellipsis:
        return f"[{', '.join(values(member, '') for member in members)}]"
    if origin in (list, tuple):
        inner = values(members[0], "")
        return "list" if inner in ("section", "text") else f"list of {inner}"
    if origin is dict:
        return "section"
    return "section" if inspect.isclass(kind) and issubclass(kind, Section) else "any"


def values(hint: Any, name: str) -> str:
    """What a key may be, in the words of the page."""
    found = [(kind, bounds) for kind, bounds in alternatives(hint)]
    texts = list(dict.fromkeys(_kind(kind, bounds) for kind, bounds in found if kind is not NoneType))
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    number = any(kind in (int, float) for kind, _ in found)
    text = ", ".join(texts) + (f", {unit}" if unit and number else "")
    return f"{text}; null" if any(kind is NoneType for kind, _ in found) else text


def default(field: dataclasses.Field[Any]) -> str:
    """The default of a key; empty: it has none."""
    value = field.default
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    if value is dataclasses.MISSING:
        return "required"
    if isinstance(value, str):
        return f"`{value}`" if value else '`""`'
    if isinstance(value, dict):
        return "`{" + ", ".join(f"{key}: {shown(item)}" for key, item in value.items()) + "}`"
    value = plain(value)
    if isinstance(value, (list, tuple)) and value:
        return "`[" + ", ".join(f"{item:g}" for item in value) + "]`"
    if isinstance(value, float) and value.is_integer():
        return f"`{value:.0f}`" if value < 1e6 else f"`{value:g}`"
    return f"`{shown(value).replace(chr(39), '')}`"


def _inner(hint: Any) -> tuple[type[Section] | None, str]:
    """The section that a key holds, and how it is reached from there: as it is, or `[]` in a list."""
    for kind, _ in alternatives(hint):
        if inspect.isclass(kind) and issubclass(kind, Section):
            return kind, ""
        if get_origin(kind) in (list, tuple):
            inner, end = _inner(get_args(kind)[0])
            if inner is not None:
                return inner, f"[]{end}"
    return None, ""


def keys(section: type[Section], path: str, other: Callable[[type[Section], str], list[str] | None]) -> Iterator[str]:
    """The tables of a section and of those in it. `other`: what stands in place of a section's own table, by its
    class and path."""
    about = docstrings(section)
    fields: dict[str, dataclasses.Field[Any]] = {
        one.name: one
        for one in dataclasses.fields(section)  # type: ignore[arg-type]  # subclasses are
    }
    below: list[tuple[type[Section], str, Field]] = []
    rows = []
    for field in fields_of(section):
        inner, end = _inner(field.hint)
        if inner is not None:
            below.append((inner, f"{path}.{field.name}{end}".removeprefix("."), field))
        else:
            said = linked(about.get(field.name, ""))
            rows.append((f"`{field.name}`", values(field.hint, field.name), default(fields[field.name]), said))
    if rows:
        yield from table(("key", "value", "default", "meaning"), rows)
    for inner, name, field in below:
        lines = other(inner, name)
        yield from ("", f"### {name}", "", *paragraph(about.get(field.name, "") or inspect.getdoc(inner) or ""))
        yield from ("", *(lines if lines is not None else keys(inner, name, other)))


def configuration() -> Iterator[str]:
    """Every key of a node's configuration."""
    yield from list(keys(RunConfig, "", lambda section, path: None))[1:]


# -- scenarios.md ------------------------------------------------------------------------------------------------------


def scenarios() -> list[str]:
    """The scenarios that ship with the program."""
    rows = []
    for name in shipped():
        raw = yaml.safe_load(find(name).read_text(encoding="utf-8"))
        of = {field.name: field.default for field in dataclasses.fields(Scenario)}
        rows.append(
            (f"`{name}`", f"{raw.get('nodes', of['nodes']):,}", f"{raw.get('steps', of['steps']):,}", raw["title"])
        )
    return table(("scenario", "nodes", "steps", "what it is"), rows)


def as_in_a_configuration(section: type[Section], path: str) -> list[str] | None:
    """A section that configurations have too: the page says where they differ."""
    theirs = {field.name: _inner(field.hint)[0] for field in fields_of(RunConfig)}
    known = theirs.get(path)
    shared = {"radio.airtime": "linksairtime"}
    if path in shared:
        return [f"As [in a configuration](configuration.md#{shared[path]})."]
    if known is None or not issubclass(known, section):
        return None
    both = {field.name for field in fields_of(section)}
    more = [f"`{field.name}`" for field in fields_of(known) if field.name not in both]
    ours, others = (
        {one.name: default(one) for one in dataclasses.fields(of)}  # type: ignore[arg-type]  # subclasses are
        for of in (section, known)
    )
    differs = [f"`{name}` is {ours[name]} by default" for name in ours if ours[name] != others[name]]
    without = [f"{', '.join(more)} {'does' if len(more) == 1 else 'do'} not exist here"] if more else []
    text = "; ".join([*differs, *without])
    return [f"As [in a configuration](configuration.md#{path})" + (f", but {text}." if text else ".")]


def scenario() -> Iterator[str]:
    """Every key of a scenario."""
    yield from keys(Scenario, "", as_in_a_configuration)


# -- status.md ---------------------------------------------------------------------------------------------------------


def _types(schema: dict[str, Any]) -> str:
    if "enum" in schema:
        return ", ".join("null" if one is None else f"`{one}`" for one in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    kinds = schema.get("type", "object")
    words = {"integer": "whole number", "array": "list", "string": "text", "boolean": "`true`, `false`"}
    found = [words.get(kind, kind) for kind in ([kinds] if isinstance(kinds, str) else kinds) if kind != "null"]
    return ", ".join(found) + ("; null" if "null" in kinds and not isinstance(kinds, str) else "")


def _fields(schema: dict[str, Any], path: str = "") -> Iterator[tuple[str, str, str, str]]:
    """The rows of an object, and of those in it."""
    for name, of in schema.get("properties", {}).items():
        whole = f"{path}.{name}" if path else name
        inner = of.get("items", of)
        whole += "[]" if of.get("type") == "array" or "array" in of.get("type", ()) else ""
        promised = "" if "$comment" in of else "yes"
        yield f"`{whole}`", _types(of), promised, linked(of["description"])
        yield from _fields(inner, whole)


def status() -> Iterator[str]:
    """Every field of the status, by objects."""
    schema = json.loads((ROOT / "docs/schemas/status.json").read_text(encoding="utf-8"))
    head = ("field", "value", "promised", "meaning")
    simple = {name: of for name, of in schema["properties"].items() if not ("properties" in of or "items" in of)}
    yield from ("### node", "", "The node itself.", "", *table(head, _fields({"properties": simple})))
    for name, of in schema["properties"].items():
        if name not in simple:
            inner = of.get("items", of)
            promised = "" if "$comment" in of else " The field is promised."
            yield from ("", f"### {name}{'[]' if 'items' in of else ''}", "")
            yield from paragraph(f"{of['description']}.{promised}")
            if "properties" in inner:
                yield from ("", *table(head, _fields(inner)))


def files() -> dict[str, str]:
    """The pages, and what is on them."""
    parts: dict[str, Callable[[], Iterable[str]]] = {
        "commands": commands, "keys of a node": configuration, "fields": status, "scenarios": scenarios,
        "keys of a scenario": scenario,
    }  # fmt: skip
    return {page: filled(page, {name: list(parts[name]()) for name in named(page)}) for page in PAGES}


def main() -> None:
    """Writes them."""
    write(files())


if __name__ == "__main__":
    main()
