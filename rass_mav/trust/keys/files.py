"""Key files: what they look like, who may read them, and how they are written (docs/how-to/keys.md).

Errors never show what is in a file: it could be secret, whatever it looks like.
"""

from __future__ import annotations

import json
import os
import re
from contextlib import suppress
from dataclasses import field, replace
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

from nacl.bindings import crypto_scalarmult_base

from rass_mav.config.loading import MAX_FILE_BYTES, dump_yaml, opened, parse_yaml
from rass_mav.config.sections import Meta, NodeId, Section
from rass_mav.config.typed import build, plain
from rass_mav.errors import ConfigError, ForgedError, KeysError, MalformedError, why

from .certificate import CERTIFICATE_SIZE, PUBLIC_SIZE, Certificate, GroundPublic
from .identity import Ground, LinkKey, NodeKeys
from .secret import SECRET_SIZE, Purpose, Secret

#: Of the format of the files.
VERSION: Final = 1
#: The file of the ground in a mission's folder.
GROUND_FILE = "ground.keys"
#: A key file belongs to its owner alone.
MODE = 0o600

#: The highest serial, and number of a link key.
MAX_NUMBER = (1 << 32) - 1

F = TypeVar("F", bound="_File")
Number = Annotated[int, Meta(ge=1, le=MAX_NUMBER)]
Hex32 = Annotated[str, Meta(min_length=2 * SECRET_SIZE, max_length=2 * SECRET_SIZE)]


class _File(Section):
    """What both kinds of file have."""

    rass_keys: Literal[1]
    """`VERSION`."""
    checksum: str = ""


class _DroneSection(Section):
    id: NodeId
    serial: Number


class _GroundFile(_File):
    holds: Literal["ground"]
    secret: Hex32 = field(repr=False)
    links: Annotated[tuple[Number, ...], Meta(min_length=1, max_length=2)]
    """One. Earlier versions wrote two while the key changed, first the one to sign with."""
    drones: tuple[_DroneSection, ...]
    revoked: tuple[NodeId, ...] = ()
    """Drones whose serial is revoked."""


class _LinkSection(Section):
    number: Number
    key: Hex32 = field(repr=False)


class _PublicSection(Section):
    signing: Annotated[str, Meta(min_length=2 * PUBLIC_SIZE, max_length=2 * PUBLIC_SIZE)]
    sealing: Annotated[str, Meta(min_length=2 * PUBLIC_SIZE, max_length=2 * PUBLIC_SIZE)]


class _DroneFile(_File):
    holds: Literal["drone"]
    secret: Hex32 = field(repr=False)
    certificate: Annotated[str, Meta(min_length=2 * CERTIFICATE_SIZE, max_length=2 * CERTIFICATE_SIZE)]
    ground: _PublicSection
    links: Annotated[tuple[_LinkSection, ...], Meta(min_length=1, max_length=2)]
    """As in the ground's file."""


def drone_file(node_id: int) -> str:
    """The name of a drone's file."""
    return f"drone-{node_id}.keys"


# -- reading -----------------------------------------------------------------------------------------------------------


def read_keys(path: str | Path) -> Ground | NodeKeys:
    """What a key file holds. Raises `KeysError`."""
    raw = _parsed(path, _read(path))
    version = raw.get("rass_keys")
    if isinstance(version, int) and version > VERSION:
        raise KeysError(f"{path}: written by a later version of rass-mav", "update rass-mav on this computer")
    # What these errors say may show a part of a secret, so they must not even be the context of ours.
    with suppress(ConfigError, ForgedError, MalformedError, ValueError):
        if raw.get("holds") == "ground":
            return _ground(_intact(raw, _GroundFile))
        return _drone(_intact(raw, _DroneFile))
    raise _damaged(path)


def read_ground(path: str | Path) -> Ground:
    """The ground's keys in a file. Raises `KeysError`."""
    keys = read_keys(path)
    if isinstance(keys, Ground):
        return keys
    raise KeysError(f"{path}: holds the keys of drone {keys.certificate.node_id}", f"use the mission's {GROUND_FILE}")


def read_drone(path: str | Path) -> NodeKeys:
    """A drone's keys in a file. Raises `KeysError`."""
    keys = read_keys(path)
    if isinstance(keys, NodeKeys):
        return keys
    raise KeysError(f"{path}: holds the ground's keys", "name a drone by its node id, with -d and the mission's folder")


def _read(path: str | Path) -> bytes:
    try:
        with open(opened(path), "rb") as file:
            # Of the file itself, wherever a symbolic link leads, and whatever is put in its place meanwhile.
            mode = os.fstat(file.fileno()).st_mode & 0o777
            data = file.read(MAX_FILE_BYTES + 1)
    except PermissionError as error:
        raise KeysError(f"{path}: {why(error)}", "make the user that runs this its owner (chown)") from None
    except (OSError, ConfigError) as error:
        text = str(error) if isinstance(error, ConfigError) else f"{path}: {why(error)}"
        raise KeysError(text, "rass-mav keys writes these files (documentation: how-to/keys)") from None
    if mode & ~0o700:
        raise KeysError(f"{path}: accessible to other users (mode {mode:04o})", f"chmod 600 {path}")
    return data


#: Digits with one e among them, which YAML takes for a number: earlier versions wrote them without quotes.
_BARE_CHECKSUM = re.compile(rb"^checksum: ([0-9]+e[0-9]+)$", re.MULTILINE)


def _parsed(path: str | Path, data: bytes) -> dict[str, Any]:
    with suppress(ConfigError):
        return parse_yaml(_BARE_CHECKSUM.sub(rb"checksum: '\1'", data))
    raise _damaged(path)


def _damaged(path: str | Path) -> KeysError:
    return KeysError(
        f"{path}: damaged, or not a key file", "copy it again from the mission's folder or from the backup"
    )


def _intact(raw: dict[str, Any], kind: type[F]) -> F:
    """Raises `ConfigError`, and `ValueError` if the contents do not fit the checksum."""
    file = build(raw, kind)
    if file.checksum != _checksum(file):
        raise ValueError("the checksum does not match")
    return file


def _ground(file: _GroundFile) -> Ground:
    serials = {drone.id: drone.serial for drone in file.drones}
    return Ground(Secret(_bytes(file.secret)), file.links[0], serials, frozenset(file.revoked) & serials.keys())


def _drone(file: _DroneFile) -> NodeKeys:
    ground = GroundPublic(_bytes(file.ground.signing), _bytes(file.ground.sealing))
    certificate = Certificate.unpack(_bytes(file.certificate), ground)
    secret = Secret(_bytes(file.secret))
    if crypto_scalarmult_base(secret.reveal()) != certificate.public:
        raise ForgedError("a certificate of another key")
    link = file.links[0]
    return NodeKeys(certificate, secret, ground, LinkKey(link.number, Secret(_bytes(link.key))))


def _bytes(text: str) -> bytes:
    """Half as many as there are digits. Raises `ValueError`."""
    data = bytes.fromhex(text)
    # `fromhex` also accepts blanks, and libsodium does not ask how long a key is.
    if 2 * len(data) != len(text):
        raise ValueError("not hexadecimal")
    return data


def _checksum(file: _File) -> str:
    """Against damage, of everything else in the file."""
    rest = plain(replace(file, checksum=""))
    if not rest.get("revoked"):
        # Versions that did not know it have not counted it.
        rest.pop("revoked", None)
    return blake2b(json.dumps(rest, sort_keys=True).encode(), digest_size=8, person=Purpose.FILE).hexdigest()


# -- writing -----------------------------------------------------------------------------------------------------------


def ground_text(ground: Ground) -> str:
    """The contents of `ground.keys`."""
    file = _GroundFile(
        rass_keys=VERSION,
        holds="ground",
        secret=ground.secret.reveal().hex(),
        links=(ground.number,),
        drones=tuple(_DroneSection(id=id, serial=serial) for id, serial in sorted(ground.serials.items())),
        revoked=tuple(sorted(ground.revoked)),
    )
    return _text(
        file,
        f"Secret: the ground's keys of mission {ground.public.mission}.",
        "For bases, and for a backup. Never on a drone.",
    )


def drone_text(keys: NodeKeys) -> str:
    """The contents of a drone's file."""
    own = keys.certificate
    file = _DroneFile(
        rass_keys=VERSION,
        holds="drone",
        secret=keys.secret.reveal().hex(),
        certificate=own.pack().hex(),
        ground=_PublicSection(signing=keys.ground.signing.hex(), sealing=keys.ground.sealing.hex()),
        links=(_LinkSection(number=keys.link.number, key=keys.link.key.reveal().hex()),),
    )
    return _text(
        file,
        f"Secret: the keys of drone {own.node_id}, serial {own.serial}, of mission {keys.ground.mission}.",
        "For this drone, and nowhere else.",
    )


def _text(file: _File, *about: str) -> str:
    lines = "".join(f"# {line}\n" for line in about)
    # Without revocations, earlier versions of the program can read it.
    return lines + dump_yaml(replace(file, checksum=_checksum(file))).replace("\nrevoked: []\n", "\n")


def write_new(path: Path, text: str) -> None:
    """Write a file that does not exist yet, durably. Raises OSError."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, MODE)
    try:
        with open(descriptor, "w", encoding="utf-8") as file:
            # Whatever the umask is.
            os.fchmod(descriptor, MODE)
            file.write(text)
            file.flush()
            os.fsync(descriptor)
        _sync_folder(path)
    except BaseException:
        with suppress(OSError):
            path.unlink()
        raise


def write_over(path: Path, text: str) -> None:
    """Write a file, durably, in place of the one that may be there: the whole of it or nothing. Raises OSError."""
    fresh = path.with_name(path.name + ".new")
    fresh.unlink(missing_ok=True)
    write_new(fresh, text)
    fresh.replace(path)
    _sync_folder(path)


def _sync_folder(path: Path) -> None:
    folder = os.open(path.absolute().parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
