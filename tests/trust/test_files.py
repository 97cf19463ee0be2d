"""Key files: how they look, who may read them, and what is said of those that are wrong."""

from __future__ import annotations

import os
import pickle
import re
import traceback
from collections.abc import Callable
from copy import copy, deepcopy
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.errors import KeysError
from rass_mav.trust.keys import files
from rass_mav.trust.keys.files import drone_text, ground_text, read_ground, read_keys, write_new, write_over
from rass_mav.trust.keys.identity import Ground, NodeKeys
from rass_mav.trust.keys.keyring import load_keyring
from rass_mav.trust.keys.pairs import Pair
from rass_mav.trust.keys.sealing import Opener, Sealer
from rass_mav.trust.keys.secret import Secret

GROUND = Ground(Secret(bytes(range(32))), number=2, serials={7: 2, 8: 1, 9: 1}, revoked=frozenset({9}))
SEVEN = GROUND.node(7, 2)
TEXTS = {"ground": ground_text(GROUND), "drone": drone_text(SEVEN)}
DAMAGED = "damaged, or not a key file; copy it again from the mission's folder or from the backup"

#: Everything that must never be seen, as bytes.
SECRETS = [secret.reveal() for secret in (GROUND.secret, GROUND.opening, GROUND._signing, SEVEN.secret, SEVEN.link.key)]


def shows_a_secret(text: str) -> bool:
    """Whether eight digits of a secret, or its bytes as Python writes them, are in a text."""
    digits = text.lower()
    return any(secret.hex()[at : at + 8] in digits for secret in SECRETS for at in range(0, 56, 2)) or any(
        repr(secret)[2:-1] in text for secret in SECRETS
    )


def written(path: Path, text: str | bytes, mode: int = 0o600) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    path.chmod(mode)
    return path


def refused(do: Callable[[], object]) -> str:
    """What is said, which is one line, and shows nothing secret: neither do the traceback or what led to it."""
    with pytest.raises(KeysError) as caught:
        do()
    error: BaseException | None = caught.value
    assert len(caught.value.lines()) == 1
    assert caught.value.text
    assert caught.value.remedy
    assert not shows_a_secret("".join(traceback.format_exception(caught.value)))
    while error is not None:
        assert not shows_a_secret(str(error) + repr(error))
        error = error.__cause__ or error.__context__
    return str(caught.value)


# -- what is in them ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("holds", "keys"), [("ground", GROUND), ("drone", SEVEN)])
def test_what_was_written_is_read(holds: str, keys: Ground | NodeKeys, tmp_path: Path) -> None:
    path = tmp_path / "keys"
    write_new(path, TEXTS[holds])
    assert read_keys(path) == keys


def test_they_say_whose_they_are() -> None:
    mission = GROUND.public.mission
    assert TEXTS["ground"].startswith(f"# Secret: the ground's keys of mission {mission}.\n# For bases, ")
    assert TEXTS["drone"].startswith(
        f"# Secret: the keys of drone 7, serial 2, of mission {mission}.\n# For this drone"
    )


def test_a_drone_has_nothing_of_the_grounds_secret_and_of_other_drones() -> None:
    others = [GROUND.secret, GROUND.opening, GROUND._signing, GROUND.node_secret(7, 1), GROUND.node_secret(8, 1)]
    assert not [secret for secret in others if secret.reveal().hex() in TEXTS["drone"]]
    assert SEVEN.secret.reveal().hex() in TEXTS["drone"]


@given(st.sampled_from(sorted(TEXTS)), st.integers(min_value=0), st.characters(codec="utf-8"))
def test_a_changed_character_is_noticed_unless_it_means_the_same(holds: str, at: int, other: str) -> None:
    text = TEXTS[holds]
    begin = text.index("rass_keys")
    at = begin + at % (len(text) - begin)
    with TemporaryDirectory() as folder:
        path = written(Path(folder) / "keys", text[:at] + other + text[at + 1 :])
        try:
            keys = read_keys(path)
        except KeysError as caught:
            error = caught
        else:
            # For example with a comment instead of the end of the last line.
            assert keys == (GROUND if holds == "ground" else SEVEN)
            return
    assert not shows_a_secret(str(error))


# What earlier versions wrote: nobody was ever revoked, and two link keys while the key changed.
EARLIER = """\
rass_keys: 1
checksum: f62d7a66262a61cf
holds: ground
secret: 000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f
links:
- 2
- 1
drones:
- id: 7
  serial: 2
"""


def test_files_of_earlier_versions_are_read(tmp_path: Path) -> None:
    assert "revoked" not in ground_text(replace(GROUND, revoked=frozenset()))
    ground = read_keys(written(tmp_path / "keys", EARLIER))
    assert ground == replace(GROUND, serials={7: 2}, revoked=frozenset())


@pytest.mark.parametrize("quoted", [True, False], ids=["as now", "as earlier versions wrote it"])
def test_a_checksum_that_looks_like_a_number_is_read(quoted: bool, tmp_path: Path) -> None:
    ground = replace(GROUND, number=1, serials={7: 322}, revoked=frozenset())
    line = "checksum: '30465e9714172482'"
    text = ground_text(ground)
    assert line in text
    found = written(tmp_path / "keys", text if quoted else text.replace(line, line.replace("'", "")))
    assert read_keys(found) == ground


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("holds", sorted(TEXTS))
@pytest.mark.parametrize(
    "damage",
    [
        lambda text: "",
        lambda text: text[: len(text) // 2],
        lambda text: text[:-20],
        lambda text: text.replace("secret: ", "secret: f"),
        lambda text: text.replace("secret: ", "secret: !"),
        lambda text: text.replace("secret: ", "secret: {"),
        lambda text: text.replace("secret: ", "secret: *"),
        lambda text: text.replace("secret: ", "? "),
        lambda text: text.replace("secret: ", ""),
        lambda text: text.replace("secret: ", "secret: '  ").replace("\n", "'\n", 5),
        lambda text: re.sub("secret: (.*)", r"\1: \1\n\1: \1", text),
        lambda text: re.sub("secret: (.*)", r'secret: "\1\\0"', text),
        lambda text: re.sub("secret: (..)(.*)", r"secret: '  \2'", text),
        lambda text: re.sub("secret: (.*)", r"secret: [\1]", text),
        lambda text: re.sub("checksum: .*\n", "", text),
        lambda text: re.sub("checksum: .*\n", "checksum: 0\n", text),
        lambda text: text.replace("rass_keys: 1", "rass_keys: 0"),
        lambda text: text.replace("rass_keys: 1", "rass_keys: one"),
        lambda text: text.replace("holds: ", "holds: a"),
        lambda text: text + "more: 1\n",
        lambda text: "node: {id: 7}\n",
        lambda text: "- 1\n",
        lambda text: "x: " + "[" * 5000,
        lambda text: b"\xff\xfe\x00",
        lambda text: "#" * (1 << 18) + "#",
    ],
)
def test_a_damaged_file(holds: str, damage: Callable[[str], str | bytes], tmp_path: Path) -> None:
    path = written(tmp_path / "keys", damage(TEXTS[holds]))
    assert refused(lambda: read_keys(path)) == f"{path}: {DAMAGED}"


def test_a_file_whose_parts_do_not_belong_together(tmp_path: Path) -> None:
    """With a right checksum: it was put together, not damaged."""
    eight = GROUND.node(8, 1)
    stranger = Ground(Secret(bytes(32))).node(7, 2)
    for keys in (
        replace(SEVEN, certificate=eight.certificate),
        replace(SEVEN, secret=eight.secret),
        replace(SEVEN, ground=stranger.ground),
        replace(SEVEN, certificate=stranger.certificate),
        replace(SEVEN, certificate=SEVEN.certificate._replace(node_id=8)),
    ):
        path = written(tmp_path / "keys", drone_text(keys))
        assert refused(lambda: read_keys(path)) == f"{path}: {DAMAGED}"  # noqa: B023


def test_blanks_do_not_count_as_digits(tmp_path: Path) -> None:
    section = files._PublicSection(signing=" " * 64, sealing=SEVEN.ground.sealing.hex())
    path = written(tmp_path / "keys", TEXTS["drone"])
    file = files._intact(files._parsed(path, path.read_bytes()), files._DroneFile)
    path = written(path, files._text(replace(file, ground=section, checksum="")))
    assert refused(lambda: read_keys(path)) == f"{path}: {DAMAGED}"


@pytest.mark.parametrize("holds", sorted(TEXTS))
def test_a_file_of_a_later_version(holds: str, tmp_path: Path) -> None:
    path = written(tmp_path / "keys", TEXTS[holds].replace("rass_keys: 1", "rass_keys: 2\nnews: true"))
    said = f"{path}: written by a later version of rass-mav; update rass-mav on this computer"
    assert refused(lambda: read_keys(path)) == said


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o610, 0o601, 0o777])
@pytest.mark.parametrize("linked", [False, True])
def test_a_file_that_others_may_use(mode: int, linked: bool, tmp_path: Path) -> None:
    path = written(tmp_path / "keys", TEXTS["drone"], mode)
    if linked:
        (tmp_path / "link").symlink_to(path)
        path = tmp_path / "link"
    said = f"{path}: accessible to other users (mode {mode:04o}); chmod 600 {path}"
    assert refused(lambda: read_keys(path)) == said
    path.chmod(0o600)
    assert read_keys(path) == SEVEN


@pytest.mark.parametrize("mode", [0o600, 0o400, 0o700])
def test_a_file_of_its_owner_alone(mode: int, tmp_path: Path) -> None:
    assert read_keys(written(tmp_path / "keys", TEXTS["drone"], mode)) == SEVEN


def test_what_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    for name, said in [
        ("none", ": no such file or directory"),
        (".", " is a folder, not a file"),
        ("pipe", ": expected a file, got something else"),
    ]:
        path = tmp_path / name
        remedy = "rass-mav keys writes these files (documentation: how-to/keys)"
        assert refused(lambda: read_keys(path)) == f"{path}{said}; {remedy}"  # noqa: B023


def test_only_the_grounds_file_is_the_grounds(tmp_path: Path) -> None:
    path = written(tmp_path / "keys", TEXTS["drone"])
    assert refused(lambda: read_ground(path)) == f"{path}: holds the keys of drone 7; use the mission's ground.keys"


# -- which node may have which -----------------------------------------------------------------------------------------


def test_a_drone_has_its_own_and_a_base_the_grounds(tmp_path: Path) -> None:
    drone, ground = (str(written(tmp_path / holds, TEXTS[holds])) for holds in ("drone", "ground"))
    assert load_keyring(drone, 7, base=False) == (SEVEN, None)
    assert load_keyring(ground, 1, base=True) == (GROUND.node(1), GROUND)
    about = {"mission": GROUND.public.mission, "link_key": 2}
    assert load_keyring(drone, 7, base=False).own.about == {**about, "node_id": 7, "serial": 2}
    assert load_keyring(ground, 1, base=True).own.about == {**about, "node_id": 1, "serial": 0}
    for path, node_id, base, said in [
        (drone, 8, False, "holds the keys of drone 7, but this is node 8; use drone-8.keys (rass-mav keys drone 8)"),
        (drone, 7, True, "holds the keys of drone 7, not the ground's; use the mission's ground.keys"),
        (
            ground, 7, False,
            "holds the ground's keys, which must never be on a drone; remove it from this computer, and use "
            "drone-7.keys (rass-mav keys drone 7)",
        ),
        (ground, 7, True, "node 7 is a drone of this mission; give the base another node.id"),
    ]:  # fmt: skip
        assert refused(lambda: load_keyring(path, node_id, base=base)) == f"{path}: {said}"  # noqa: B023


# -- how they are written ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("write", [write_new, write_over])
@pytest.mark.parametrize("umask", [0, 0o077, 0o277])
def test_they_belong_to_their_owner_alone_whatever_the_umask(
    write: Callable[[Path, str], None], umask: int, tmp_path: Path
) -> None:
    before = os.umask(umask)
    try:
        write(tmp_path / "keys", TEXTS["drone"])
    finally:
        os.umask(before)
    assert (tmp_path / "keys").stat().st_mode & 0o777 == 0o600
    assert os.listdir(tmp_path) == ["keys"]


def test_a_new_file_never_replaces_one_nor_follows_a_link(tmp_path: Path) -> None:
    (tmp_path / "there").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    for name in ("there", "link"):
        with pytest.raises(FileExistsError):
            write_new(tmp_path / name, TEXTS["drone"])
    assert (tmp_path / "there").read_text() == "mine"
    assert not (tmp_path / "elsewhere").exists()


def test_a_file_is_replaced_as_a_whole_and_what_was_cut_off_does_not_matter(tmp_path: Path) -> None:
    path = written(tmp_path / "keys", TEXTS["ground"], 0o644)
    (tmp_path / "keys.new").symlink_to(tmp_path / "elsewhere")
    write_over(path, TEXTS["drone"])
    assert read_keys(path) == SEVEN
    assert os.listdir(tmp_path) == ["keys"]


def test_nothing_remains_of_a_file_that_could_not_be_written(tmp_path: Path) -> None:
    with pytest.raises(UnicodeEncodeError):
        write_new(tmp_path / "keys", TEXTS["drone"] + "\ud800")
    assert os.listdir(tmp_path) == []


# -- what is never seen ------------------------------------------------------------------------------------------------


def test_no_object_shows_a_secret(tmp_path: Path) -> None:
    path = written(tmp_path / "keys", TEXTS["drone"])
    ground = written(tmp_path / "ground", TEXTS["ground"])
    objects = [
        GROUND.secret, GROUND, SEVEN, SEVEN.secret, SEVEN.link, SEVEN.about, GROUND.public, SEVEN.certificate,
        load_keyring(str(path), 7, base=False), load_keyring(str(ground), 1, base=True), Sealer(SEVEN, 5, 0),
        Opener(GROUND), Pair(SEVEN, GROUND.node(8, 1).certificate),
        files._intact(files._parsed(path, path.read_bytes()), files._DroneFile),
        files._intact(files._parsed(ground, ground.read_bytes()), files._GroundFile),
    ]  # fmt: skip
    for each in objects:
        for text in (repr(each), str(each), f"{each}", f"{each!r:s}", "%s %r" % (each, each), repr(vars(type(each)))):  # noqa: UP031
            assert not shows_a_secret(text)
        assert not shows_a_secret(repr(getattr(each, "__dict__", "")).replace(TEXTS["drone"], "")) or isinstance(
            each, (files._DroneFile, files._GroundFile)
        )
    assert shows_a_secret(TEXTS["drone"])
    assert shows_a_secret(TEXTS["ground"])
    assert shows_a_secret(repr(GROUND.secret.reveal()))


def test_a_secret_is_neither_copied_nor_pickled_nor_hashed() -> None:
    for do in (pickle.dumps, copy, deepcopy, hash):
        for each in (GROUND.secret, SEVEN.secret):
            with pytest.raises(TypeError):
                do(each)
    with pytest.raises(TypeError):
        asdict(SEVEN)
    assert Secret(bytes(32)) == Secret(bytes(32)) != Secret(bytes(range(32)))
    assert Secret(bytes(32)) != bytes(32)


@pytest.mark.parametrize("size", [0, 31, 33])
def test_a_secret_has_32_bytes(size: int) -> None:
    with pytest.raises(ValueError, match=f"^a secret has 32 bytes, got {size}$"):
        Secret(bytes(size))
