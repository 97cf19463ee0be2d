"""A mission's folder: the ground's keys, and the files that drones get (docs/how-to/keys.md)."""

from __future__ import annotations

import fcntl
import os
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

from rass_mav.errors import KeysError, why

from .certificate import BASE_SERIAL
from .files import (
    GROUND_FILE,
    MAX_NUMBER,
    drone_file,
    drone_text,
    ground_text,
    read_ground,
    read_keys,
    write_new,
    write_over,
)
from .identity import Ground, NodeKeys
from .secret import SECRET_SIZE, Secret

#: What `issue` does: a new drone, another one in the place of a drone, or the same drone once more.
Issue = Literal["new", "replace", "again"]


class Issued(NamedTuple):
    """A drone's file that was written."""

    keys: NodeKeys
    path: Path


def create(folder: Path) -> Ground:
    """Create a mission in a folder, which need not exist. Raises `KeysError`."""
    ground = Ground(Secret(secrets.token_bytes(SECRET_SIZE)))
    path = folder / GROUND_FILE
    with _reported(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            write_new(path, ground_text(ground))
        except FileExistsError:
            raise KeysError(
                f"{path}: already exists, and these keys could not be recovered", "choose another folder"
            ) from None
    return ground


def issue(folder: Path, node_ids: Iterable[int], how: Issue = "new") -> list[Issued]:
    """Write the files of drones. Raises `KeysError`, and writes nothing, if one of them cannot be issued this way."""
    node_ids = list(dict.fromkeys(node_ids))
    with _held(folder) as ground:
        for node_id in node_ids:
            _check(folder, ground, node_id, how)
        if how != "again":
            raised = {node_id: ground.serials.get(node_id, BASE_SERIAL) + 1 for node_id in node_ids}
            ground = replace(ground, serials={**ground.serials, **raised}, revoked=ground.revoked.difference(node_ids))
            # Before the drones' files, so that no serial is assigned twice.
            write_over(folder / GROUND_FILE, ground_text(ground))
        return _write(folder, ground, node_ids)


def change(folder: Path, revoke: Iterable[int] = ()) -> tuple[Ground, list[Issued]]:
    """Change the link key, and write the files of all drones again but of those that are revoked. Raises `KeysError`.

    :param revoke: node ids of drones that get nothing any more; those that were revoked before stay so.
    """
    out = frozenset(revoke)
    with _held(folder) as ground:
        for node_id in sorted(out):
            if node_id not in ground.serials:
                raise KeysError(f"drone {node_id}: has no keys to revoke", f"rass-mav keys show {folder / GROUND_FILE}")
            if node_id in ground.revoked:
                raise KeysError(
                    f"drone {node_id}: is already revoked (serial {ground.serials[node_id]})",
                    "--replace creates new keys for another drone in its place",
                )
        if ground.number == MAX_NUMBER:
            raise KeysError(f"{folder}: all link key numbers are used up", "create a new mission")
        ground = replace(ground, number=ground.number + 1, revoked=ground.revoked | out)
        remaining = [node_id for node_id in sorted(ground.serials) if node_id not in ground.revoked]
        for node_id in remaining:
            _check_own(folder, ground, node_id)
        write_over(folder / GROUND_FILE, ground_text(ground))
        return ground, _write(folder, ground, remaining)


def drone_keys(folder: Path, node_id: int, serial: int | None) -> NodeKeys:
    """The keys of a drone of the mission in a folder, of now or of an earlier serial. Raises `KeysError`.

    :param serial: None: the last one.
    """
    ground = read_ground(folder / GROUND_FILE)
    last = ground.serials.get(node_id)
    if last is None:
        raise KeysError(f"drone {node_id}: has no keys yet", f"rass-mav keys drone {node_id} -d {folder}")
    if serial is not None and serial > last:
        raise KeysError(f"drone {node_id}: its last serial is {last}, not {serial}", f"choose 1 to {last}")
    return ground.node(node_id, last if serial is None else serial)


def _check(folder: Path, ground: Ground, node_id: int, how: Issue) -> None:
    """Whether a drone's file can be written."""
    serial = ground.serials.get(node_id)
    if how == "new" and serial is not None:
        raise KeysError(
            f"drone {node_id}: already has keys (serial {serial})",
            "--replace: for another drone in its place; --again: for the same drone",
        )
    if how != "new" and serial is None:
        raise KeysError(f"drone {node_id}: has no keys yet", f"rass-mav keys drone {node_id} -d {folder}")
    if how == "again" and node_id in ground.revoked:
        raise KeysError(
            f"drone {node_id}: is revoked (serial {serial})",
            "--replace creates new keys for another drone in its place",
        )
    _check_own(folder, ground, node_id)


def _check_own(folder: Path, ground: Ground, node_id: int) -> None:
    """A file that is not this drone's own is not written over."""
    path = folder / drone_file(node_id)
    if not os.path.lexists(path):
        return
    try:
        keys = read_keys(path)
    except KeysError as error:
        raise KeysError(error.text, f"{error.remedy}, or move the file away") from None
    if not isinstance(keys, NodeKeys) or keys.ground != ground.public or keys.certificate.node_id != node_id:
        raise KeysError(f"{path}: does not hold the keys of drone {node_id} of this mission", "move the file away")


def _write(folder: Path, ground: Ground, node_ids: Iterable[int]) -> list[Issued]:
    issued = [
        Issued(ground.node(node_id, ground.serials[node_id]), folder / drone_file(node_id)) for node_id in node_ids
    ]
    for keys, path in issued:
        write_over(path, drone_text(keys))
    return issued


@contextmanager
def _held(folder: Path) -> Iterator[Ground]:
    """The mission in a folder, which only one command at a time changes."""
    with _reported(folder):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            if not (path := folder / GROUND_FILE).exists():
                raise KeysError(
                    f"{path}: no such file", "name the mission's folder (-d DIR), or create one (rass-mav keys new DIR)"
                )
            yield read_ground(path)
        finally:
            os.close(descriptor)


@contextmanager
def _reported(folder: Path) -> Iterator[None]:
    """Turn an `OSError` into a `KeysError`."""
    try:
        yield
    except OSError as error:
        place = error.filename or folder
        raise KeysError(f"{place}: {why(error)}", "use a mission's folder that you can write to (-d DIR)") from None
