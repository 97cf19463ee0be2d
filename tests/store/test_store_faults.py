"""Flipped bits, cuts and zeroed pages in every file of a store: no number is given twice, and every loss is told."""

from __future__ import annotations

import random
import shutil
from pathlib import Path
from typing import NamedTuple

import pytest

from rass_mav.core.datum import Datum, DatumId, Fate, make_datum
from rass_mav.errors import StoreError
from rass_mav.store import mark
from rass_mav.store.sqlite import SqliteStore
from tests.extent import extents

from .store_helpers import commit, payload

#: Storms: other tests reach what these reach, and coverage would only make them slower.
pytestmark = pytest.mark.no_cover

NODE = 7
FILES = ("node.db", "node.db-wal", "node.db.mark")


class Past(NamedTuple):
    """What a store had acknowledged when it ended."""

    directory: Path
    held: dict[DatumId, Datum]
    assigned: set[DatumId]
    removed: set[DatumId]
    lives: set[int]


def live(store: SqliteStore, rng: random.Random, past: Past) -> None:
    """Some commits: own data and others', some of which go again."""
    for _ in range(rng.randrange(1, 9)):
        for id in list(past.held):
            if rng.random() < 0.2:
                store.remove(id, Fate.PASSED_ON)
                del past.held[id]
                past.removed.add(id)
        for _ in range(rng.randrange(1, 5)):
            if rng.random() < 0.6:
                id = DatumId(NODE, store.epoch, store.next_sequence())
                assert id not in past.assigned
                past.assigned.add(id)
            else:
                id = DatumId(9, 5, rng.getrandbits(32))
            size = rng.choice((1, 40, 60, 97, 900, 9000))
            past.held[id] = make_datum(id, 1, 1.5, payload(rng.getrandbits(40), size))
            store.put(past.held[id])
        commit(store)


@pytest.fixture(scope="module")
def pasts(tmp_path_factory: pytest.TempPathFactory) -> list[Past]:
    """Stores as `kill -9` or a clean end left them."""
    pasts = []
    for seed in range(12):
        rng = random.Random(seed)
        directory = tmp_path_factory.mktemp("past")
        past = Past(directory, {}, set(), set(), set())
        path = directory / "working" / "node.db"
        path.parent.mkdir()
        for last in (False, True):
            store = opened(path, rng)
            past.lives.update((store.life, store.epoch))
            live(store, rng, past)
            if last and seed % 2:
                for name in FILES:
                    shutil.copy(path.with_name(name), directory / name)
                store.abandon()
            else:
                store.close()
                for name in FILES:
                    if path.with_name(name).exists():
                        shutil.copy(path.with_name(name), directory / name)
        pasts.append(past)
    return pasts


def opened(path: Path, rng: random.Random) -> SqliteStore:
    return SqliteStore.open(path, node_id=NODE, draw_epoch=lambda: rng.getrandbits(32))


def damage(path: Path, rng: random.Random) -> str:
    """Damage one file. Returns what was done."""
    files = [path.with_name(name) for name in FILES if path.with_name(name).exists()]
    file = rng.choice([file for file in files if file.stat().st_size])
    content = bytearray(file.read_bytes())
    kind = rng.choice(("flip", "flips", "cut", "page", "sector", "gone"))
    if kind in ("flip", "flips"):
        for _ in range(1 if kind == "flip" else 9):
            content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del content[rng.randrange(len(content)) :]
    elif kind == "gone" and file.name != "node.db":
        file.unlink()
        return f"{file.name} gone"
    else:
        size = 512 if kind == "sector" else 4096
        at = rng.randrange(len(content)) // size * size
        content[at : at + size] = bytes(len(content[at : at + size]))
    file.write_bytes(content)
    return f"{file.name} {kind}"


@pytest.mark.parametrize("rebooted", [False, True])
@pytest.mark.parametrize("part", range(2))
@pytest.mark.parametrize("faults", extents(80, 4_000))
def test_no_number_is_given_twice_and_every_loss_is_told(
    pasts: list[Past], tmp_path: Path, faults: int, part: int, rebooted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if rebooted:
        # As after a power cut: whether the mark is the last one that was written nobody knows.
        (tmp_path / "boot_id").write_text(f"{part:032x}")
        monkeypatch.setattr(mark, "_BOOT_ID", tmp_path / "boot_id")
    whole = refused = 0
    for seed in range(2 * part + rebooted, faults, 4):
        rng = random.Random(seed)
        past = pasts[rng.randrange(len(pasts))]
        directory = tmp_path / str(seed)
        directory.mkdir()
        for name in FILES:
            if (past.directory / name).exists():
                shutil.copy(past.directory / name, directory / name)
        path = directory / "node.db"
        done = f"fault {seed}: {damage(path, rng)}"
        try:
            store = opened(path, rng)
        except StoreError as error:
            # The version of the tables has changed.
            assert "version (schema" in str(error), done  # noqa: PT017
            refused += 1
            continue
        with store:
            losses = dict(store.losses())
            report = store.report
            found = {id: store.get(id) for id in store.ids()}
            unknown = {id.epoch: id.sequence for id, fate in losses.items() if fate is Fate.UNKNOWN}
            at_most = max(
                [0, *(id.sequence for id, f in losses.items() if f is Fate.DAMAGED and id.epoch == store.life)]
            )
            missing = []
            for id, datum in past.held.items():
                there = found.get(id)
                if there is not None and (there.kind, there.crc, there.payload) == datum[1:2] + datum[4:6]:
                    continue
                # One whose checksum does not fit is found by the scrub, which tells.
                if id in losses or (there is not None and not there.intact):
                    continue
                missing.append(id)
            untold = [id for id in missing if not (id.origin == NODE and id.epoch in unknown)]
            assert len(untold) <= at_most, f"{done}: {len(missing)} missing, {at_most} told, {report}"
            for id, there in found.items():
                assert id in past.held or id in past.removed or (there is not None and not there.intact), done
            id = DatumId(NODE, store.epoch, store.next_sequence())
            assert id not in past.assigned, f"{done}: {id} is given twice, {report}"
            assert store.epoch != store.life, done
            if report.created:
                assert store.life not in past.lives, done
            whole += not report.reason
        with opened(path, rng) as store:
            assert not store.report.reason, done
        shutil.rmtree(directory)
    assert whole
    assert refused <= 2
