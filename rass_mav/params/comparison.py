"""Compares a parameter file with a vehicle: what is the same, what differs, what the firmware does not have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

from rass_mav.mavlink.component import PERMISSION_DENIED, READ_ONLY, VALUE_OUT_OF_RANGE
from rass_mav.mavlink.firmware import PX4, firmware_name
from rass_mav.mavlink.vehicle_parameters import ParameterValue, fits, same

from .exchange import Autopilot, Exchange, VehicleError
from .files import Entry, ParameterFile
from .names import (
    SYSTEM_ID_NAMES,
    fitting_file,
    made_for,
    needs_reboot,
    other_name,
    replaced_in_px4,
    system_id_names,
)
from .session import Session

_REASONS = {
    VALUE_OUT_OF_RANGE: "the value is out of range",
    PERMISSION_DENIED: "setting it is not permitted",
    READ_ONLY: "it is read-only",
}


class Row(NamedTuple):
    """One parameter of the file."""

    entry: Entry
    live: ParameterValue | None
    """The vehicle's value; None: it does not have the parameter."""
    state: Literal["same", "differs", "kept", "unfit", "missing", "written", "refused"]
    """kept: it differs, but is only set on request; unfit: the vehicle's parameter cannot hold the file's value;
    written, refused: after `apply`."""
    note: str = ""
    """A remark for people; may be empty."""

    def plain(self) -> dict[str, Any]:
        """The row for JSON."""
        return {
            "name": self.entry.name,
            "line": self.entry.line,
            "file": self.entry.value,
            "vehicle": None if self.live is None else self.live.value,
            "state": self.state,
            "reboot": self.entry.reboot,
            "note": self.note or None,
        }


class Comparison(NamedTuple):
    """A file and a vehicle."""

    autopilot: Autopilot
    rows: tuple[Row, ...]
    """In the order of the file."""
    fitting: str | None
    """The file of firmware_params/ that matches this vehicle; None: unknown."""
    misfit: str
    """Why the file is not for this vehicle; empty: it is."""

    def vehicle(self) -> str:
        """A description of the vehicle for people."""
        autopilot = self.autopilot
        state = "armed" if autopilot.armed else "disarmed"
        return f"vehicle {autopilot.system_id}: {autopilot.firmware} {state}"

    @property
    def version(self) -> str | None:
        """Version of the firmware, major.minor.patch; None: not reported."""
        version = self.autopilot.version.version
        return ".".join(map(str, version)) if any(version) else None


async def compare(
    session: Session, system_id: int, file: ParameterFile, new_system_id: int | None = None
) -> Comparison:
    """Ask the vehicle for each parameter of the file. For missing ones, also try the names in other versions.

    :param system_id: of the autopilot; 0: the first one heard.
    :param new_system_id: the system id that it should have, whatever is in the file, 1..255; None: unchanged.
    :raises VehicleError: it is not heard, does not answer, or its name for the system id is unknown.
    """
    autopilot = await session.find(system_id)
    entries = file.entries
    if new_system_id is not None:
        name = await _system_id_name(session, autopilot)
        # Set it last: the ground station may lose a vehicle whose id changes.
        entries = tuple(entry for entry in entries if entry.name not in SYSTEM_ID_NAMES)
        entries += (Entry(name, new_system_id, None, None, needs_reboot(name)),)
    names = [entry.name for entry in entries]
    # The vehicle may know nothing from another autopilot's file.
    foreign = made_for(frozenset(names)) not in (None, autopilot.type)
    read = await session.read(autopilot, names, guesses=foreign)
    others = {name: other for name in (*read.silent, *read.refused) if (other := other_name(name))}
    guesses = sorted(set(others.values()) - read.values.keys())
    found = read.values.keys() | (await session.read(autopilot, guesses, guesses=True)).values.keys()
    renamed = {name: other for name, other in others.items() if other in found}
    rows = tuple(_row(entry, read, renamed, autopilot) for entry in entries)
    if new_system_id is None:
        rows = tuple(_unless_asked(row) for row in rows)
    fitting = fitting_file(autopilot.firmware, frozenset(found))
    return Comparison(autopilot, rows, fitting, _misfit(autopilot, rows, renamed, fitting))


async def _system_id_name(session: Session, autopilot: Autopilot) -> str:
    names = system_id_names(autopilot.firmware)
    if len(names) > 1:
        names = tuple((await session.read(autopilot, names, guesses=True)).values)
    if len(names) != 1:
        raise VehicleError(f"vehicle {autopilot.system_id}: this firmware's name for the system id is unknown")
    return names[0]


def _unless_asked(row: Row) -> Row:
    if row.state == "differs" and row.entry.name in SYSTEM_ID_NAMES:
        return row._replace(state="kept", note="use --sysid to set a system id")
    return row


def _row(entry: Entry, read: Exchange, renamed: dict[str, str], autopilot: Autopilot) -> Row:
    live = read.values.get(entry.name)
    if live is None:
        return Row(entry, None, "missing", _why_missing(entry.name, renamed, autopilot))
    if not fits(entry.value, live.kind):
        return Row(entry, live, "unfit", f"its type on the vehicle is {live.kind}, which cannot hold {entry.value:.9g}")
    equal = same(entry.value, live.value, live.kind, bytewise=autopilot.bytewise)
    if equal and entry.name in SYSTEM_ID_NAMES and live.value != autopilot.system_id:
        return Row(entry, live, "same", f"but the vehicle still uses {autopilot.system_id}: reboot it")
    return Row(entry, live, "same" if equal else "differs")


def _why_missing(name: str, renamed: dict[str, str], autopilot: Autopilot) -> str:
    if name in renamed and replaced_in_px4(name):
        return f"this firmware has {renamed[name]} instead, with different meanings of the values"
    if name in renamed:
        return f"this firmware calls it {renamed[name]}"
    if autopilot.type == PX4:
        return "not in this firmware, or visible only after a reboot"
    return "not in this firmware or on this board"


def _misfit(autopilot: Autopilot, rows: Sequence[Row], renamed: dict[str, str], fitting: str | None) -> str:
    made = made_for(frozenset(row.entry.name for row in rows))
    here = firmware_name(autopilot.type)
    use = f"; use {fitting}" if fitting else ""
    if made is not None and made != autopilot.type:
        return f"the file is for {firmware_name(made)}, this is {here}{use}"
    names = [name for name in renamed if not replaced_in_px4(name)]
    if names:
        return f"the file is for another version of {here}{use}"
    return ""


async def apply(session: Session, system_id: int, rows: Sequence[Row]) -> list[Row]:
    """Set the parameters that differ, in the order of the file, and read them back.

    :param rows: from a comparison with the same vehicle.
    :returns: the rows that differed, with their new state: written or refused.
    :raises VehicleError: the vehicle is not heard or is armed (then nothing was set), or it stopped answering.
    """
    autopilot = await session.find(system_id)
    if autopilot.armed:
        raise VehicleError(f"vehicle {autopilot.system_id} is armed: nothing was written")
    due = [row for row in rows if row.state == "differs"]
    wanted = [row.live._replace(value=row.entry.value) for row in due if row.live is not None]
    answers, held = await session.write(autopilot, wanted)
    return [_written(row, answers, held, autopilot) for row in due]


def _written(row: Row, answers: Exchange, held: Exchange, autopilot: Autopilot) -> Row:
    name, value = row.entry.name, row.entry.value
    live = held.values.get(name)
    if live is None:
        return row._replace(state="refused", note="no answer when reading it back")
    if same(value, live.value, live.kind, bytewise=autopilot.bytewise):
        if name in SYSTEM_ID_NAMES:
            # Some vehicles use the new system id at once.
            row = row._replace(entry=row.entry._replace(reboot=autopilot.system_id != value))
        return row._replace(state="written", live=live)
    note = _REASONS.get(answers.refused.get(name, 0), "the vehicle keeps its value")
    return row._replace(state="refused", live=live, note=note)
