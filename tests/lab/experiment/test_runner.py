"""Finished runs are kept, and only those that are missing are done."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from rass_mav.errors import ConfigError, RassError
from rass_mav.lab.experiment.measures import OUT_OF_REACH
from rass_mav.lab.experiment.runner import Outcome, Result, Run, code_hash, execute, run_all
from rass_mav.lab.swarm.scenario import load_scenario
from tests.commands import output
from tests.patience import PATIENCE_S

SMALL = ("nodes=9", "arena_m=6")


def run(
    seed: int = 0, policy: str = "rass", measures: Sequence[str] = (), options: Mapping[str, object] | None = None
) -> Run:
    keys = {"policy.name": policy, "seed": seed, "steps": 23, **(options or {})}
    return Run("paper", "", load_scenario("paper-grid", keys, SMALL), tuple(measures))


def comparable(outcome: Outcome) -> list[bytes]:
    return [msgspec.json.encode(result) for result in outcome.results]


def test_a_second_call_does_nothing_and_touches_nothing(tmp_path: Path) -> None:
    runs = [run(seed) for seed in range(3)]
    first = run_all(runs, tmp_path)
    assert (first.done, first.reused) == (3, 0)
    written = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert len(written) == 3
    second = run_all(runs, tmp_path)
    assert (second.done, second.reused) == (0, 3)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == written
    assert comparable(second) == comparable(first)


def test_processes_give_the_same_results_in_the_same_order(tmp_path: Path) -> None:
    runs = [run(seed, policy) for policy in ("rass", "stigmergy") for seed in range(2)]
    assert comparable(run_all(runs, tmp_path / "two", jobs=2)) == comparable(run_all(runs, tmp_path / "one", jobs=1))


def test_results_of_other_keys_or_other_code_are_told_and_done_again(tmp_path: Path) -> None:
    told: list[int] = []
    run_all([run(0), run(1)], tmp_path, outdated=told.append)
    # Another seed is another run, not an old one.
    run_all([run(1), run(2)], tmp_path, outdated=told.append)
    assert told == []
    more = [run(seed, options={"radio.loss": 0.1}) for seed in (0, 1, 3)]
    assert run_all(more, tmp_path, outdated=told.append).done == 3
    assert told == [2]
    for path in tmp_path.iterdir():
        path.rename(path.with_name(f"{path.stem.rpartition('_')[0]}_ofothercode.json"))
    again = run_all([run(0), run(1), run(4)], tmp_path, outdated=told.append)
    assert (again.done, told) == (3, [2, 2])


def test_what_a_killed_process_had_begun_to_write_goes_and_what_another_writes_stays(tmp_path: Path) -> None:
    old, fresh = tmp_path / "a.1.part", tmp_path / "b.2.part"
    for draft in (old, fresh):
        draft.write_text("{")
    os.utime(old, (0, 0))
    run_all([], tmp_path)
    assert (old.exists(), fresh.exists()) == (False, True)


class Interruption:
    """Somebody presses Ctrl-C when so many runs are done."""

    def __init__(self, after: int) -> None:
        self.left = after

    @contextlib.contextmanager
    def __call__(self, total: int) -> Iterator[object]:
        yield self._advance

    def _advance(self, done: int) -> None:
        self.left -= done
        if not self.left:
            raise KeyboardInterrupt


def test_an_interrupted_call_goes_on_where_it_was(tmp_path: Path) -> None:
    runs = [run(seed) for seed in range(4)]
    with pytest.raises(KeyboardInterrupt):
        run_all(runs, tmp_path, progress=Interruption(2))  # type: ignore[arg-type]
    outcome = run_all(runs, tmp_path)
    assert (outcome.done, outcome.reused) == (2, 2)
    assert [result.seed for result in outcome.results] == [0, 1, 2, 3]


def test_a_damaged_file_is_a_run_that_has_not_been_done(tmp_path: Path) -> None:
    first = run_all([run()], tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:100])
    again = run_all([run()], tmp_path)
    assert again.done == 1
    assert comparable(again) == comparable(first)


def test_everything_that_determines_a_run_is_in_its_key() -> None:
    runs = [
        run(), run(seed=1), run(policy="hop-count"), run(measures=["basins"]), run(options={"steps": 24}),
        run(options={"radio.loss": 0.1}), replace(run(), world="other"), replace(run(), variant="v"),
        replace(run(), code="other"), replace(run(), protocol="epidemic"),
    ]  # fmt: skip
    assert len({r.key for r in runs}) == len(runs)
    assert run().key == run().key
    assert len({r.file_name for r in runs}) == len(runs)


def test_a_worker_with_other_code_is_refused() -> None:
    with pytest.raises(RassError, match="another version"):
        execute(replace(run(), code="0" * 64))
    assert execute(replace(run(), code=code_hash())).summary == execute(run()).summary


def test_the_workers_of_a_dask_cluster_give_the_same_results(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    runs = [run(seed) for seed in range(3)]
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0", protocol="inproc://"
    ) as cluster:
        outcome = run_all(runs, tmp_path / "dask", dask=cluster.scheduler_address)
    assert outcome.done == 3
    assert comparable(outcome) == comparable(run_all(runs, tmp_path / "here"))


def test_a_dask_cluster_that_is_not_there_is_named(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(ConfigError, match="--dask nonsense"):
        run_all([run()], tmp_path, dask="nonsense://here")


def test_a_run_without_dask_installed_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"pip install -e '\.\[dask\]' in the checkout"):
        run_all([run()], tmp_path, dask="tcp://127.0.0.1:1")


def test_what_is_measured_adds_up(tmp_path: Path) -> None:
    (result,) = run_all(
        [run(measures=["origins", "basins"], options={"radiation.random_sources": 9})], tmp_path
    ).results
    summary, series = result.summary, result.series
    assert series.step == [0, 5, 10, 15, 20, 22]
    assert series.created[-1] == summary["created"] > 0
    assert series.lost[-1] == sum(summary["lost"].values()) > 0
    assert series.base[-1] == summary["delivered"] == sum(result.delays.values()) > 0
    # One copy of each: what is stored is what is held.
    assert series.stored[-1] == summary["held"]
    distances = result.distances
    assert OUT_OF_REACH not in distances
    assert max(distances) == 2
    assert sum(d.created for d in distances.values()) == summary["created"]
    assert sum(d.arrived for d in distances.values()) == summary["delivered"]
    assert sum(d.lost for d in distances.values()) == summary["lost"]["corrupted"]
    delays = sum(delay * count for delay, count in result.delays.items())
    assert sum(d.delay_sum for d in distances.values()) == delays
    origins = result.extra["origins"]
    assert origins["step"] == series.step
    assert sum(created[-1] for created in origins["created"].values()) == summary["created"]
    assert sum(lost[-1] for lost in origins["lost"].values()) == summary["lost"]["corrupted"]
    basins = result.extra["basins"]
    assert basins["node_steps"] == 8 * 23
    assert basins["corrupted"] == summary["lost"]["corrupted"]
    assert basins["stored_in_basins"] <= basins["stored"]


def test_data_next_to_the_base_are_not_in_a_basin_and_data_behind_a_wall_of_radiation_are(tmp_path: Path) -> None:
    """Three in a row: 1 hears the base and 2; a strong source stands at 1, so 2 is fitter than 1 under `rass` only."""
    options = {
        "topology": "positions", "nodes": 3, "steps": 60, "mobility.positions": [[0, 0], [2, 0], [4, 0]],
        "radiation.sources": [[2, 0, 0.9]], "radiation.decay": 10, "radiation.noise": 0, "arena_m": 12,
    }  # fmt: skip
    keys = {policy: {"policy.name": policy, "seed": 0, **options} for policy in ("rass", "hop-count")}
    runs = [Run("t", "", load_scenario("paper-grid", keys[policy]), ("basins",)) for policy in keys]
    rass, hops = run_all(runs, tmp_path).results
    found = rass.extra["basins"]
    assert found["basins"] == found["lasting"] > 50
    # 2 keeps everything it makes, and gets what 1 makes.
    assert found["stored_in_basins"] > 0.9 * found["stored"] > 0
    assert hops.extra["basins"]["basins"] == 0


def test_a_result_survives_being_written_and_read() -> None:
    result = execute(run(measures=["basins"]))
    assert msgspec.json.decode(msgspec.json.encode(result), type=Result) == result


@pytest.mark.no_cover
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_command_that_is_interrupted_ends_at_once_and_goes_on_later(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        sys.executable, "-m", "rass_mav", "experiment", "five-drones", "--out", str(tmp_path), "--policy", "rass",
        "--steps", "100", "--jobs", "2", "--json", "--runs",
    ]  # fmt: skip
    with subprocess.Popen([*command, "1000"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            while process.poll() is None and not list(tmp_path.glob("runs/*.json")):
                pass
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    kept = [json.loads(path.read_bytes())["seed"] for path in tmp_path.glob("runs/*.json")]
    assert 0 < len(kept) < 1000
    line = f"interrupted: finished runs: {len(kept)}, kept in {tmp_path / 'runs'}; repeat the command to continue"
    assert (process.returncode, json.loads(out), err) == (130, {"error": [line]}, line + "\n")
    assert len(list(tmp_path.glob("runs/*"))) == len(kept)
    all_and_one_more = max(kept) + 2
    summary = json.loads(output(capsys, *command[3:], str(all_and_one_more)).out)
    assert (summary["reused"], summary["done"]) == (len(kept), all_and_one_more - len(kept))
